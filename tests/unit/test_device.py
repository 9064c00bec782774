"""Unit tests of `Device` with a manual clock and states of the test."""

import re
import struct

import pytest
from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_modbus_edge.registers.map import (
    ECHO_ADDRESS,
    EXTENDED_END,
    INPUT_END,
    MAGNET_COIL,
    PAPER_END,
    POSITION_ADDRESS,
    RESET_COIL,
    SWITCH_ADDRESS,
    Status,
    address_of,
)
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import Event, JointState
from support.device_bench import MS, Bench


@pytest.fixture
def bench() -> Bench:
    bench = Bench()
    bench.state(1)
    return bench


# -- commands and their timestamps


def test_write_is_published_as_one_command(bench: Bench) -> None:
    bench.write(bench.connect(), 0, 1000, 0xFFFF, 0, 4)
    [command] = bench.commands
    assert list(command.effort) == [1.0, -0.001, 0.0, 0.004]
    assert (command.seq, command.safe, command.controller) == (1, False, "10.0.0.1:1000")
    assert command.session == bench.session.id


def test_unwritten_registers_keep_their_torque(bench: Bench) -> None:
    client = bench.connect()
    bench.write(client, 0, 1, 2, 3, 4)
    bench.write(client, 2, 30)
    assert list(bench.commands[-1].effort) == [0.001, 0.002, 0.03, 0.004]
    assert bench.read(client, 0, 4) == [1, 2, 30, 4]


def test_basis_is_last_state_served_to_the_connection(bench: Bench) -> None:
    client, other = bench.connect(), bench.connect(port=2000)
    bench.state(5)
    arrived_ns = bench.clock.monotonic_ns()
    bench.clock.advance(3)
    bench.read(client, 4, 4)
    bench.clock.advance(4)
    bench.state(6)
    bench.read(other, 4, 4)
    bench.clock.advance(5)
    bench.write(client, 0, 1)
    command = bench.commands[-1]
    assert (command.basis_incarnation, command.basis_step) == (7, 5)
    stamps = (command.state_arrived_ns, command.state_served_ns, command.write_arrived_ns, command.sent_ns)
    assert [stamp - arrived_ns for stamp in stamps] == [0, 3, 12, 12]


@pytest.mark.parametrize("reconnects", [True, False])
def test_basis_is_never_from_an_earlier_session(reconnects: bool) -> None:
    bench = Bench(lease_ns=1_000 * MS, grace_ns=2_000 * MS)
    bench.state(5)
    client = bench.connect()
    bench.read(client, 4, 4)
    bench.write(client, 0, 1)
    assert bench.commands[-1].basis_step == 5
    if reconnects:
        bench.device.disconnect(client, "closed")
    bench.clock.advance(4_000 * MS)
    bench.device.check(bench.clock.monotonic_ns())
    bench.clock.advance(4_000 * MS)
    bench.device.check(bench.clock.monotonic_ns())
    assert bench.device.session is None
    if reconnects:
        client = bench.connect(port=1001)
    bench.write(client, 0, 2)
    assert bench.commands[-1].basis_step == 0
    bench.state(6)
    bench.read(client, 4, 4)
    bench.write(client, 0, 3)
    assert bench.commands[-1].basis_step == 6


def test_read_in_the_session_of_another_is_no_basis(bench: Bench) -> None:
    holder, next_one = bench.connect(), bench.connect(host="10.0.0.2")
    bench.read(holder, 4, 4)
    bench.write(holder, 0, 1)
    bench.read(next_one, 4, 4)
    bench.device.disconnect(holder, "closed")
    bench.write(next_one, 0, 2)
    assert bench.commands[-1].basis_step == 0
    assert bench.commands[-1].controller == next_one.address
    bench.read(next_one, 4, 4)
    bench.write(next_one, 0, 3)
    assert bench.commands[-1].basis_step == 1


def basis(bench: Bench) -> tuple[int, bool]:
    """Step of the basis of the last command, and whether another connection was served it."""
    return bench.commands[-1].basis_step, bench.commands[-1].basis_on_other_connection


def test_writer_without_reads_uses_basis_of_its_controller(bench: Bench) -> None:
    reader, writer, stranger = bench.connect(), bench.connect(port=2), bench.connect(host="10.0.0.2")
    bench.state(9)
    bench.read(reader, 4, 1)
    bench.write(writer, 0, 1)
    # The state was read before the session began: by another program, perhaps.
    assert basis(bench) == (0, False)
    bench.read(reader, 4, 1)
    bench.write(writer, 0, 1)
    assert basis(bench) == (9, True)
    bench.read(writer, 4, 1)
    bench.state(10)
    bench.read(reader, 4, 1)
    bench.write(writer, 0, 1)
    assert basis(bench) == (9, False)
    bench.device.disconnect(writer, "done")
    bench.write(reader, 0, 1)
    assert basis(bench) == (10, False)
    bench.device.disconnect(reader, "done")
    bench.write(stranger, 0, 1)
    assert basis(bench) == (0, False)


def test_first_command_of_a_session_has_no_foreign_basis() -> None:
    """A program on the same host that only reads continues between two sessions."""
    bench = Bench(grace_ns=2_000 * MS)
    bench.state(5)
    display = bench.connect(port=2)
    for port in (3, 4):
        writer = bench.connect(port=port)
        bench.read(display, 4, 4)
        bench.write(writer, 0, port)
        assert basis(bench) == (0, False)
        bench.read(display, 4, 4)
        bench.write(writer, 0, port)
        assert basis(bench) == (5, True)
        bench.device.disconnect(writer, "closed")
        bench.wait(2_000)
        assert bench.device.session is None


def test_internal_command_clears_the_mark_of_the_basis(bench: Bench) -> None:
    reader, writer = bench.connect(), bench.connect(port=2)
    bench.write(writer, 0, 1)
    bench.read(reader, 4, 1)
    bench.write(writer, 0, 1)
    assert basis(bench) == (1, True)
    bench.wait(1000)
    assert bench.commands[-1].safe
    assert basis(bench) == (0, False)
    bench.write(writer, 0, 1)
    assert basis(bench) == (1, True)


