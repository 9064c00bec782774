"""A request that gets an exception response."""

from pymodbus.constants import ExcCodes


class ModbusError(Exception):
    """A request that gets an exception response."""

    def __init__(self, code: ExcCodes) -> None:
        super().__init__(f"exception {code:02X}, {code.name}")
        self.code = code
