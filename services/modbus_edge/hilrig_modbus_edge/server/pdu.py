"""Functions of the Modbus application protocol V1.1b3: decode a request, execute it on a device, encode the response.

Each function checks in the order of the specification's state diagrams: function code (01), quantity, value and length
(03), existence and access of every address (02), execution (04, 06). A block write is all or nothing: everything is
checked before the first register changes.
"""

import struct
from collections.abc import Callable
from importlib.metadata import version
from typing import Final

from pymodbus.constants import DeviceInformation, ExcCodes
from pymodbus.pdu.mei_message import ReadDeviceInformationResponse

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_modbus_edge.protocol.functions import FunctionCode, RegisterTable

Handler = Callable[[Device, Client, bytes, int, int], bytes]
"""Executes a request: device, client, request, its arrival at the process and at the kernel (ns, monotonic clock; 0:
unknown) to the response."""

MAX_READ_BITS: Final = 2000
MAX_WRITE_BITS: Final = 1968
MAX_READ_REGISTERS: Final = 125
MAX_WRITE_REGISTERS: Final = 123
MAX_READ_WRITE_REGISTERS: Final = 121
"""Quantity limits of the specification; the last one is for the written registers of function 23."""

MAX_QUANTITY: Final = {
    FunctionCode.READ_COILS: MAX_READ_BITS,
    FunctionCode.READ_DISCRETE_INPUTS: MAX_READ_BITS,
    FunctionCode.READ_HOLDING_REGISTERS: MAX_READ_REGISTERS,
    FunctionCode.READ_INPUT_REGISTERS: MAX_READ_REGISTERS,
    FunctionCode.WRITE_MULTIPLE_COILS: MAX_WRITE_BITS,
    FunctionCode.WRITE_MULTIPLE_REGISTERS: MAX_WRITE_REGISTERS,
    FunctionCode.READ_WRITE_MULTIPLE_REGISTERS: MAX_READ_REGISTERS,
}
"""Limit of the quantity of each function that has one; of function 23, that of the registers that it reads."""

# Looking up an enumeration member is a function call: those that each request needs are looked up once.
_HOLDING_REGISTER: Final = RegisterTable.HOLDING_REGISTER
_INPUT_REGISTER: Final = RegisterTable.INPUT_REGISTER
_FUNCTION_SIZE: Final = struct.Struct(">BB")
_ADDRESS_VALUE: Final = struct.Struct(">BHH")
_ADDRESS_BLOCK: Final = struct.Struct(">BHHB")
_MASK: Final = struct.Struct(">BHHH")
_READ_WRITE: Final = struct.Struct(">BHHHHB")
_ON: Final = 0xFF00
_OFF: Final = 0x0000
_DEVICE_IDENTIFICATION: Final = 0x0E
_READ_CODES: Final = frozenset(int(code) for code in DeviceInformation)
_REGULAR_STREAM_AND_INDIVIDUAL: Final = 0x82

IDENTITY: Final = {
    0x00: b"hilrig",
    0x01: b"hilrig-edge",
    0x02: version("hilrig").encode(),
    0x04: b"hilrig virtual SCARA rig",
    0x05: b"SCARA",
}
"""Objects of function 43/14: vendor, product code, revision, product name, model."""


def execute(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int = 0) -> bytes:
    """Execute the PDU of a request (at least the function code) and return the PDU of the response.

    Args:
        device: rig that the request is for.
        client: sender of the request.
        request: its PDU.
        arrived_ns: arrival of the request at this process, ns, monotonic clock.
        received_ns: kernel's receive timestamp of a write, ns, monotonic clock; 0: unavailable.
    """
    handler = _HANDLERS.get(request[0])
    if handler is None:
        return exception_response(request[0], ExcCodes.ILLEGAL_FUNCTION)
    try:
        return handler(device, client, request, arrived_ns, received_ns)
    except ModbusError as error:
        return exception_response(request[0], error.code)


def exception_response(function: int, code: int) -> bytes:
    """Return the PDU of an exception response."""
    return bytes((function | 0x80, code))


