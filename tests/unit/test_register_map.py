from itertools import pairwise

from hilrig_modbus_edge.registers import map as registers
from hilrig_modbus_edge.registers.map import MAP, Kind, Status, Table


def _rows(table: Table) -> list[registers.Register]:
    return sorted((row for row in MAP if row.table is table), key=lambda row: row.number)


def test_the_papers_map_stands_exactly() -> None:
    """Table II: registers 1-4 torque, int16 by 1000; 5-8 position, int16 by 100; coil 1 the magnet."""
    holding = _rows(Table.HOLDING_REGISTER)[:8]
    assert [row.number for row in holding] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [row.name for row in holding] == ["tau1", "tau2", "tau3", "tau4", "theta1", "theta2", "d3", "theta4"]
    assert [row.unit for row in holding] == ["N·m", "N·m", "N", "N·m", "°", "°", "mm", "°"]
    assert [row.scale for row in holding] == [1000] * 4 + [100] * 4
    assert [row.writable for row in holding] == [True] * 4 + [False] * 4
    assert {row.kind for row in holding} == {Kind.INT16}
    magnet = _rows(Table.COIL)[0]
    assert (magnet.number, magnet.address, magnet.name, magnet.writable) == (1, 0, "magnet", True)


def test_no_two_values_share_a_register_and_names_are_distinct() -> None:
    for table in Table:
        for one, other in pairwise(_rows(table)):
            assert one.number + one.kind.words <= other.number, (one, other)
    assert len({row.name for row in MAP}) == len(MAP)


def test_input_registers_and_discrete_inputs_can_be_read_as_one_block() -> None:
    for table, end in ((Table.INPUT_REGISTER, registers.INPUT_END), (Table.DISCRETE_INPUT, registers.DISCRETE_END)):
        rows = _rows(table)
        assert rows[0].address == 0
        assert all(one.number + one.kind.words == other.number for one, other in pairwise(rows))
        assert rows[-1].address + rows[-1].kind.words == end


def test_addresses_named_in_code_are_those_of_the_map() -> None:
    by_name = {row.name: row.address for row in MAP}
    assert by_name["tau1"] == registers.TORQUE
    assert by_name["theta1"] == registers.POSITION
    assert by_name["theta4"] + 1 == registers.PAPER_END
    assert by_name["echo"] == registers.ECHO
    assert by_name["watchdog_timeout_set"] == registers.WATCHDOG == registers.EXTENDED_END - 1
    assert by_name["magnet"] == registers.MAGNET
    assert by_name["reset"] == registers.RESET


def test_every_status_bit_is_explained() -> None:
    assert set(registers.STATUS_TEXT) == set(Status)
    names = [row for row in MAP if row.table is Table.DISCRETE_INPUT]
    for flag in Status:
        assert names[flag.bit_length() - 1].text == registers.STATUS_TEXT[flag]
