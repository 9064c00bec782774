import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import ModbusTcpClient

from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_modbus_edge.registers import codec
from hilrig_modbus_edge.registers.map import address_of
from support.device_bench import Bench

COUNT = st.integers(-32767, 32767)
NUMBER = st.floats(allow_nan=True, allow_infinity=True)


def test_torque_register_has_scale_1000() -> None:
    assert codec.effort_of(struct.pack(">4h", 1000, -1, 32767, -32768)) == (1.0, -0.001, 32.767, -32.768)


@given(st.tuples(COUNT, COUNT, COUNT, COUNT))
def test_efforts_survive_encoding(counts: tuple[int, ...]) -> None:
    words = struct.pack(">4h", *counts)
    assert codec.words_of_effort(codec.effort_of(words)) == (words, False)


@given(st.tuples(COUNT, COUNT, COUNT, COUNT))
def test_positions_survive_encoding(counts: tuple[int, ...]) -> None:
    words = struct.pack(">4h", *counts)
    assert codec.words_of_position(codec.position_of(words)) == (words, False)


def test_position_registers_have_scale_100() -> None:
    words, saturated = codec.words_of_position((math.pi / 2, -math.pi / 6, 0.2, math.radians(327.67)))
    assert struct.unpack(">4h", words) == (9000, -3000, 20000, 32767)
    assert not saturated


@pytest.mark.parametrize(("degrees", "count"), [(360.0, 32767), (-360.0, -32767), (-327.68, -32767)])
def test_position_beyond_register_saturates(degrees: float, count: int) -> None:
    words, saturated = codec.words_of_position((0.0, 0.0, 0.0, math.radians(degrees)))
    assert struct.unpack(">4h", words) == (0, 0, 0, count)
    assert saturated


@given(st.tuples(NUMBER, NUMBER, NUMBER, NUMBER))
def test_any_position_is_encoded(position: tuple[float, ...]) -> None:
    words, saturated = codec.words_of_position(position)
    counts = struct.unpack(">4h", words)
    for value, count, scale in zip(position, counts, codec.COUNTS_PER_UNIT, strict=True):
        if math.isnan(value):
            assert (count, saturated) == (0, True)
        elif abs(value * scale) > 32767.5:
            assert (count, saturated) == (math.copysign(32767, value), True)
        else:
            assert abs(value * scale - count) <= 0.5


@given(st.tuples(*[st.floats(width=32, allow_nan=False)] * 4))
def test_float_registers_are_decoded_by_pymodbus(efforts: tuple[float, ...]) -> None:
    bench = Bench()
    bench.state(1, effort=efforts)
    registers = bench.read(bench.connect(), address_of("applied_tau1"), 8, RegisterTable.INPUT_REGISTER)
    for index, effort in enumerate(efforts):
        pair = registers[2 * index : 2 * index + 2]
        assert ModbusTcpClient.convert_from_registers(pair, ModbusTcpClient.DATATYPE.FLOAT32) == effort