def test_one_shot_connections_of_a_host_are_one_loop(bench: Bench) -> None:
    one_shot(bench, 1)
    for step in (11, 12):
        bench.state(step)
        reader = bench.connect(port=step)
        bench.read(reader, 4, 4)
        bench.device.disconnect(reader, "done")
        one_shot(bench, 2)
        assert basis(bench) == (step, True)
    assert bench.kinds().count("SESSION_START") == 1


# -- identity of controllers


def test_certificate_names_the_controller_of_all_its_hosts(bench: Bench) -> None:
    arm, other = (bench.connect(host=f"10.0.0.{number}", certificate="arm") for number in (1, 2))
    assert arm.controller is other.controller
    assert arm.controller.name == "CN=arm"
    assert bench.connect(port=2).controller is not arm.controller
    bench.write(other, 0, 1)
    bench.read(arm, 4, 4)
    bench.write(other, 0, 1)
    assert basis(bench) == (1, True)


@pytest.mark.parametrize(("lease", "same"), [("controller", True), ("connection", False)])
def test_setting_makes_each_connection_a_controller(lease: str, same: bool) -> None:
    bench = Bench(lease=lease)
    bench.state(1)
    reader, writer = bench.connect(), bench.connect(port=2)
    assert (reader.controller is writer.controller) == same
    bench.write(writer, 0, 1)
    bench.read(reader, 4, 4)
    bench.write(writer, 0, 1)
    assert basis(bench) == ((1, True) if same else (0, False))


def test_session_keeps_its_controller_among_many_hosts(bench: Bench) -> None:
    one_shot(bench, 1)
    for number in range(2, 80):
        bench.device.disconnect(bench.connect(host=f"10.0.0.{number}"), "done")
    one_shot(bench, 2)
    assert bench.kinds().count("SESSION_START") == 1


def test_reason_of_each_refusal_is_known_in_advance(bench: Bench) -> None:
    """`authorize` has no effect: it can be asked before a client writes."""
    access, now_ns = bench.device._write_access, bench.clock.monotonic_ns()
    holder, other, observer = bench.connect(), bench.connect(host="10.0.0.2"), bench.connect(port=3, may_write=False)
    assert access.authorize(holder, 0, 4, now_ns) is None
    bench.write(holder, 0, 1)
    for client, reason, code in ((other, "10.0.0.1:1000 holds the lease", 6), (observer, "read-only", 1)):
        for _ in range(2):
            refusal = access.authorize(client, 0, 4, now_ns)
            assert refusal is not None
            assert refusal.reason.startswith(reason)
            assert refusal.code == code
    bench.device.release("revoked")
    refusal = access.authorize(holder, 0, 4, now_ns)
    assert refusal is not None
    assert refusal.reason == "its lease was revoked; write again in 5.0 s"
    bench.write(other, 0, 1)
    bench.device.disconnect(other, "done")
    refusal = access.authorize(bench.connect(host="10.0.0.3"), 0, 4, now_ns)
    assert refusal is not None
    assert refusal.reason == "10.0.0.2 acquired the lease less than 1 s ago; write again in 1 s"
    assert [event for event in bench.kinds() if event == "LEASE_REFUSED"] == []


def test_pipelined_write_is_not_based_on_preceding_read(bench: Bench) -> None:
    """The write was sent before the response to the read."""
    client = bench.connect()
    bench.state(2)
    bench.read(client, 4, 4)
    bench.clock.advance(1)
    bench.state(3)
    now_ns = bench.clock.monotonic_ns()
    client.record_request(now_ns)
    bench.device.read_registers(client, RegisterTable.HOLDING_REGISTER, 4, 4)
    bench.device.write_registers(client, 0, b"\0\1", now_ns)
    assert bench.commands[-1].basis_step == 2
    assert bench.commands[-1].state_served_ns < bench.commands[-1].write_arrived_ns


@pytest.mark.parametrize("own", [True, False])
def test_write_received_before_a_read_is_not_based_on_it(bench: Bench, own: bool) -> None:
    """Several requests wait in the kernel while the edge is stalled: the edge serves the read first."""
    reader = bench.connect()
    writer = reader if own else bench.connect(port=2)
    bench.write(writer, 0, 1)
    times_ns = []
    for step in (2, 3):
        bench.clock.advance(10)
        bench.state(step)
        bench.read(reader, 4, 4)
        times_ns.append(bench.clock.monotonic_ns())
    bench.clock.advance(10)

    def basis_of_write(received_ns: int) -> tuple[int, bool]:
        now_ns = bench.clock.monotonic_ns()
        writer.record_request(now_ns)
        bench.device.write_registers(writer, 0, b"\0\1", now_ns, received_ns)
        assert bench.commands[-1].write_received_ns == received_ns
        return bench.commands[-1].basis_step, bench.commands[-1].basis_on_other_connection

    assert basis_of_write(0) == (3, not own)
    assert basis_of_write(times_ns[1]) == (3, not own)
    assert basis_of_write(times_ns[1] - 1) == (2, not own)
    assert basis_of_write(times_ns[0]) == (2, not own)
    assert basis_of_write(times_ns[0] - 1) == (0, False)


def test_read_of_torques_serves_no_state(bench: Bench) -> None:
    client = bench.connect()
    bench.read(client, 0, 4)
    bench.write(client, 0, 1)
    assert bench.commands[-1].basis_step == 0


def test_held_command_is_repeated_with_its_number(bench: Bench) -> None:
    client = bench.connect()
    bench.write(client, 0, 7)
    bench.wait(199)
    assert not bench.repeats
    bench.wait(1)
    bench.wait(200)
    assert bench.repeats == [bench.commands[-1]] * 2
    assert len(bench.commands) == 1


