from itertools import pairwise

from hilrig_modbus_edge.registers.map import (
    DISCRETE_END,
    ECHO_ADDRESS,
    EXTENDED_END,
    INPUT_END,
    MAGNET_COIL,
    MAP,
    PAPER_END,
    POSITION_ADDRESS,
    RESET_COIL,
    STATUS_TEXT,
    TORQUE_ADDRESS,
    WATCHDOG_ADDRESS,
    Register,
    RegisterTable,
    Status,
    ValueType,
)


def _rows(table: RegisterTable) -> list[Register]:
    return sorted((row for row in MAP if row.table is table), key=lambda row: row.number)


def test_map_of_the_paper_is_exact() -> None:
    """Table II: registers 1-4 torque, int16, scale 1000; 5-8 position, int16, scale 100; coil 1 magnet."""
    holding = _rows(RegisterTable.HOLDING_REGISTER)[:8]
    assert [row.number for row in holding] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [row.name for row in holding] == ["tau1", "tau2", "tau3", "tau4", "theta1", "theta2", "d3", "theta4"]
    assert [row.unit for row in holding] == ["N·m", "N·m", "N", "N·m", "°", "°", "mm", "°"]
    assert [row.scale for row in holding] == [1000] * 4 + [100] * 4
    assert [row.writable for row in holding] == [True] * 4 + [False] * 4
    assert {row.type for row in holding} == {ValueType.INT16}
    magnet = _rows(RegisterTable.COIL)[0]
    assert (magnet.number, magnet.address, magnet.name, magnet.writable) == (1, 0, "magnet", True)


def test_values_share_no_register_and_names_are_distinct() -> None:
    for table in RegisterTable:
        for one, other in pairwise(_rows(table)):
            assert one.number + one.type.words <= other.number, (one, other)
    assert len({row.name for row in MAP}) == len(MAP)


def test_inputs_can_be_read_as_one_block() -> None:
    for table, end in ((RegisterTable.INPUT_REGISTER, INPUT_END), (RegisterTable.DISCRETE_INPUT, DISCRETE_END)):
        rows = _rows(table)
        assert rows[0].address == 0
        assert all(one.number + one.type.words == other.number for one, other in pairwise(rows))
        assert rows[-1].address + rows[-1].type.words == end


def test_address_constants_equal_those_of_the_map() -> None:
    by_name = {row.name: row.address for row in MAP}
    assert by_name["tau1"] == TORQUE_ADDRESS
    assert by_name["theta1"] == POSITION_ADDRESS
    assert by_name["theta4"] + 1 == PAPER_END
    assert by_name["echo"] == ECHO_ADDRESS
    assert by_name["watchdog_timeout_set"] == WATCHDOG_ADDRESS == EXTENDED_END - 1
    assert by_name["magnet"] == MAGNET_COIL
    assert by_name["reset"] == RESET_COIL


def test_every_status_bit_has_a_description() -> None:
    assert set(STATUS_TEXT) == set(Status)
    names = [row for row in MAP if row.table is RegisterTable.DISCRETE_INPUT]
    for flag in Status:
        assert names[flag.bit_length() - 1].text == STATUS_TEXT[flag]