def _read_registers(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:  # noqa: ARG001
    function, address, count = _address_and_count(request, MAX_READ_REGISTERS)
    table = _HOLDING_REGISTER if function == 0x03 else _INPUT_REGISTER
    return _FUNCTION_SIZE.pack(function, 2 * count) + device.read_registers(client, table, address, count)


def _read_bits(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:  # noqa: ARG001
    function, address, count = _address_and_count(request, MAX_READ_BITS)
    table = RegisterTable.COIL if function == 0x01 else RegisterTable.DISCRETE_INPUT
    size = (count + 7) // 8
    return bytes((function, size)) + device.read_bits(client, table, address, count).to_bytes(size, "little")


def _write_coil(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:
    _, address, value = _unpack(_ADDRESS_VALUE, request)
    if value not in (_ON, _OFF):
        raise ModbusError(ExcCodes.ILLEGAL_VALUE)
    device.write_coil(client, address, value == _ON, arrived_ns, received_ns)
    return request


def _write_register(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:
    _, address, _ = _unpack(_ADDRESS_VALUE, request)
    device.write_registers(client, address, request[3:], arrived_ns, received_ns)
    return request


def _write_coils(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:
    address, count = _block(request, MAX_WRITE_BITS, bits=True)
    if count > 1:
        # No two coils have adjacent addresses.
        raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
    device.write_coil(client, address, bool(request[6] & 1), arrived_ns, received_ns)
    return request[:5]


def _write_registers(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:
    address, _ = _block(request, MAX_WRITE_REGISTERS)
    device.write_registers(client, address, request[6:], arrived_ns, received_ns)
    return request[:5]


def _mask_register(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:
    _, address, and_mask, or_mask = _unpack(_MASK, request)
    device.check_writable(address, 1)
    now = int.from_bytes(device.read_registers(client, RegisterTable.HOLDING_REGISTER, address, 1), "big")
    value = (now & and_mask) | (or_mask & ~and_mask)
    device.write_registers(client, address, value.to_bytes(2, "big"), arrived_ns, received_ns)
    return request


def _read_write(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:
    if len(request) < _READ_WRITE.size:
        raise ModbusError(ExcCodes.ILLEGAL_VALUE)
    _, read, read_count, write, write_count, size = _READ_WRITE.unpack_from(request)
    if not (
        1 <= read_count <= MAX_READ_REGISTERS
        and 1 <= write_count <= MAX_READ_WRITE_REGISTERS
        and size == 2 * write_count == len(request) - _READ_WRITE.size
    ):
        raise ModbusError(ExcCodes.ILLEGAL_VALUE)
    # Both address ranges are checked first: a wrong address is exception 02 even if no state was received yet.
    device.check_writable(write, write_count)
    device.check_readable(read, read_count)
    device.write_registers(client, write, request[_READ_WRITE.size :], arrived_ns, received_ns)
    words = device.read_registers(client, RegisterTable.HOLDING_REGISTER, read, read_count)
    return bytes((0x17, 2 * read_count)) + words


def _identify(device: Device, client: Client, request: bytes, arrived_ns: int, received_ns: int) -> bytes:  # noqa: ARG001
    if len(request) < 2 or request[1] != _DEVICE_IDENTIFICATION:
        raise ModbusError(ExcCodes.ILLEGAL_FUNCTION)
    if len(request) != 4 or request[2] not in _READ_CODES:
        raise ModbusError(ExcCodes.ILLEGAL_VALUE)
    code, first = request[2], request[3]
    if code == DeviceInformation.SPECIFIC:
        if first not in IDENTITY:
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
        objects = {first: IDENTITY[first]}
    else:
        last = 0x02 if code == DeviceInformation.BASIC else 0x7F
        # A stream access that starts at an unknown object starts at the first object (specification, 6.21).
        start = first if first in IDENTITY and first <= last else 0x00
        objects = {key: text for key, text in IDENTITY.items() if start <= key <= last}
    response = ReadDeviceInformationResponse(code, objects)
    response.conformity = _REGULAR_STREAM_AND_INDIVIDUAL
    return bytes((0x2B,)) + response.encode()


def _address_and_count(request: bytes, max_count: int) -> tuple[int, int, int]:
    # A request that is too long is as invalid as one that is too short.
    if len(request) == _ADDRESS_VALUE.size:
        fields: tuple[int, int, int] = _ADDRESS_VALUE.unpack(request)
        if 1 <= fields[2] <= max_count:
            return fields
    raise ModbusError(ExcCodes.ILLEGAL_VALUE)


def _block(request: bytes, max_count: int, *, bits: bool = False) -> tuple[int, int]:
    if len(request) > _ADDRESS_BLOCK.size:
        _, address, count, size = _ADDRESS_BLOCK.unpack_from(request)
        needed = (count + 7) // 8 if bits else 2 * count
        if 1 <= count <= max_count and size == needed == len(request) - _ADDRESS_BLOCK.size:
            return address, count
    raise ModbusError(ExcCodes.ILLEGAL_VALUE)


def _unpack(layout: struct.Struct, request: bytes) -> tuple[int, ...]:
    if len(request) != layout.size:
        raise ModbusError(ExcCodes.ILLEGAL_VALUE)
    return layout.unpack(request)


_HANDLER_OF: Final[dict[FunctionCode, Handler]] = {
    FunctionCode.READ_COILS: _read_bits,
    FunctionCode.READ_DISCRETE_INPUTS: _read_bits,
    FunctionCode.READ_HOLDING_REGISTERS: _read_registers,
    FunctionCode.READ_INPUT_REGISTERS: _read_registers,
    FunctionCode.WRITE_SINGLE_COIL: _write_coil,
    FunctionCode.WRITE_SINGLE_REGISTER: _write_register,
    FunctionCode.WRITE_MULTIPLE_COILS: _write_coils,
    FunctionCode.WRITE_MULTIPLE_REGISTERS: _write_registers,
    FunctionCode.MASK_WRITE_REGISTER: _mask_register,
    FunctionCode.READ_WRITE_MULTIPLE_REGISTERS: _read_write,
    FunctionCode.READ_DEVICE_IDENTIFICATION: _identify,
}
# Plain integers are found faster than members of an enumeration; a missing handler is an error at import.
_HANDLERS: Final[dict[int, Handler]] = {int(function): _HANDLER_OF[function] for function in FunctionCode}
