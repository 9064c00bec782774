"""Modbus exception response to a request."""

from pymodbus.constants import ExcCodes


class ModbusError(Exception):
    """A request that is answered with a Modbus exception response."""

    def __init__(self, code: ExcCodes) -> None:
        super().__init__(f"Modbus exception {code:02X} ({code.name})")
        self.code = code
