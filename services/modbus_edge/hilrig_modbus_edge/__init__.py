"""Modbus edge: connects Modbus TCP clients with the bus."""
