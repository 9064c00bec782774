"""Explains an exception response: the request, the cause of its refusal, and the fix. Pure functions."""

import struct
from typing import Final

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.protocol.functions import FunctionCode, RegisterTable, RequestLayout
from hilrig_modbus_edge.protocol.mbap import encode_frame
from hilrig_modbus_edge.protocol.recognition import foreign_protocol
from hilrig_modbus_edge.registers.export import TABLE_NAMES
from hilrig_modbus_edge.registers.map import rows_of
from hilrig_modbus_edge.request_log import kind_of
from hilrig_modbus_edge.server.pdu import MAX_QUANTITY
from hilrig_runtime.config.claim_codes import CLAIM_ADDRESS

Block = tuple[int, int]
"""First and last number of consecutive registers or bits."""

_CLAIM: Final = struct.pack(">BH", FunctionCode.WRITE_MULTIPLE_REGISTERS, CLAIM_ADDRESS)
"""Begin of a request that claims a rig."""
_TRADITIONAL: Final = 10_000
"""Numbers per table in the traditional numbering, where 40001 is holding register 1."""


def blocks_of(table: RegisterTable, *, writable: bool = False) -> list[Block]:
    """Return the blocks without a gap of a table; `writable`: only those that a client may write."""
    blocks: list[Block] = []
    for row in rows_of(table):
        if row.writable or not writable:
            begin = blocks.pop()[0] if blocks and blocks[-1][1] == row.address else row.number
            blocks.append((begin, row.end))
    return blocks


def explain(transaction: int, unit: int, request: bytes, code: int) -> str:
    """Return the explanation of an exception response: "<request>, <cause> (exception <code>): <fix>".

    Args:
        transaction: transaction identifier of the request.
        unit: its unit identifier.
        request: its PDU.
        code: exception code of the response.
    """
    cause, fix = _cause_and_fix(transaction, unit, request, code)
    return f"{_request(request)}, {cause} (exception {code:02X}): {fix}"


def _cause_and_fix(transaction: int, unit: int, request: bytes, code: int) -> tuple[str, str]:
    function = _function(request)
    if code == ExcCodes.GATEWAY_NO_RESPONSE:
        found = foreign_protocol(encode_frame(transaction, unit, request))
        if found is not None:
            return f"which is a frame of {found.name}", found.fix
        return f"unit id {unit} does not exist", "set unit id 1 (0 and 255 are accepted too)"
    if code == ExcCodes.ILLEGAL_FUNCTION:
        if function is None:
            known = ", ".join(str(int(one)) for one in FunctionCode)
            return "the rig does not have this function", f"use one of {known}"
        if function.is_write:
            return "which its certificate does not permit", "use a certificate with the role operator"
        return "the rig has device identification only", "use MEI type 14"
    if function is not None and code == ExcCodes.ILLEGAL_ADDRESS:
        if function.table is None:
            return "the object does not exist", "read code 01 lists the objects"
        return _wrong_address(function, function.table, request)
    if function is not None and code == ExcCodes.ILLEGAL_VALUE:
        return _wrong_value(function, request)
    if function is not None and code == ExcCodes.DEVICE_FAILURE:
        if request[:3] == _CLAIM:
            return "and the code is not valid for this rig now", "check code and rig; hilrig rig codes makes new codes"
        if function.is_write and function is not FunctionCode.READ_WRITE_MULTIPLE_REGISTERS:
            return "the watchdog timeout is out of bounds", "see edge.watchdog_min_ms and edge.watchdog_max_ms"
        return "the simulation has sent no state yet", "check with hilrig top that it runs"
    return "which was refused", "see docs/controllers.md"


def _wrong_address(function: FunctionCode, table: RegisterTable, request: bytes) -> tuple[str, str]:
    first, last = _numbers(request)
    blocks, writes = blocks_of(table, writable=function.is_write), function.is_write
    if function is FunctionCode.READ_WRITE_MULTIPLE_REGISTERS:
        write = _write_numbers(request)
        if any(begin <= write[0] and write[1] <= end for begin, end in blocks):
            blocks, writes = blocks_of(table), False
        else:
            first, last = write
    cause = _only(blocks, writable=writes)
    traditional = first - 1 - _TRADITIONAL * table.value
    if any(begin <= traditional <= end for begin, end in blocks_of(table)):
        name = TABLE_NAMES[table]
        return cause, f"{first - 1} is the traditional number of {name} {traditional}: use address {traditional - 1}"
    zeros = ""
    if not writes and any(first <= end and begin <= last for begin, end in blocks_of(table)):
        zeros = ', or set unmapped_reads = "zeros" in [edge] of lab.toml'
    for begin, end in blocks:
        if begin <= first <= end:
            shifted = "" if first == begin or last - 1 > end else "begin one lower (register n has address n - 1) or "
            return _only([(begin, end)], writable=writes), f"{shifted}reduce the count to {end - first + 1}{zeros}"
    return cause, f"choose one of them; number n has address n - 1{zeros}"


def _wrong_value(function: FunctionCode, request: bytes) -> tuple[str, str]:
    if function is FunctionCode.WRITE_SINGLE_COIL and len(request) == 5:
        return f"the value is {request[3:].hex().upper()}", "use FF00 for on and 0000 for off"
    if function.layout is RequestLayout.QUANTITY and len(request) >= 5:
        count, limit = int.from_bytes(request[3:5]), MAX_QUANTITY[function]
        if not 1 <= count <= limit:
            return f"the quantity is {count}", f"use 1 to {limit}"
    return f"its length of {len(request)} bytes is wrong", "send as many values as quantity and byte count announce"


def _request(request: bytes) -> str:
    function = _function(request)
    if function is None:
        return f"sent function {request[0]}"
    if function.table is None or len(request) < 5:
        return f"sent function {int(function)} ({function.name.lower().replace('_', ' ')})"
    if function is FunctionCode.READ_WRITE_MULTIPLE_REGISTERS:
        return f"wrote {_named(function, _write_numbers(request))} and read {_named(function, _numbers(request))}"
    return f"{'wrote' if function.is_write else 'read'} {_named(function, _numbers(request))}"


def _named(function: FunctionCode, numbers: Block) -> str:
    assert function.table is not None
    first, last = numbers
    return f"{TABLE_NAMES[function.table]}{'s' if last > first else ''} {_span(numbers)}"


def _function(request: bytes) -> FunctionCode | None:
    return next((function for function in FunctionCode if function == request[0]), None)


def _numbers(request: bytes) -> Block:
    """Return the numbers that the first address and quantity of a request select."""
    _, address, count = kind_of(request[:5])
    return address + 1, address + count


def _write_numbers(request: bytes) -> Block:
    """Return the numbers that function 23 writes."""
    number = int.from_bytes(request[5:7]) + 1
    return number, number + int.from_bytes(request[7:9]) - 1


def _only(blocks: list[Block], *, writable: bool) -> str:
    is_one = len(blocks) == 1 and blocks[0][0] == blocks[0][1]
    verb = ("is writable" if is_one else "are writable") if writable else ("exists" if is_one else "exist")
    return f"only {', '.join(map(_span, blocks))} {verb}"


def _span(block: Block) -> str:
    first, last = block
    return str(first) if last <= first else f"{first}-{last}"
