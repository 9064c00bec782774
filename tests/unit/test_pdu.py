"""Unit tests of the functions against pymodbus, which encodes the requests and decodes the responses."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadDiscreteInputsRequest,
    WriteMultipleCoilsRequest,
    WriteSingleCoilRequest,
)
from pymodbus.pdu.exceptionresponse import ExceptionResponse
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest
from pymodbus.pdu.register_message import (
    MaskWriteRegisterRequest,
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    ReadWriteMultipleRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from hilrig_modbus_edge.registers.map import INPUT_END
from hilrig_modbus_edge.server import pdu
from support.device_bench import Bench

WORDS = st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=4)
DECODER = DecodePDU(is_server=False)


def ask(bench: Bench, request: ModbusPDU) -> ModbusPDU:
    """Execute a request of pymodbus and return the response as pymodbus decodes it."""
    client = next(iter(bench.device.clients), None) or bench.connect()
    data = bytes((request.function_code,)) + request.encode()
    answer = pdu.execute(bench.device, client, data, bench.clock.monotonic_ns())
    decoded = DECODER.decode(answer)
    assert decoded is not None
    return decoded


def fresh() -> Bench:
    bench = Bench()
    bench.state(1)
    return bench


@given(WORDS)
def test_written_registers_are_read_back(words: list[int]) -> None:
    bench, count = fresh(), len(words)
    written = ask(bench, WriteMultipleRegistersRequest(address=0, registers=words))
    assert (written.address, written.count) == (0, count)
    assert ask(bench, ReadHoldingRegistersRequest(address=0, count=count)).registers == words
    request = ReadWriteMultipleRegistersRequest(
        read_address=0, read_count=count, write_address=0, write_registers=words[::-1]
    )
    assert ask(bench, request).registers == words[::-1]


@given(st.integers(0, 3), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF))
def test_single_and_masked_writes(address: int, word: int, and_mask: int, or_mask: int) -> None:
    bench = fresh()
    written = ask(bench, WriteSingleRegisterRequest(address=address, registers=[word]))
    assert (written.address, written.registers) == (address, [word])
    masked = ask(bench, MaskWriteRegisterRequest(address=address, and_mask=and_mask, or_mask=or_mask))
    assert (masked.address, masked.and_mask, masked.or_mask) == (address, and_mask, or_mask)  # type: ignore[attr-defined]
    wanted = (word & and_mask) | (or_mask & (0xFFFF - and_mask))
    assert ask(bench, ReadHoldingRegistersRequest(address=address, count=1)).registers == [wanted]


@pytest.mark.parametrize("on", [True, False])
def test_coils(on: bool) -> None:
    bench = fresh()
    assert list(ask(bench, WriteSingleCoilRequest(address=0, bits=[on])).bits) == [on]
    assert ask(bench, ReadCoilsRequest(address=0, count=1)).bits[0] == on
    written = ask(bench, WriteMultipleCoilsRequest(address=0, bits=[not on]))
    assert (written.address, written.count) == (0, 1)
    assert ask(bench, ReadCoilsRequest(address=0, count=1)).bits[0] != on


@given(st.integers(0, 15), st.integers(1, 16))
def test_discrete_inputs_are_bits_of_status_register(address: int, count: int) -> None:
    bench = fresh()
    reply = ask(bench, ReadDiscreteInputsRequest(address=address, count=count))
    if address + count > 16:
        assert (reply.function_code, reply.exception_code) == (0x82, 2)
        return
    [status] = ask(bench, ReadInputRegistersRequest(address=1, count=1)).registers
    assert list(reply.bits[:count]) == [bool(status >> bit & 1) for bit in range(address, address + count)]


@given(st.integers(0, INPUT_END + 4), st.integers(1, INPUT_END + 24))
def test_input_registers_are_slices_of_one_block(address: int, count: int) -> None:
    bench = fresh()
    whole = ask(bench, ReadInputRegistersRequest(address=0, count=INPUT_END)).registers
    reply = ask(bench, ReadInputRegistersRequest(address=address, count=count))
    if address + count > INPUT_END:
        assert isinstance(reply, ExceptionResponse)
        assert reply.exception_code == 2
    else:
        assert reply.registers == whole[address : address + count]


@pytest.mark.parametrize(("code", "objects"), [(1, [0, 1, 2]), (2, [0, 1, 2, 4, 5]), (3, [0, 1, 2, 4, 5])])
def test_identification_streams(code: int, objects: list[int]) -> None:
    reply = ask(fresh(), ReadDeviceInformationRequest(read_code=code, object_id=0))
    assert list(reply.information) == objects  # type: ignore[attr-defined]
    assert reply.information[0] == b"hilrig"  # type: ignore[attr-defined]
    # A stream starts at the requested object, or at the first one if that does not exist.
    later = ask(fresh(), ReadDeviceInformationRequest(read_code=code, object_id=2))
    assert list(later.information) == [number for number in objects if number >= 2]  # type: ignore[attr-defined]
    nowhere = ask(fresh(), ReadDeviceInformationRequest(read_code=code, object_id=99))
    assert list(nowhere.information) == objects  # type: ignore[attr-defined]


@given(st.binary(min_size=1, max_size=253))
def test_every_request_gets_a_response(request: bytes) -> None:
    bench = fresh()
    reply = pdu.execute(bench.device, bench.connect(), request, bench.clock.monotonic_ns())
    assert reply[0] & 0x7F == request[0] & 0x7F
    assert 2 <= len(reply) <= 253
    if reply[0] & 0x80:
        assert reply[1] in (1, 2, 3, 4)


def test_wrong_address_takes_precedence_over_missing_state() -> None:
    bench = Bench()
    client = bench.connect()

    def code(request: str) -> int:
        return pdu.execute(bench.device, client, bytes.fromhex(request), bench.clock.monotonic_ns())[1]

    # No state was received yet.
    assert code("17 00 04 00 04 00 00 00 01 02 00 2A") == 4
    assert code("17 00 04 00 04 00 08 00 01 02 00 2A") == 2
    assert code("03 00 04 00 05") == 2
    assert code(f"04 {INPUT_END - 1:04X} 00 02") == 2
    assert bench.device.lease.holder is None