def test_next_command_carries_the_echo_value(bench: Bench) -> None:
    client = bench.connect()
    bench.write(client, 0, 1)
    bench.write(client, ECHO_ADDRESS, 4711)
    assert len(bench.commands) == 1
    bench.write(client, 0, 1)
    assert bench.commands[-1].echo == 4711


def test_reset_zeroes_torques_and_is_counted(bench: Bench) -> None:
    client = bench.connect()
    bench.write(client, 0, 1000)
    now_ns = bench.clock.monotonic_ns()
    bench.device.write_coil(client, RESET_COIL, True, now_ns)
    assert (list(bench.commands[-1].effort), bench.commands[-1].resets) == ([0, 0, 0, 0], 1)
    bench.device.write_coil(client, RESET_COIL, False, now_ns)
    assert len(bench.commands) == 2
    assert bench.device.read_bits(client, RegisterTable.COIL, RESET_COIL, 1) == 0


def test_coil_switches_the_magnet(bench: Bench) -> None:
    client = bench.connect()
    bench.device.write_coil(client, MAGNET_COIL, True, bench.clock.monotonic_ns())
    assert bench.commands[-1].magnet
    assert bench.device.read_bits(client, RegisterTable.COIL, MAGNET_COIL, 1) == 1


# -- lease


def test_register_switches_the_magnet(bench: Bench) -> None:
    client = bench.connect()
    for value, on in ((1, True), (0, False), (0xFF00, True)):
        bench.write(client, SWITCH_ADDRESS, value)
        assert bench.commands[-1].magnet is on
        assert bench.read(client, SWITCH_ADDRESS, 1) == [on]
        assert bench.device.read_bits(client, RegisterTable.COIL, 0, 1) == on


def test_reset_register_resets_once_per_change(bench: Bench) -> None:
    """A scanner writes the same registers in each cycle."""
    client = bench.connect()
    bench.write(client, 0, 500)
    for _ in range(3):
        bench.write(client, SWITCH_ADDRESS, 1, 1)
    assert bench.commands[-1].resets == 1
    assert list(bench.commands[-1].effort) == [0, 0, 0, 0]
    assert bench.read(client, SWITCH_ADDRESS, 2) == [1, 1]
    bench.write(client, SWITCH_ADDRESS + 1, 0)
    bench.write(client, SWITCH_ADDRESS + 1, 7)
    assert bench.commands[-1].resets == 2
    assert bench.commands[-1].magnet


def test_reset_register_works_for_one_shot_clients(bench: Bench) -> None:
    for number in range(3):
        client = bench.connect(port=number)
        bench.write(client, SWITCH_ADDRESS + 1, 1)
        bench.device.disconnect(client, "connection closed by the client")
    assert bench.commands[-1].resets == 3


def test_switch_registers_and_coils_have_one_writer(bench: Bench) -> None:
    one, other = bench.connect(), bench.connect(port=2)
    bench.device.write_coil(one, 0, True, bench.clock.monotonic_ns())
    with pytest.raises(ModbusError, match="06"):
        bench.write(other, SWITCH_ADDRESS, 0)
    bench.write(other, SWITCH_ADDRESS + 1, 1)
    with pytest.raises(ModbusError, match="06"):
        bench.device.write_coil(one, 100, True, bench.clock.monotonic_ns())


def test_block_reads_over_gaps_are_zero_if_permitted() -> None:
    bench = Bench(unmapped_reads="zeros")
    bench.state(1)
    client = bench.connect()
    bench.write(client, 0, 11, 12, 13, 14)
    bench.write(client, ECHO_ADDRESS, 99)
    exact = [*bench.read(client, 0, 8), *[0] * 92, *bench.read(client, ECHO_ADDRESS, 2)]
    # Modbus Poll reads 10 registers by default, ModScan 100 from number 100 on; a scanner one block for all.
    assert bench.read(client, 0, 10) == exact[:10]
    assert bench.read(client, 0, 102) == exact
    assert bench.read(client, 99, 100) == [0, 99, 1000, *[0] * 97]
    assert bench.read(client, 3, 5) == exact[3:8]
    inputs = bench.read(client, 0, INPUT_END, RegisterTable.INPUT_REGISTER)
    assert bench.read(client, 0, 125, RegisterTable.INPUT_REGISTER) == inputs + [0] * (125 - INPUT_END)
    assert bench.read(client, 195, 110) == [0] * 5 + inputs + [0] * 64 + [0, 0] + [0] * 3
    bench.device.write_coil(client, 0, True, bench.clock.monotonic_ns())
    assert bench.device.read_bits(client, RegisterTable.COIL, 0, 16) == 1
    assert bench.device.read_bits(client, RegisterTable.COIL, 90, 16) == 0
    status = bench.device.read_bits(client, RegisterTable.DISCRETE_INPUT, 0, 16)
    assert bench.device.read_bits(client, RegisterTable.DISCRETE_INPUT, 4, 32) == status >> 4
    # An address in the traditional numbering is a mistake, and no write may hit a gap.
    for table, address, count in (
        (RegisterTable.HOLDING_REGISTER, 40004, 4),
        (RegisterTable.HOLDING_REGISTER, 8, 90),
        (RegisterTable.INPUT_REGISTER, INPUT_END, 2),
        (RegisterTable.HOLDING_REGISTER, 0xFFFF, 2),
    ):
        with pytest.raises(ModbusError, match="02"):
            bench.read(client, address, count, table)
    with pytest.raises(ModbusError, match="02"):
        bench.write(client, 0, *[0] * 10)


def test_gaps_are_refused_by_default(bench: Bench) -> None:
    client = bench.connect()
    for table, address, count in (
        (RegisterTable.HOLDING_REGISTER, 0, 9),
        (RegisterTable.HOLDING_REGISTER, 99, 3),
        (RegisterTable.HOLDING_REGISTER, 235, 2),
        (RegisterTable.INPUT_REGISTER, 0, INPUT_END + 1),
    ):
        with pytest.raises(ModbusError, match="02"):
            bench.read(client, address, count, table)
    with pytest.raises(ModbusError, match="02"):
        bench.device.read_bits(client, RegisterTable.COIL, 0, 2)


