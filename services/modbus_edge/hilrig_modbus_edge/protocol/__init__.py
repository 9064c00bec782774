"""Modbus TCP protocol: MBAP framing, functions and exception responses."""
