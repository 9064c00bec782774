"""The Modbus TCP protocol: MBAP frames, PDUs and exception codes."""
