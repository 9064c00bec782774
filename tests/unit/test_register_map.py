"""The register map, and its agreement with the device and with the examples."""

import inspect
import re
import struct
from itertools import pairwise
from pathlib import Path

import pytest

from hilrig_modbus_edge.device import command_publisher, device
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_modbus_edge.registers import image
from hilrig_modbus_edge.registers.map import (
    DISCRETE_END,
    ECHO_ADDRESS,
    EXTENDED_END,
    INPUT_END,
    MAP,
    MIRROR_ADDRESS,
    MIRROR_END,
    PAPER_END,
    POSITION_ADDRESS,
    SEPARATE_WRITES,
    SWITCH_ADDRESS,
    SWITCH_END,
    TORQUE_ADDRESS,
    Register,
    Status,
    ValueType,
    address_of,
    rows_of,
    struct_of,
)
from hilrig_schemas import TorqueCommand
from support.device_bench import MS, Bench

EXAMPLES = Path(__file__).parents[2] / "examples"
HOLDING, INPUT = RegisterTable.HOLDING_REGISTER, RegisterTable.INPUT_REGISTER


def test_map_of_the_paper_is_exact() -> None:
    """Table II: registers 1-4 torque, int16, scale 1000; 5-8 position, int16, scale 100; coil 1 magnet."""
    holding = rows_of(HOLDING)[:8]
    assert [row.number for row in holding] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [row.name for row in holding] == ["tau1", "tau2", "tau3", "tau4", "theta1", "theta2", "d3", "theta4"]
    assert [row.unit for row in holding] == ["N·m", "N·m", "N", "N·m", "°", "°", "mm", "°"]
    assert [row.scale for row in holding] == [1000] * 4 + [100] * 4
    assert [row.writable for row in holding] == [True] * 4 + [False] * 4
    assert {row.type for row in holding} == {ValueType.INT16}
    magnet = rows_of(RegisterTable.COIL)[0]
    assert (magnet.number, magnet.address, magnet.name, magnet.writable) == (1, 0, "magnet", True)
    assert SEPARATE_WRITES == 5


def test_values_share_no_register_and_names_are_distinct() -> None:
    for table in RegisterTable:
        for one, other in pairwise(rows_of(table)):
            assert one.end <= other.address, (one, other)
    assert len({row.name for row in MAP}) == len(MAP)


def test_ranges_that_are_read_as_one_block_have_no_gap() -> None:
    for table, start, end in (
        (HOLDING, TORQUE_ADDRESS, PAPER_END),
        (HOLDING, ECHO_ADDRESS, EXTENDED_END),
        (HOLDING, MIRROR_ADDRESS, MIRROR_END),
        (HOLDING, SWITCH_ADDRESS, SWITCH_END),
        (INPUT, 0, INPUT_END),
        (RegisterTable.DISCRETE_INPUT, 0, DISCRETE_END),
    ):
        covered = [at for row in rows_of(table) for at in range(row.address, row.end) if start <= at < end]
        assert covered == list(range(start, end))


def test_words_of_a_type_are_those_of_its_layout() -> None:
    words = {kind.name: kind.words for kind in ValueType}
    assert words == {"BIT": 1, "INT16": 1, "UINT16": 1, "UINT32": 2, "FLOAT32": 2}
    assert struct_of(HOLDING, TORQUE_ADDRESS, POSITION_ADDRESS).format == ">hhhh"
    assert struct_of(INPUT).size == 2 * INPUT_END


def test_every_status_bit_is_a_discrete_input() -> None:
    texts = [row.text for row in rows_of(RegisterTable.DISCRETE_INPUT)]
    for flag in Status:
        assert texts[flag.bit_length() - 1] == flag.text
    assert texts.count("always 0") == len(texts) - len(Status)


# -- the device has exactly the registers of the map


def _bench() -> Bench:
    """Return a device each of whose input registers has another value."""
    bench = Bench()
    bench.state(
        70_000,
        position=(1.0, -1.0, 0.125, 2.0),
        velocity=(0.5, 0.25, -0.25, 1e300),
        effort=(1.0, 2.0, -3.5, 0.25),
        loop_latency_ns=20_000_000,
        limit_flags=0b1_0010_0001,
    )
    bench.write(bench.connect(), 0, 1)
    bench.clock.advance(12 * MS)
    return bench


def test_each_input_register_has_its_value() -> None:
    bench = _bench()
    client = next(iter(bench.device.clients))
    expected = {
        "map_version": 1,
        "status": Status.SIMULATION_ALIVE
        | Status.SESSION_OPEN
        | Status.LEASE_HELD
        | Status.LEASE_IS_YOURS
        | Status.WATCHDOG_ON
        | Status.ON_STOP,
        "step": 70_000,
        "loop_latency": 20_000,
        "lease": 1,
        "watchdog": 2,
        "watchdog_timeout": 1000,
        "session": 1,
        "stops": 0b1_0010_0001,
        "state_age": 12,
        "position_theta1": pytest.approx(57.29578),
        "position_theta2": pytest.approx(-57.29578),
        "position_d3": 125.0,
        "position_theta4": pytest.approx(114.59156),
        "velocity_theta1": pytest.approx(28.64789),
        "velocity_theta2": pytest.approx(14.323945),
        "velocity_d3": -250.0,
        "velocity_theta4": float("inf"),
        "applied_tau1": 1.0,
        "applied_tau2": 2.0,
        "applied_tau3": -3.5,
        "applied_tau4": 0.25,
    }
    found = {}
    for row in rows_of(INPUT):
        words = bench.read(client, row.address, row.type.words, INPUT)
        [found[row.name]] = struct.unpack(f">{row.type.value}", struct.pack(f">{len(words)}H", *words))
    assert found == expected