def test_first_writer_acquires_lease_and_others_get_06(bench: Bench) -> None:
    holder, other = bench.connect(), bench.connect(host="10.0.0.2")
    bench.write(holder, 0, 5)
    with pytest.raises(ModbusError) as refusal:
        bench.write(other, 0, 6)
    assert refusal.value.code == 6
    assert bench.read(other, 0, 1) == [5]
    refused = bench.events[-1]
    assert refused.kind == Event.LEASE_REFUSED
    assert (refused.controller_data.controller, refused.controller_data.holder) == ("10.0.0.2:1000", "10.0.0.1:1000")
    assert refused.text == (
        "10.0.0.2:1000: write to rig1 denied: 10.0.0.1:1000 holds the lease; stop that client, or run: "
        "hilrig lease rig1 --release"
    )


def test_invalid_write_acquires_no_lease(bench: Bench) -> None:
    client = bench.connect()
    for address in (POSITION_ADDRESS, PAPER_END, ECHO_ADDRESS - 1, EXTENDED_END):
        with pytest.raises(ModbusError) as refusal:
            bench.write(client, address, 1)
        assert refusal.value.code == 2
    assert bench.device.lease.holder is None
    assert not bench.events


def test_denials_are_reported_once_per_second_with_count(bench: Bench) -> None:
    holder, other = bench.connect(), bench.connect(host="10.0.0.2")
    bench.write(holder, 0, 5)
    for _ in range(100):
        bench.clock.advance(15 * MS)
        bench.write(holder, 0, 5)
        with pytest.raises(ModbusError):
            bench.write(other, 0, 6)
    refusals = [event.text for event in bench.events if event.kind == Event.LEASE_REFUSED]
    assert len(refusals) == 2
    assert "(66 times)" in refusals[1]
    bench.wait(1000)
    refusals = [event.text for event in bench.events if event.kind == Event.LEASE_REFUSED]
    assert "(33 times)" in refusals[2]


def test_denials_of_a_session_are_not_counted_in_the_next(bench: Bench) -> None:
    """The first client is refused 30 times; minutes later, in another session, a second one is refused once."""
    for refused in (30, 1):
        holder, other = bench.connect(), bench.connect(host="10.0.0.2")
        bench.write(holder, 0, 5)
        session = bench.device.session
        for _ in range(refused):
            with pytest.raises(ModbusError):
                bench.write(other, 0, 6)
        bench.device.disconnect(other, "done")
        bench.device.disconnect(holder, "done")
        # The session ends within the period of the report.
        bench.device.stop("the edge stops")
        refusals = [event for event in bench.events if event.kind == Event.LEASE_REFUSED]
        counts = [int(found[1]) if (found := re.search(r"\((\d+) times\)", one.text)) else 1 for one in refusals]
        assert counts == [1, 29][:refused]
        assert session is not None
        assert {one.session for one in refusals} == {session.id}
        bench.events.clear()


def test_denials_are_counted_per_cause(bench: Bench) -> None:
    holder, other = bench.connect(), bench.connect(host="10.0.0.2")
    observer = bench.connect(host="10.0.0.2", may_write=False)
    bench.write(holder, 0, 5)
    for client in (other, observer, other, observer, observer):
        with pytest.raises(ModbusError):
            bench.write(client, 0, 6)
    for _ in range(10):
        bench.write(holder, 0, 5)
        bench.wait(100)
    refusals = [event.text for event in bench.events if event.kind == Event.LEASE_REFUSED]
    assert ["read-only" in text for text in refusals] == [False, True, False, True]
    assert "times" not in "".join(refusals[:3])
    assert refusals[3].endswith("(2 times)")


def test_denials_of_new_connections_are_limited_per_host(bench: Bench) -> None:
    bench.write(bench.connect(), 0, 5)
    for number in range(100):
        bench.clock.advance(15 * MS)
        other = bench.connect(host="10.0.0.2", port=number)
        with pytest.raises(ModbusError):
            bench.write(other, 0, 6)
        bench.device.disconnect(other, "done")
    refusals = [event.text for event in bench.events if event.kind == Event.LEASE_REFUSED]
    assert len(refusals) == 2
    assert "10.0.0.2:66: write to rig1 denied" in refusals[1]
    assert "(66 times)" in refusals[1]


def one_shot(bench: Bench, port: int, host: str = "10.0.0.1") -> int:
    """Open a connection for one write; return the exception code, or 0."""
    client = bench.connect(host=host, port=port)
    try:
        bench.write(client, 0, port)
    except ModbusError as error:
        return error.code
    finally:
        bench.device.disconnect(client, "connection closed by the client")
    return 0


def test_one_shot_connections_are_reported_once_per_second(bench: Bench) -> None:
    for port in range(100):
        one_shot(bench, port)
        bench.wait(20)
    texts = [event.text for event in bench.events if event.kind in (Event.LEASE_GRANTED, Event.LEASE_LOST)]
    assert texts == [
        "10.0.0.1:0 acquired the lease of rig1",
        "10.0.0.1:0 released the lease of rig1: connection closed by the client",
        "10.0.0.1:50 acquired the lease of rig1 (50 times)",
        "10.0.0.1:50 released the lease of rig1: connection closed by the client",
    ]


def test_suppressed_acquisition_is_reported_after_one_second(bench: Bench) -> None:
    one_shot(bench, 1)
    stays = bench.connect(port=2)
    bench.write(stays, 0, 5)
    bench.wait(999)
    assert bench.kinds()[-1] == "LEASE_LOST"
    bench.wait(1)
    assert bench.events[-1].text == "10.0.0.1:2 acquired the lease of rig1"
    bench.wait(1000)
    assert bench.kinds().count("LEASE_GRANTED") == 2
    bench.device.disconnect(stays, "connection closed by the client")
    assert bench.kinds()[-1] == "LEASE_LOST"


