"""Settings of a rig whose controller is a Modbus server: notations of registers, refusals, and the description."""

import pytest

from hilrig_modbus_edge.registers.map import MAGNET_COIL, PAPER_END, POSITION_ADDRESS, TORQUE_ADDRESS
from hilrig_runtime.config.controller import RegisterBlock, RegistersConfig, parse_controller, parse_register
from hilrig_runtime.config.lab import LabConfig, parse_lab, read_rig
from hilrig_runtime.errors import InputError

RIG = '[[rigs]]\nname = "a"\ncontroller = "plc1"\n'


@pytest.mark.parametrize(
    ("value", "table", "address", "bit"),
    [
        (4, "holding", 4, None),
        (30_000, "holding", 30_000, None),
        ("holding 40001", "holding", 40_001, None),
        ("40005", "holding", 4, None),
        ("400005", "holding", 4, None),
        ("465536", "holding", 65_535, None),
        ("30001", "input", 0, None),
        ("input 7", "input", 7, None),
        ("00001", "coil", 0, None),
        ("coil 8192", "coil", 8192, None),
        ("10003", "discrete", 2, None),
        ("40009.3", "holding", 8, 3),
        ("holding 8.15", "holding", 8, 15),
    ],
)
def test_notations_of_registers(value: int | str, table: str, address: int, bit: int | None) -> None:
    assert parse_register(value, "holding") == RegisterBlock(table, address, 1, bit)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (40_005, 'ambiguous: write "40005"'),
        (32_768, '"holding 32768"'),
        (-1, "outside 0 to 65535"),
        ("40000", "outside 0 to 65535"),
        ("4", "no address"),
        ("%MW4", "no address"),
        ("20001", "no address"),
        ("holding 65536", "outside 0 to 65535"),
        ("coil 0.1", "only an input or holding register has bits"),
        ("holding 0.16", "only an input or holding register has bits"),
    ],
)
def test_wrong_notations_are_refused(value: int | str, text: str) -> None:
    with pytest.raises(ValueError, match=text.replace("(", r"\(")):
        parse_register(value, "holding")


@pytest.mark.parametrize(
    ("address", "parsed"),
    [
        ("192.168.1.20", ("192.168.1.20", 502)),
        ("plc-1.lab:5502", ("plc-1.lab", 5502)),
        ("[fe80::1]:503", ("fe80::1", 503)),
        ("[::1]", ("::1", 502)),
    ],
)
def test_addresses_of_controllers(address: str, parsed: tuple[str, int]) -> None:
    assert parse_controller(address) == parsed


@pytest.mark.parametrize("address", ["", "plc:0", "plc:65536", "plc:x", "http://plc", "::1", "a b"])
def test_wrong_addresses_are_refused(address: str) -> None:
    with pytest.raises(ValueError, match="no address of a controller"):
        parse_controller(address)


@pytest.mark.parametrize(
    ("registers", "text"),
    [
        ('torques = "coil 0"', "torques: expected a holding or input register, got coils 0–3"),
        ('positions = "input 4"', "positions: expected a holding register"),
        ('magnet = "holding 8"', "magnet: expected a coil, a discrete input, or a bit"),
        ("positions = 3", "positions .* overlaps torques"),
        ("echo = 8", "echo .* overlaps positions and step number"),
        ('magnet = "holding 7.0"', "magnet .* overlaps positions"),
        ("echo = 200", "echo: holding register 200 .* is too far from the torques"),
        ('torques = "input 0"\necho = 9', "echo: expected a register of the table of the torques"),
        ("positions = 65533", "positions: .* ends after address 65535"),
        ('format = "float32"', "positions .* overlaps torques"),
    ],
)
def test_check_refuses_registers(registers: str, text: str) -> None:
    with pytest.raises(InputError, match=text):
        parse_lab(f"{RIG}[rigs.registers]\n{registers}\n")


@pytest.mark.parametrize(
    ("lab", "text"),
    [
        ('[[rigs]]\nname = "a"\nunit = 2\n', "no effect without controller"),
        ('[[rigs]]\nname = "a"\n[rigs.registers]\necho = 9\n', "no effect without controller"),
        (RIG + '[[rigs]]\nname = "b"\ncontroller = "PLC1:502"\n', "rigs 'a' and 'b': both are clients"),
        (
            '[[rigs]]\nname = "a"\ncontroller = "localhost"\n[[rigs]]\nname = "b"\ncontroller = "127.0.0.1"\n',
            "rigs 'a' and 'b': both are clients",
        ),
        ('[[rigs]]\nname = "a"\ncontroller = "localhost:5020"\n', "is the address of a rig of this lab"),
        (RIG + "[rigs.client]\nread_lead_ms = 20.0\n", "read_lead_ms must be < sim.step_ms"),
        (
            RIG + '[rigs.registers]\ntorques = "input 0"\n[rigs.client]\ncombined_request = true\n',
            "function 23 reads holding registers",
        ),
    ],
)
def test_check_refuses_controllers(lab: str, text: str) -> None:
    with pytest.raises(InputError, match=text):
        parse_lab(lab)


def test_blocks_of_one_request() -> None:
    defaults = RegistersConfig()
    assert (defaults.written_block, defaults.read_block) == (
        RegisterBlock("holding", 4, 4),
        RegisterBlock("holding", 0, 4),
    )
    echo = RegistersConfig(echo=9)
    assert (echo.written_block, echo.read_block) == (RegisterBlock("holding", 4, 5), RegisterBlock("holding", 0, 10))
    assert echo.separate_magnet_block == RegisterBlock("coil", 0)
    for magnet, count, separate in (
        ("holding 10.3", 11, False),
        ("holding 11.3", 10, True),
        ("input 10.3", 10, True),
    ):
        beside = RegistersConfig(echo=9, magnet=magnet)
        assert (beside.read_block.count, beside.separate_magnet_block is not None) == (count, separate)
    # The positions exist: a bit after them can be read with the torques.
    assert RegistersConfig(magnet="holding 8.0").read_block.count == 9
    assert RegistersConfig(magnet="holding 9.0").read_block.count == 4
    wide = RegistersConfig(torques="30001", positions="40101", echo="30010", format="float32", magnet="none")
    assert (wide.written_block.count, wide.read_block) == (9, RegisterBlock("input", 0, 10))


def test_description_names_every_register() -> None:
    rig = parse_lab(RIG + '[rigs.registers]\necho = 9\nmagnet = "40011.3"\n').rigs[0]
    assert rig.describe_controller() == (
        "client of plc1, unit 1: writes holding registers 4–8 (40005–40009) (positions and step number), "
        "reads holding registers 0–3 (40001–40004) (torques), holding register 9 (40010) (echo), "
        "holding register 10 bit 3 (40011.3) (magnet)"
    )
    assert read_rig(rig.model_dump_json()) == rig
    assert read_rig(LabConfig().rigs[0].model_dump_json()) == LabConfig().rigs[0]


def test_default_registers_are_those_of_the_rig_itself() -> None:
    registers = RegistersConfig()
    assert (registers.torque_block.address, registers.position_block.address) == (TORQUE_ADDRESS, POSITION_ADDRESS)
    assert registers.position_block.end == PAPER_END
    assert registers.magnet_block == RegisterBlock("coil", MAGNET_COIL)
