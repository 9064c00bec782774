"""Modbus TCP server: listening sockets, connections, event loop, TLS and admission control."""