def test_revocation_is_always_reported(bench: Bench) -> None:
    one_shot(bench, 1)
    bench.write(bench.connect(port=2), 0, 5)
    bench.device.release("revoked by an operator")
    assert [event.text for event in bench.events[-2:]] == [
        "10.0.0.1:2 acquired the lease of rig1",
        "10.0.0.1:2 lost the lease of rig1: revoked by an operator",
    ]


def test_alternating_hosts_do_not_get_a_session_per_write(bench: Bench) -> None:
    codes = set()
    for number in range(150):
        codes.add(one_shot(bench, number, host=f"10.0.0.{1 + number % 2}"))
        bench.wait(20)
    assert codes == {0, 6}
    assert bench.kinds().count("SESSION_START") == 4
    assert any("acquired the lease less than 1 s ago" in event.text for event in bench.events)


def test_disconnect_releases_the_lease(bench: Bench) -> None:
    holder, other = bench.connect(), bench.connect(host="10.0.0.2")
    bench.write(holder, 0, 5)
    bench.device.disconnect(holder, "connection closed by the client")
    assert bench.kinds()[-1] == "LEASE_LOST"
    bench.write(other, 1, 6)
    # The torque of the previous holder stays applied until the watchdog trips.
    assert list(bench.commands[-1].effort) == [0.005, 0.006, 0, 0]


def test_lease_expires_without_requests_but_not_with_reads(bench: Bench) -> None:
    holder = bench.connect()
    bench.write(holder, 0, 5)
    for _ in range(8):
        bench.wait(1000)
        bench.read(holder, 0, 1)
    assert bench.device.lease.holder is holder.controller
    bench.wait(4999)
    assert bench.device.lease.holder is holder.controller
    bench.wait(1)
    assert bench.device.lease.holder is None
    assert "no request for 5 s" in bench.events[-1].text


def test_connections_of_a_controller_write_different_things(bench: Bench) -> None:
    torques, more_torques, magnet, stranger = (
        bench.connect(),
        bench.connect(port=2),
        bench.connect(port=3),
        bench.connect(host="10.0.0.2"),
    )
    bench.write(torques, 0, 1, 2)
    bench.write(more_torques, 2, 3, 4)
    bench.device.write_coil(magnet, MAGNET_COIL, True, bench.clock.monotonic_ns())
    assert list(bench.commands[-1].effort) == [0.001, 0.002, 0.003, 0.004]
    assert bench.commands[-1].magnet
    assert bench.kinds() == ["SESSION_START", "LEASE_GRANTED"]
    for client in (torques, magnet, bench.connect(port=4)):
        assert bench.read(client, 6, 1, RegisterTable.INPUT_REGISTER) == [1]
    assert bench.read(stranger, 6, 1, RegisterTable.INPUT_REGISTER) == [2]
    # The lease is held until the last writing connection is closed.
    for client in (torques, magnet):
        bench.device.disconnect(client, "closed")
    with pytest.raises(ModbusError):
        bench.write(stranger, 0, 9)
    bench.device.disconnect(more_torques, "closed")
    bench.write(stranger, 0, 9)


@pytest.mark.parametrize(("timeout_ms", "free_after_ms"), [(300, 300), (0, 5000)])
def test_second_program_of_a_controller_is_refused(bench: Bench, timeout_ms: int, free_after_ms: int) -> None:
    first, second = bench.connect(), bench.connect(port=2)
    bench.device.watchdog.timeout_ns = timeout_ms * MS
    bench.write(first, 0, 1, 2, 3, 4)
    bench.device.watchdog.timeout_ns = timeout_ms * MS
    with pytest.raises(ModbusError) as refusal:
        bench.write(second, 3, 9)
    assert refusal.value.code == 6
    event = bench.events[-1]
    assert event.text == (
        "10.0.0.1:2: write to rig1 denied: two programs on 10.0.0.1 write torques, the other one is 10.0.0.1:1000: "
        "stop one"
    )
    assert (event.controller_data.controller, event.controller_data.holder) == (second.address, first.address)
    bench.clock.advance((free_after_ms - 1) * MS)
    with pytest.raises(ModbusError):
        bench.write(second, 3, 9)
    bench.clock.advance(MS)
    bench.write(second, 3, 9)
    # The first one has lost this register, and still writes the others.
    with pytest.raises(ModbusError):
        bench.write(first, 0, 1, 2, 3, 4)
    bench.write(first, 0, 1, 2, 3)


def test_closed_connection_leaves_what_it_wrote(bench: Bench) -> None:
    stays = bench.connect(port=2)
    bench.device.write_coil(stays, MAGNET_COIL, True, bench.clock.monotonic_ns())
    for port in range(10, 20):
        assert one_shot(bench, port) == 0
    assert bench.device.lease.holder is stays.controller


def test_display_of_the_host_does_not_keep_the_lease(bench: Bench) -> None:
    display, controller = bench.connect(port=2), bench.connect()
    bench.write(controller, 0, 1)
    for _ in range(5):
        bench.wait(1000)
        bench.read(display, 4, 4)
    assert bench.device.lease.holder is None


def test_revoked_lease_is_not_acquired_by_the_next_connection(bench: Bench) -> None:
    holder, sibling = bench.connect(), bench.connect(port=2)
    bench.write(holder, 0, 1)
    assert bench.device.release("revoked by an operator") == holder.address
    with pytest.raises(ModbusError):
        bench.write(sibling, 0, 1)
    # A program that is started afterwards is another one.
    bench.write(bench.connect(port=3), 0, 1)


def test_operator_can_revoke_the_lease(bench: Bench) -> None:
    assert bench.device.release("revoked by an operator") == ""
    holder = bench.connect()
    bench.write(holder, 0, 5)
    assert bench.device.release("revoked by an operator") == "10.0.0.1:1000"
    assert bench.device.lease.holder is None
    assert bench.events[-1].controller_data.reason == "revoked by an operator"


