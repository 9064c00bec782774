"""The Modbus edge: controllers on one side, the bus on the other."""