def _value(row: Register) -> list[int]:
    # A watchdog timeout has bounds, and a mirror of a coil is 0 or 1.
    return [150] if row.name == "watchdog_timeout_set" else [1] if row.mirrors else [row.number]


def test_device_has_exactly_the_holding_registers() -> None:
    bench = _bench()
    client, other = next(iter(bench.device.clients)), set(range(310))
    for row in rows_of(HOLDING):
        other -= set(range(row.address, row.end))
        bench.device.check_readable(row.address, row.type.words)
        assert len(bench.read(client, row.address, row.type.words)) == row.type.words
        if row.writable:
            bench.device.check_writable(row.address, row.type.words)
            bench.write(client, row.address, *_value(row))
            assert bench.read(client, row.address, row.type.words) == _value(row)
            continue
        for write in (bench.device.check_writable, lambda address, _: bench.write(client, address, 1)):
            with pytest.raises(ModbusError, match="02"):
                write(row.address, row.type.words)
    for address in other:
        for access in (
            bench.device.check_readable,
            bench.device.check_writable,
            lambda address, count: bench.read(client, address, count),
            lambda address, _: bench.write(client, address, 1),
        ):
            with pytest.raises(ModbusError, match="02"):
                access(address, 1)


def test_mirrors_are_the_input_registers() -> None:
    bench = _bench()
    client = next(iter(bench.device.clients))
    inputs = {row.name: row for row in rows_of(INPUT)}
    mirrors = [row for row in rows_of(HOLDING) if row.mirrors in inputs]
    assert [row.mirrors for row in mirrors] == list(inputs)
    for row in mirrors:
        source = inputs[row.mirrors]
        assert (row.number - 200, row.type, row.unit) == (source.number, source.type, source.unit)
        words = bench.read(client, source.address, source.type.words, INPUT)
        assert bench.read(client, row.address, row.type.words) == words
    assert bench.read(client, MIRROR_ADDRESS, INPUT_END) == bench.read(client, 0, INPUT_END, INPUT)


def test_device_has_exactly_the_bits_and_input_registers() -> None:
    bench = _bench()
    client, now_ns = next(iter(bench.device.clients)), bench.clock.monotonic_ns()
    for table in (RegisterTable.COIL, RegisterTable.DISCRETE_INPUT):
        rows = {row.address: row for row in rows_of(table)}
        for address in range(200):
            if address in rows:
                bench.device.read_bits(client, table, address, 1)
                continue
            with pytest.raises(ModbusError, match="02"):
                bench.device.read_bits(client, table, address, 1)
            if table is RegisterTable.COIL:
                with pytest.raises(ModbusError, match="02"):
                    bench.device.write_coil(client, address, True, now_ns)
    for row in rows_of(RegisterTable.COIL):
        bench.device.write_coil(client, row.address, True, now_ns)
    with pytest.raises(ModbusError, match="02"):
        bench.read(client, INPUT_END, 1, INPUT)


# -- examples import nothing of hilrig, so their addresses are numbers


@pytest.mark.parametrize(
    ("file", "pattern", "name"),
    [
        ("hold_position.py", r"read_holding_registers\((\d+), count=4\)", "theta1"),
        ("hold_position.py", r"write_registers\((\d+),", "tau1"),
        ("hold_position.c", r"modbus_read_registers\(rig, (\d+), JOINTS", "theta1"),
        ("hold_position.c", r"modbus_write_registers\(rig, (\d+), JOINTS", "tau1"),
        ("hold_position.js", r"readHoldingRegisters\((\d+), 4\)", "theta1"),
        ("hold_position.js", r"writeRegisters\((\d+),", "tau1"),
        ("pick_and_place.py", r"read_holding_registers\((\d+), count=4\)", "theta1"),
        ("pick_and_place.py", r"write_registers\((\d+),", "tau1"),
        ("pick_and_place.py", r"read_address=(\d+), read_count=4", "theta1"),
        ("pick_and_place.py", r"write_address=(\d+)", "tau1"),
        ("pick_and_place.py", r"write_coil\((\d+),", "magnet"),
        ("openplc/mbconfig.cfg", r'Holding_Registers_Read_Start = "(\d+)"', "theta1"),
        ("openplc/mbconfig.cfg", r'Holding_Registers_Start = "(\d+)"', "tau1"),
        ("openplc/mbconfig.cfg", r'Coils_Start = "(\d+)"', "magnet"),
    ],
)
def test_addresses_of_examples_are_those_of_the_map(file: str, pattern: str, name: str) -> None:
    found = re.findall(pattern, (EXAMPLES / file).read_text(encoding="utf-8"))
    assert set(found) == {str(address_of(name))}


def test_every_status_bit_is_set_somewhere() -> None:
    source = inspect.getsource(image) + inspect.getsource(device)
    assert [flag.name for flag in Status if f"status |= Status.{flag.name}\n" not in source] == []


def test_internal_command_has_no_field_of_a_write() -> None:
    every_command = {"rig", "session", "seq", "effort", "magnet", "safe", "echo", "resets", "sent_ns", "wall_ns"}
    of_the_link = {"command_injected_ns"}
    of_a_write = set(command_publisher._FIELDS_OF_A_WRITE)
    assert set(TorqueCommand.DESCRIPTOR.fields_by_name) == every_command | of_the_link | of_a_write
    assert not of_a_write & every_command