def test_revoked_holder_cannot_acquire_lease_during_cooldown(bench: Bench) -> None:
    holder, other = bench.connect(), bench.connect(host="10.0.0.2")
    bench.write(holder, 0, 5)
    bench.device.release("revoked by an operator")
    with pytest.raises(ModbusError) as refusal:
        bench.write(holder, 0, 6)
    assert refusal.value.code == 6
    bench.write(other, 0, 7)
    bench.device.disconnect(other, "done")
    bench.wait(4999)
    with pytest.raises(ModbusError) as refusal:
        bench.write(holder, 0, 8)
    assert refusal.value.code == 6
    bench.wait(1)
    bench.write(holder, 0, 8)
    assert bench.device.lease.holder is holder.controller


def test_write_of_read_only_client_gets_01(bench: Bench) -> None:
    observer = bench.connect(may_write=False)
    assert bench.read(observer, 0, 1) == [0]
    with pytest.raises(ModbusError) as refusal:
        bench.write(observer, 0, 1)
    assert refusal.value.code == 1
    assert bench.device.lease.holder is None
    assert bench.kinds() == ["LEASE_REFUSED"]


# -- watchdog


def test_watchdog_zeroes_torque_when_writes_stop(bench: Bench) -> None:
    client = bench.connect()
    bench.write(client, 0, 1000, 1000, 1000, 1000)
    assert [timer.at_ns for timer in bench.timers] == [bench.clock.monotonic_ns() + 1000 * MS]
    bench.wait(999)
    assert not bench.commands[-1].safe
    bench.wait(1)
    command = bench.commands[-1]
    assert (list(command.effort), command.safe, command.seq, command.basis_step) == ([0] * 4, True, 2, 0)
    assert command.session == bench.session.id
    assert bench.read(client, 0, 4) == [0] * 4
    trip = bench.events[-1]
    assert trip.kind == Event.WATCHDOG_TRIP
    assert (trip.watchdog_data.silent_ns, trip.watchdog_data.timeout_ns) == (1000 * MS, 1000 * MS)


def test_trip_event_has_the_cause(bench: Bench) -> None:
    def trip_text() -> str:
        assert bench.events[-1].kind == Event.WATCHDOG_TRIP
        return bench.events[-1].text

    client = bench.connect()
    bench.write(client, 0, 1)
    bench.wait(1000)
    assert "no request from 10.0.0.1:1000 for 1.0 s" in trip_text()
    bench.write(client, 0, 1)
    bench.wait(200)
    bench.read(client, 4, 4)
    bench.wait(800)
    assert "no request from 10.0.0.1:1000 for 0.8 s" in trip_text()
    bench.write(client, 0, 1)
    bench.wait(900)
    bench.read(client, 4, 4)
    bench.wait(100)
    assert "reads but does not write" in trip_text()
    bench.write(client, 0, 1)
    bench.device.disconnect(client, "connection closed by the client")
    bench.wait(1000)
    assert "10.0.0.1:1000 no longer holds the lease" in trip_text()


def test_another_controller_takes_lease_after_trip(bench: Bench) -> None:
    """A program that wrote once and only polls does not keep the rig."""
    polls, other = bench.connect(), bench.connect(host="10.0.0.2")
    bench.write(polls, 0, 5)
    for _ in range(9):
        bench.wait(100)
        bench.read(polls, 4, 4)
        with pytest.raises(ModbusError):
            bench.write(other, 0, 6)
    bench.wait(100)
    assert bench.device.watchdog.tripped
    bench.read(polls, 4, 4)
    bench.write(other, 0, 6)
    assert bench.device.lease.holder is other.controller
    assert not bench.device.watchdog.tripped
    lost = next(event for event in bench.events if event.kind == Event.LEASE_LOST)
    assert lost.controller_data.controller == polls.address
    assert "the watchdog has tripped, and 10.0.0.2:1000 writes" in lost.text
    assert bench.kinds().count("SESSION_START") == 2
    with pytest.raises(ModbusError):
        bench.write(polls, 0, 7)


def test_holder_that_writes_keeps_lease_on_lossy_link() -> None:
    """The watchdog trips because the emulated network drops each write."""
    bench = Bench(impairment=ImpairmentConfig.model_validate({"command": {"loss": {"kind": "bernoulli", "rate": 1.0}}}))
    bench.state(1)
    bench.device.start()
    writes, other = bench.connect(), bench.connect(host="10.0.0.2")
    bench.write(writes, 0, 5)
    bench.device.watchdog.feed(bench.clock.monotonic_ns())
    for _ in range(30):
        bench.wait(50)
        bench.write(writes, 0, 5)
    assert bench.device.watchdog.tripped
    with pytest.raises(ModbusError):
        bench.write(other, 0, 6)
    assert "10.0.0.1:1000 holds the lease" in bench.events[-1].text
    bench.wait(1000)
    bench.write(other, 0, 6)
    assert bench.device.lease.holder is other.controller


def test_next_write_rearms_the_watchdog(bench: Bench) -> None:
    client = bench.connect()
    bench.write(client, 0, 1)
    bench.wait(1000)
    tripped = bench.read(client, 1, 1, RegisterTable.INPUT_REGISTER)[0]
    assert tripped & Status.WATCHDOG_TRIPPED
    bench.write(client, 1, 2)
    assert bench.kinds()[-1] == "WATCHDOG_REARM"
    # The torque before the trip is not restored.
    assert list(bench.commands[-1].effort) == [0, 0.002, 0, 0]
    assert not bench.read(client, 1, 1, RegisterTable.INPUT_REGISTER)[0] & Status.WATCHDOG_TRIPPED


def test_watchdog_does_not_trip_without_torque(bench: Bench) -> None:
    client = bench.connect()
    bench.write(client, 0, 1)
    bench.write(client, 0, 0)
    bench.device.disconnect(client, "connection closed by the client")
    bench.wait(2000)
    assert "WATCHDOG_TRIP" not in bench.kinds()


