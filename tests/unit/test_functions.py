"""The table of functions agrees with the handlers, with the request log and with the specification."""

from unittest.mock import Mock

import pytest

from generate_conformance import RULES
from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.protocol.functions import FunctionCode, RegisterTable
from hilrig_modbus_edge.request_log import RequestLog
from hilrig_modbus_edge.server import pdu

EXAMPLES = {
    1: ("01 0000 0008", 0, 8),
    2: ("02 0003 0004", 3, 4),
    3: ("03 0004 0004", 4, 4),
    4: ("04 0002 0002", 2, 2),
    5: ("05 0064 FF00", 100, 1),
    6: ("06 0002 1234", 2, 1),
    15: ("0F 0064 0001 01 01", 100, 1),
    16: ("10 0000 0004 08 0001 0002 0003 0004", 0, 4),
    22: ("16 0001 FFFF 0000", 1, 1),
    23: ("17 0004 0003 0000 0002 04 0001 0002", 4, 3),
    43: ("2B 0E 01 00", 0, 0),
}
"""A valid request of each function, with its address and quantity by the specification; function 23: those read."""

FUNCTIONS = pytest.mark.parametrize("function", FunctionCode, ids=lambda function: function.name)


def recorder() -> Mock:
    """Return a device without registers that records its calls."""
    device = Mock(spec=Device)
    device.read_registers.side_effect = lambda *arguments: bytes(2 * arguments[-1])
    device.read_bits.return_value = 0
    return device


def test_every_function_has_an_example() -> None:
    assert set(EXAMPLES) == set(FunctionCode)


@FUNCTIONS
def test_access_and_table_are_those_of_the_handler(function: FunctionCode) -> None:
    request, device = bytes.fromhex(EXAMPLES[function][0]), recorder()
    response = pdu.execute(device, Mock(spec=Client), request, 0)
    assert response[0] == function
    reads = device.read_registers.call_args_list + device.read_bits.call_args_list
    tables = {call.args[1] for call in reads}
    tables |= {RegisterTable.HOLDING_REGISTER} if device.write_registers.called else set()
    tables |= {RegisterTable.COIL} if device.write_coil.called else set()
    assert tables == ({function.table} if function.table else set())
    assert function.is_write == (device.write_registers.called or device.write_coil.called)
    # The response to a write repeats the beginning of the request; any other response has values.
    assert function.is_read == (not request.startswith(response))


@FUNCTIONS
def test_log_has_the_address_and_quantity(function: FunctionCode) -> None:
    request, address, count = EXAMPLES[function]
    log = RequestLog("rig1")
    log.record(bytes.fromhex(request), 1, 2, 0, "10.0.0.1:1")
    [kind] = log.drain(0, 0).kinds
    assert (kind.function, kind.address, kind.count) == (function, address, count)


@FUNCTIONS
def test_conformance_has_a_served_and_a_refused_request(function: FunctionCode) -> None:
    answers = {bytes.fromhex(rule.answer)[0] for rule in RULES if bytes.fromhex(rule.request)[0] == function}
    assert answers == {function, function | 0x80}


def test_other_codes_are_illegal_functions() -> None:
    for code in set(range(256)) - set(FunctionCode):
        assert pdu.execute(recorder(), Mock(spec=Client), bytes((code, 0, 0, 0, 1)), 0) == bytes((code | 0x80, 1))
