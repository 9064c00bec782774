"""The Modbus functions of a rig: code, layout of the request, accessed table, and whether a function reads or writes.

The only place of this knowledge: request log, register pages, request rates and tests derive from `FunctionCode`. Pure
data, so that tools can import it.
"""

from enum import Enum, IntEnum


class RegisterTable(Enum):
    """The four tables of the Modbus data model, with the first digit of their traditional numbering."""

    COIL = 0
    DISCRETE_INPUT = 1
    INPUT_REGISTER = 3
    HOLDING_REGISTER = 4


class RequestLayout(Enum):
    """Fields after the function code of a request."""

    UNADDRESSED = "no address"
    SINGLE = "address of one register or coil"
    QUANTITY = "address and quantity"


class FunctionCode(IntEnum):
    """The supported functions. Function 23 has the address and the quantity of the registers that it reads first."""

    layout: RequestLayout
    table: RegisterTable | None
    is_read: bool
    """Whether the response has values of the rig."""
    is_write: bool
    """Whether the rig is changed. Function 23 writes torques and counts as a write, although it reads too."""

    def __new__(cls, code: int, layout: RequestLayout, table: RegisterTable | None, access: str) -> "FunctionCode":
        """Create a row of the table; `access` is "r", "w" or "rw"."""
        row = int.__new__(cls, code)
        row._value_ = code
        row.layout, row.table, row.is_read, row.is_write = layout, table, "r" in access, "w" in access
        return row

    READ_COILS = 1, RequestLayout.QUANTITY, RegisterTable.COIL, "r"
    READ_DISCRETE_INPUTS = 2, RequestLayout.QUANTITY, RegisterTable.DISCRETE_INPUT, "r"
    READ_HOLDING_REGISTERS = 3, RequestLayout.QUANTITY, RegisterTable.HOLDING_REGISTER, "r"
    READ_INPUT_REGISTERS = 4, RequestLayout.QUANTITY, RegisterTable.INPUT_REGISTER, "r"
    WRITE_SINGLE_COIL = 5, RequestLayout.SINGLE, RegisterTable.COIL, "w"
    WRITE_SINGLE_REGISTER = 6, RequestLayout.SINGLE, RegisterTable.HOLDING_REGISTER, "w"
    WRITE_MULTIPLE_COILS = 15, RequestLayout.QUANTITY, RegisterTable.COIL, "w"
    WRITE_MULTIPLE_REGISTERS = 16, RequestLayout.QUANTITY, RegisterTable.HOLDING_REGISTER, "w"
    MASK_WRITE_REGISTER = 22, RequestLayout.SINGLE, RegisterTable.HOLDING_REGISTER, "w"
    READ_WRITE_MULTIPLE_REGISTERS = 23, RequestLayout.QUANTITY, RegisterTable.HOLDING_REGISTER, "rw"
    READ_DEVICE_IDENTIFICATION = 43, RequestLayout.UNADDRESSED, None, "r"