def test_watchdog_timeout_register_is_bounded(bench: Bench) -> None:
    client = bench.connect()
    assert bench.read(client, address_of("watchdog_timeout_set"), 1) == [1000]
    bench.write(client, address_of("watchdog_timeout_set"), 150)
    assert bench.read(client, address_of("watchdog_timeout_set"), 1) == [150]
    bench.write(client, 0, 1)
    bench.wait(150)
    assert bench.commands[-1].safe
    for wrong in (0, 99, 10_001, 65535):
        with pytest.raises(ModbusError) as refusal:
            bench.write(client, ECHO_ADDRESS, 42, wrong)
        assert refusal.value.code == 4
    assert bench.read(client, ECHO_ADDRESS, 2) == [0, 150]


def test_new_session_restores_timeout_and_echo_defaults(bench: Bench) -> None:
    one, other = bench.connect(), bench.connect(host="10.0.0.2")
    bench.write(one, ECHO_ADDRESS, 4711, 150)
    bench.write(one, 0, 1)
    bench.device.disconnect(one, "done")
    bench.write(other, 0, 1)
    assert bench.read(other, ECHO_ADDRESS, 2) == [0, 1000]
    assert [command.echo for command in bench.commands if command.controller] == [4711, 0]


def test_echo_write_of_new_session_restores_default_timeout(bench: Bench) -> None:
    one, other = bench.connect(), bench.connect(host="10.0.0.2")
    bench.write(one, ECHO_ADDRESS, 4711, 150)
    bench.device.disconnect(one, "done")
    bench.write(other, ECHO_ADDRESS, 4712)
    assert bench.read(other, ECHO_ADDRESS, 2) == [4712, 1000]


# -- sessions


def test_session_starts_with_lease_and_ends_after_grace(bench: Bench) -> None:
    client = bench.connect()
    bench.write(client, 0, 0)
    session = bench.session
    assert session.id == "20231114T221320Z-rig1-" + session.id[-4:]
    assert session.id[-4:].isalpha()
    assert bench.kinds() == ["SESSION_START", "LEASE_GRANTED"]
    bench.device.disconnect(client, "done")
    bench.wait(4999)
    assert bench.device.session is session
    bench.wait(1)
    assert bench.device.session is None
    assert bench.kinds()[-1] == "SESSION_END"
    assert bench.events[-1].session == session.id
    assert bench.session_changes == 2
    last = bench.commands[-1]
    assert (last.session, last.seq, last.basis_step, last.safe) == ("", 2, 0, True)


def test_session_started_without_torque_is_published(bench: Bench) -> None:
    bench.write(bench.connect(), ECHO_ADDRESS, 1)
    [command] = bench.commands
    assert (command.session, command.safe, command.controller) == (bench.session.id, True, "")


def test_same_host_continues_session_another_starts_one(bench: Bench) -> None:
    first, again, other = bench.connect(), bench.connect(port=2), bench.connect(host="10.0.0.2")
    bench.write(first, 0, 0)
    session = bench.device.session
    bench.device.disconnect(first, "done")
    bench.wait(4000)
    bench.write(again, 0, 0)
    bench.wait(3000)
    bench.read(again, 0, 1)
    bench.wait(3000)
    assert bench.device.session is session
    bench.device.disconnect(again, "done")
    bench.write(other, 0, 0)
    assert bench.device.session is not session
    assert bench.session.number == 2
    assert [k for k in bench.kinds() if k.startswith("SESSION")] == ["SESSION_START", "SESSION_END", "SESSION_START"]


def test_stop_ends_torque_lease_and_session(bench: Bench) -> None:
    bench.write(bench.connect(), 0, 1000)
    bench.device.stop("edge stopped")
    assert bench.kinds()[-2:] == ["LEASE_LOST", "SESSION_END"]
    last = bench.commands[-1]
    assert (list(last.effort), last.safe, last.session) == ([0] * 4, True, "")
    assert bench.device.session is None


# -- register contents


def test_positions_before_first_state_get_04() -> None:
    bench = Bench()
    client = bench.connect()
    with pytest.raises(ModbusError) as refusal:
        bench.read(client, 4, 1)
    assert refusal.value.code == 4
    assert bench.read(client, 0, 4) == [0] * 4
    assert bench.device.read_bits(client, RegisterTable.DISCRETE_INPUT, 0, 1) == 0


def test_status_register_equals_the_discrete_inputs(bench: Bench) -> None:
    client = bench.connect()
    bench.state(70_000, position=(1.5, -1.0, 0.125, 6.2), limit_flags=0b1_0010_0001, magnet=True, held_part="cube")
    bench.write(client, 0, 1)
    wanted = (
        Status.SIMULATION_ALIVE
        | Status.SESSION_OPEN
        | Status.LEASE_HELD
        | Status.LEASE_IS_YOURS
        | Status.WATCHDOG_ON
        | Status.ON_STOP
        | Status.MAGNET_ON
        | Status.PART_HELD
        | Status.POSITION_SATURATED
    )
    assert bench.read(client, address_of("status"), 1, RegisterTable.INPUT_REGISTER) == [wanted]
    assert bench.device.read_bits(client, RegisterTable.DISCRETE_INPUT, 0, 16) == wanted


def test_lease_and_read_only_bits_depend_on_the_client(bench: Bench) -> None:
    holder, other = bench.connect(), bench.connect(host="10.0.0.2", may_write=False)
    bench.write(holder, 0, 1)
    assert bench.read(holder, 6, 1, RegisterTable.INPUT_REGISTER) == [1]
    assert bench.read(other, 6, 1, RegisterTable.INPUT_REGISTER) == [2]
    bits = bench.device.read_bits(other, RegisterTable.DISCRETE_INPUT, 0, 16)
    assert bits & Status.READ_ONLY
    assert not bits & Status.LEASE_IS_YOURS


