"""The Modbus TCP server: the listening socket, the event loop, TLS and admission of clients."""