def test_old_state_clears_the_alive_bit(bench: Bench) -> None:
    client = bench.connect()
    assert bench.device.read_bits(client, RegisterTable.DISCRETE_INPUT, 0, 1) == 1
    bench.clock.advance(1000 * MS)
    assert bench.device.read_bits(client, RegisterTable.DISCRETE_INPUT, 0, 1) == 0
    # The age register saturates at its maximum.
    age = address_of("state_age")
    assert bench.read(client, age, 1, RegisterTable.INPUT_REGISTER) == [1000]
    bench.clock.advance(100_000 * MS)
    assert bench.read(client, age, 1, RegisterTable.INPUT_REGISTER) == [0xFFFF]


def test_latency_register_keeps_the_last_value(bench: Bench) -> None:
    client = bench.connect()

    def latency_us() -> int:
        high, low = bench.read(client, 4, 2, RegisterTable.INPUT_REGISTER)
        return high << 16 | low

    for step, loop_ms, expected_us in ((1, 0, 0), (2, 40, 40_000), (3, 0, 40_000), (4, 20, 20_000), (5, 0, 20_000)):
        bench.state(step, loop_latency_ns=loop_ms * MS)
        assert latency_us() == expected_us


def test_invalid_state_message_is_ignored(bench: Bench) -> None:
    client = bench.connect()
    before = bench.read(client, 4, 4)
    four = (1.0, 2.0, 0.1, 3.0)
    negative = JointState(step=9, position=four, velocity=four, effort=four, loop_latency_ns=-(1 << 62))
    for message in (JointState(step=9, position=(1, 2)), negative, None):
        payload = b"\xff\xff\xff" if message is None else message.SerializeToString()
        bench.arrival = TimestampedPayload(payload, bench.clock.monotonic_ns())
        assert bench.read(client, 4, 4) == before
    assert bench.rejected == ["state of rig1: not a valid state"] * 3


def test_one_read_contains_one_step(bench: Bench) -> None:
    """Each state has its step in every float, so that a mix of two would be detected."""
    client = bench.connect()
    for step in range(1, 200):
        bench.state(step, position=(0, 0, step / 1000, 0), velocity=(0, 0, step / 1000, 0), effort=(step,) * 4)
        data = struct.pack(f">{INPUT_END}H", *bench.read(client, 0, INPUT_END, RegisterTable.INPUT_REGISTER))
        floats = struct.unpack_from(">12f", data, 24)
        assert struct.unpack_from(">I", data, 4) == (step,)
        assert (floats[2], floats[6], floats[8:]) == (step, step, (step,) * 4)


def test_unlisted_client_may_only_read() -> None:
    bench = Bench()
    bench.state(1)
    bench.device.permit({"alice"})
    alice = bench.connect("10.0.0.1", 1, certificate="alice")
    for unlisted, reason in (
        (bench.connect("10.0.0.2", 2, certificate="bob"), "does not list rig1 for bob"),
        (bench.connect("10.0.0.3", 3), "writing needs a certificate"),
    ):
        assert bench.read(unlisted, 4, 1)
        with pytest.raises(ModbusError) as refused:
            bench.write(unlisted, 0, 100)
        assert refused.value.code == ExcCodes.ILLEGAL_FUNCTION
        assert reason in bench.events[-1].text
        assert bench.device.read_bits(unlisted, RegisterTable.DISCRETE_INPUT, 0, 16) & Status.READ_ONLY
    bench.write(alice, 0, 100)
    assert not bench.device.read_bits(alice, RegisterTable.DISCRETE_INPUT, 0, 16) & Status.READ_ONLY


def test_client_that_loses_permission_loses_the_lease() -> None:
    """Also in the midst of writes: the next write of the same registers is not taken for an authorized one."""
    bench = Bench()
    alice, bob = (bench.connect(f"10.0.0.{n}", n, certificate=name) for n, name in enumerate(("alice", "bob")))
    bench.device.permit({"alice", "bob"})
    bench.write(alice, 0, 100)
    bench.device.permit({"bob"})
    assert bench.device.lease.holder is None
    assert "edge.tls.clients" in bench.events[-1].text
    with pytest.raises(ModbusError):
        bench.write(alice, 0, 100)
    bench.wait(1000)
    bench.write(bob, 0, 200)
    # Bob keeps it when the others of the table change.
    bench.device.permit({"bob", "carol"})
    assert bench.device.lease.holder is bob.controller


def test_events_carry_the_name_in_the_certificate() -> None:
    bench = Bench()
    alice = bench.connect("10.0.0.1", 1, certificate="alice")
    bench.write(alice, 0, 100)
    session = bench.device.session
    assert session is not None
    assert session.as_message().certificate == "alice"
    bench.device.disconnect(alice, "left")
    bench.wait(6000)
    texts = {Event.Kind.Name(event.kind): event for event in bench.events}
    for kind in ("SESSION_START", "SESSION_END"):
        assert texts[kind].session_data.certificate == "alice"
    for kind in ("LEASE_GRANTED", "LEASE_LOST"):
        assert texts[kind].controller_data.certificate == "alice"
        assert "10.0.0.1:1 (CN=alice)" in texts[kind].text


def test_states_that_stop_are_an_event_and_their_return_is_one() -> None:
    bench = Bench()

    def run(duration_ms: int, *, states: bool) -> None:
        for step in range(duration_ms // 20):
            if states:
                bench.state(step)
            bench.wait(20)

    run(100, states=True)
    run(14_000, states=False)
    assert bench.kinds() == ["STATE_LOST"]
    assert bench.events[0].text.startswith("no states since ")
    run(2_000, states=True)
    assert bench.kinds() == ["STATE_LOST", "STATE_BACK"]
    assert bench.events[1].text.endswith(" UTC, after 14.0 s")
    assert bench.events[1].watchdog_data.silent_ns == pytest.approx(14_000 * MS, abs=40 * MS)
