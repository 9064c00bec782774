"""The edge as the client of a controller that is a Modbus server: sockets, a cyclic program, and its failures."""

import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from hilrig_cli.doctor.controllers import check_controllers
from hilrig_runtime.bus.memory_bus import MemoryBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.security.x509 import issue_client, issue_server, make_authority
from hilrig_schemas import Event, LeaseRequest, LeaseStatus, TorqueCommand, topics
from support.edge_rig import EdgeRig, counts, running_edge
from support.plc import HEADER, Plc
from support.pymodbus_plc import PymodbusPlc
from support.waiting import eventually

pytestmark = pytest.mark.rig

ECHO = {"echo": 9}
FAST = {"timeout_ms": 150.0}


@contextmanager
def client_of(
    plc: Plc | PymodbusPlc, *, registers: dict[str, Any] = ECHO, client: dict[str, Any] = FAST, **edge: Any
) -> Iterator[EdgeRig]:
    """Run an edge that is the client of `plc`, with a state every 20 ms."""
    settings = {"controller": edge.pop("controller", plc.address), "registers": registers, "client": client}
    settings |= {key: edge.pop(key) for key in ("impairment",) if key in edge}
    edge = {"watchdog_ms": 300.0, "session_grace_ms": 600.0} | edge
    with running_edge(first_rig=settings, **edge) as rig:
        ended = threading.Event()

        def publish() -> None:
            while not ended.wait(0.02):
                rig.state(position=(0.001 * (rig.step + 1), -0.2, 0.05, 3.0))

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            yield rig
        finally:
            ended.set()
            thread.join()


def lease(rig: EdgeRig, *, release: bool = False) -> LeaseStatus:
    with MemoryBus(rig.hub) as bus:
        payload = LeaseRequest(release=release).SerializeToString()
        [reply] = bus.query(topics.LEASE.key(rig.lab.name, "rig1"), payload)
        return LeaseStatus.FromString(reply.payload)


def torques(rig: EdgeRig) -> list[TorqueCommand]:
    """Commands of the controller so far."""
    return [command for command in rig.commands if command.read_sent_ns]


def fault(rig: EdgeRig, text: str) -> Event:
    """Wait for the event of a fault that contains `text`."""
    return eventually(
        lambda: next(
            (event for event in rig.events if event.kind == Event.CONTROLLER_FAULT and text in event.text), None
        )
    )


def works(rig: EdgeRig) -> None:
    """Wait until the controller commands the rig."""
    count = len(torques(rig))
    eventually(lambda: len(torques(rig)) > count + 2)


def test_torques_answer_the_positions_of_their_basis() -> None:
    with Plc(law=lambda q: (q[0], -q[0], 0, 7)) as plc, client_of(plc) as rig:
        plc.coil = True
        eventually(lambda: len(torques(rig)) > 20)
        commands = torques(rig)[5:]
    for command in commands:
        # The law returns the first position, so each torque names the state that it answers.
        first = counts((0.001 * command.basis_step, -0.2, 0.05, 3.0))[0]
        assert command.effort[:2] == pytest.approx([first / 1000, -first / 1000])
        assert command.effort[3] == 0.007
        times = (
            command.state_arrived_ns,
            command.state_served_ns,
            command.positions_acknowledged_ns,
            command.read_sent_ns,
            command.write_arrived_ns,
            command.sent_ns,
        )
        assert list(times) == sorted(times)
        assert not command.basis_is_bound
        assert command.controller == plc.address
    assert commands[-1].magnet
    start = rig.event(Event.SESSION_START)
    assert start.text.endswith(f"started as client of {plc.address}")
    assert len({command.session for command in commands}) == 1


@pytest.mark.parametrize(("scan_s", "delay_s"), [(0.005, 0.0), (0.05, 0.004)])
def test_basis_is_the_one_that_the_device_knows(scan_s: float, delay_s: float) -> None:
    with Plc(scan_s=scan_s, delay_s=delay_s) as plc, client_of(plc) as rig:
        eventually(lambda: len(torques(rig)) > 12)
        commands, scans, requests = torques(rig)[2:], list(plc.scans), list(plc.requests)
    for command in commands:
        step = struct.pack(">H", command.basis_step & 0xFFFF)
        [written_ns] = [at_ns for at_ns, pdu in requests if pdu[0] == 16 and pdu[-2:] == step]
        assert command.state_served_ns < written_ns < command.positions_acknowledged_ns
        read = [at for at, pdu in requests if pdu[0] == 3 and command.read_sent_ns < at < command.write_arrived_ns]
        [read_ns] = read
        used = [(begin, end) for begin, end, seen in scans if seen == command.basis_step and end < read_ns]
        assert used[0][0] > written_ns
        # No scan with newer positions ended before the read.
        assert not [seen for _, end, seen in scans if seen > command.basis_step and end < read_ns - 2e6]
        if command.stale_read_sent_ns:
            assert command.state_served_ns < command.stale_read_sent_ns < command.read_sent_ns


def test_first_write_follows_a_read_of_the_torques() -> None:
    with Plc() as plc, client_of(plc) as rig:
        works(rig)
    functions = [pdu[0] for _, pdu in plc.requests]
    assert functions[0] == 3
    assert 16 in functions
    assert {pdu[1:5] for pdu in plc.written()} == {struct.pack(">HH", 4, 5)}


def test_nothing_is_written_if_there_are_no_torque_registers() -> None:
    with Plc() as plc:
        plc.fault = lambda transaction, _, pdu: frame(transaction, bytes((pdu[0] | 0x80, 2)))
        with client_of(plc) as rig:
            event = fault(rig, "exception 02 (illegal data address) to function 3")
            eventually(lambda: len(plc.requests) > 2)
            assert "reading torques from holding registers 0–9 (40001–40010)" in event.text
            assert not plc.written()
            assert lease(rig).session == ""


def test_reads_are_scheduled_before_the_tick() -> None:
    with Plc(scan_s=0.002) as plc, client_of(plc, client={"read_lead_ms": 6.0}) as rig:

        def answered_in_time() -> bool:
            newest = torques(rig)[-20:]
            waits_ms = sorted((command.write_arrived_ns - command.state_arrived_ns) / 1e6 for command in newest)
            # Of a basis in the same step: the answer is there 6 ms before the next state.
            return len(newest) == 20 and waits_ms[10] == pytest.approx(14.0, abs=2.5)

        # Other processes may delay some of the reads.
        eventually(answered_in_time)


def test_slow_cycle_skips_states_and_takes_the_newest() -> None:
    with Plc(delay_s=0.012) as plc, client_of(plc) as rig:
        works(rig)
        eventually(lambda: lease(rig).skipped_states > 5)
        commands = torques(rig)
    bases = [command.basis_step for command in commands]
    assert bases == sorted(set(bases))
    # One request at a time: the next one is sent after the response.
    for earlier, later in pairwise(commands):
        assert later.state_served_ns > earlier.write_arrived_ns


def test_combined_request_writes_and_reads_at_once() -> None:
    with Plc() as plc, client_of(plc, client={"combined_request": True}, registers=ECHO | {"magnet": "none"}) as rig:
        works(rig)
        commands = torques(rig)
    assert {pdu[0] for _, pdu in plc.requests} == {3, 23}
    # The program runs after the response: the torques answer positions of the request before.
    assert all(command.basis_step for command in commands)
    assert all(command.positions_acknowledged_ns < command.read_sent_ns for command in commands)


@pytest.mark.parametrize("combined", [False, True])
def test_magnet_bit_beside_the_torques_needs_no_request(combined: bool) -> None:
    registers = ECHO | {"magnet": "holding 10.9"}
    with Plc() as plc, client_of(plc, registers=registers, client=FAST | {"combined_request": combined}) as rig:
        works(rig)
        assert not torques(rig)[-1].magnet
        struct.pack_into(">H", plc.registers, 20, 1 << 9)
        eventually(lambda: torques(rig)[-1].magnet)
        struct.pack_into(">H", plc.registers, 20, 0xFFFF ^ 1 << 9)
        eventually(lambda: not torques(rig)[-1].magnet)
        # The first read of a connection precedes each write.
        assert {pdu[0] for _, pdu in plc.requests[1:]} == ({23} if combined else {16, 3})


def test_requests_of_the_edge_are_logged() -> None:
    with Plc(delay_s=0.002) as plc, client_of(plc) as rig:
        eventually(lambda: len(rig.traffic) > 2)
        traffic = rig.traffic[1]
    assert {(kind.function, kind.address, kind.count, kind.exception) for kind in traffic.kinds} == {
        (16, 4, 5, 0),
        (3, 0, 10, 0),
        (1, 0, 1, 0),
    }
    assert {kind.controller for kind in traffic.kinds} == {plc.address}
    assert all(4e6 < after_ns < 1e9 for after_ns in traffic.answered_after_ns)
    assert list(traffic.arrived_ns) == sorted(traffic.arrived_ns)


def test_other_registers_and_formats() -> None:
    registers = {"torques": "30011", "positions": "40021", "magnet": "holding 40.9", "format": "float32"}

    def answer(transaction: int, unit: int, pdu: bytes) -> bytes:
        if pdu[0] == 4:
            assert pdu[1:] == struct.pack(">HH", 10, 8)
            return frame(transaction, bytes((4, 16)) + struct.pack(">4f", 0.25, -0.5, -4.905, 0.0))
        if pdu[0] == 3:
            assert pdu[1:] == struct.pack(">HH", 40, 1)
            return frame(transaction, bytes((3, 2)) + struct.pack(">H", 1 << 9))
        return frame(transaction, plc.execute(pdu))

    with Plc() as plc:
        plc.fault = answer
        with client_of(plc, registers=registers) as rig:
            works(rig)
            command = torques(rig)[-1]
            assert list(command.effort) == [0.25, -0.5, -4.905, 0.0]
            assert command.magnet
            assert struct.unpack_from(">4f", plc.registers, 40)[2:] == pytest.approx((50.0, 171.887), rel=1e-4)


def test_no_other_connection_may_write() -> None:
    with Plc() as plc, client_of(plc) as rig, rig.client() as other:
        works(rig)
        assert other.ask("10 0000 0004 08 0001 0002 0003 0004") == bytes((0x90, 6))
        assert other.ask("05 0000 FF00") == bytes((0x85, 6))
        assert other.read(4, 4) != [0, 0, 0, 0]
        event = rig.event(Event.LEASE_REFUSED)
        assert f"the edge is a client of {plc.address}, which alone commands rig1" in event.text
        status = lease(rig)
        assert (status.client_of, status.holder, status.controller_fault) == (plc.address, plc.address, "")


def test_emulated_network_delays_states_and_torques() -> None:
    impairment = {"state": {"delay": "constant:30"}, "command": {"delay": "constant:7"}}
    with Plc() as plc, client_of(plc, impairment=impairment) as rig:

        def is_prompt(command: TorqueCommand) -> bool:
            return command.state_served_ns - command.state_arrived_ns < 45_000_000

        # The state is written as soon as its delay has passed, not with the next one; other processes may delay some.
        eventually(lambda: any(map(is_prompt, torques(rig)[3:])))
        commands = torques(rig)[3:]
    for command in commands:
        assert (command.state_injected_ns, command.command_injected_ns) == (30_000_000, 7_000_000)
        assert command.state_served_ns - command.state_arrived_ns >= 30_000_000
        assert command.sent_ns - command.write_arrived_ns >= 7_000_000


def test_operator_can_revoke_the_lease() -> None:
    with Plc() as plc, client_of(plc, lease_timeout_ms=500.0) as rig:
        works(rig)
        assert lease(rig, release=True).released == plc.address
        fault(rig, "its lease was revoked by an operator")
        works(rig)


def test_stopped_program_trips_the_watchdog() -> None:
    with Plc(law=lambda _: (100, 0, 0, 0)) as plc, client_of(plc) as rig:
        works(rig)
        plc.running = False
        trip = rig.event(Event.WATCHDOG_TRIP)
        assert "does not copy the step number into the echo register: it is stopped" in trip.text
        fault(rig, "does not copy the step number")
        requests = len(plc.requests)
        eventually(lambda: len(plc.requests) > requests + 5)
        assert list(rig.commands[-1].effort) == [0.0] * 4
        assert "does not copy" in lease(rig).controller_fault
        plc.running = True
        rig.event(Event.WATCHDOG_REARM)
        rig.event(Event.CONTROLLER_BACK)


def test_missing_states_are_no_fault_of_the_program() -> None:
    with Plc() as plc, client_of(plc) as rig:
        works(rig)
        publish, rig.state = rig.state, lambda **_: None  # type: ignore[assignment, method-assign]
        trip = rig.event(Event.WATCHDOG_TRIP)
        assert f"no new state was written to {plc.address}" in trip.text
        assert "CONTROLLER_FAULT" not in rig.kinds()
        rig.state = publish  # type: ignore[method-assign]
        works(rig)


def test_program_that_does_not_copy_the_step_is_reported() -> None:
    with Plc(copies_step=False) as plc, client_of(plc) as rig:
        fault(rig, "does not copy the step number")
        assert not torques(rig)
        struct.pack_into(">H", plc.registers, 18, 54_321)
        fault(rig, "its echo register contains 54321, no step number that was written")
        assert not torques(rig)


def test_without_echo_a_successful_read_feeds_the_watchdog() -> None:
    with Plc(law=lambda _: (100, 0, 0, 0)) as plc, client_of(plc, registers={}) as rig:
        works(rig)
        plc.running = False
        works(rig)
        time.sleep(0.4)  # longer than the watchdog: its time is the fact under test
        works(rig)
        assert "WATCHDOG_TRIP" not in rig.kinds()
        start = rig.event(Event.SESSION_START)
        assert start.session_data.reason.endswith("the device's program is not supervised (no echo register)")
        assert all(command.basis_is_bound for command in torques(rig))
        for command in torques(rig):
            assert command.positions_acknowledged_ns <= command.read_sent_ns


def test_session_ends_after_the_grace_time() -> None:
    with Plc() as plc, client_of(plc) as rig:
        works(rig)
        plc.shut()
        trip = rig.event(Event.WATCHDOG_TRIP)
        assert "connection" in trip.text
        end = rig.event(Event.SESSION_END)
        assert end.text.endswith("(edge.session_grace_ms)")
        assert "no new torque was read for 0.6 s" in end.text
        plc.listen()
        eventually(lambda: rig.kinds().count("SESSION_START") == 2)


def test_reconnection_continues_the_session() -> None:
    with Plc() as plc, client_of(plc, session_grace_ms=20_000.0) as rig:
        works(rig)
        plc.drop()
        fault(rig, "the controller reset the connection")
        works(rig)
        rig.event(Event.CONTROLLER_BACK)
        assert rig.kinds().count("SESSION_START") == 1
        assert "SESSION_END" not in rig.kinds()
        assert plc.connections == 2


def test_tls_with_mutual_authentication(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    authority, stranger = make_authority("lab", now, 30), make_authority("stranger", now, 30)
    names = {"ca": authority, "rig": issue_client(authority, "rig", "operator", now, 30)}
    names |= {
        "plc": issue_server(authority, ["127.0.0.1"], now, 30),
        "fake": issue_server(stranger, ["127.0.0.1"], now, 30),
    }
    for name, identity in names.items():
        (tmp_path / f"{name}.pem").write_bytes(identity.certificate_pem)
        (tmp_path / f"{name}.key").write_bytes(identity.key_pem)

    def server_context(name: str) -> ssl.SSLContext:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(tmp_path / f"{name}.pem", tmp_path / f"{name}.key")
        context.load_verify_locations(tmp_path / "ca.pem")
        context.verify_mode = ssl.CERT_REQUIRED
        return context

    files = {"authority": "ca.pem", "certificate": "rig.pem", "key": "rig.key"}
    client = {"tls": {key: str(tmp_path / name) for key, name in files.items()}}
    with Plc() as plc:
        plc.tls = server_context("fake")
        with client_of(plc, client=client) as rig:
            fault(rig, "TLS handshake failed")
            assert not plc.requests
            plc.tls = server_context("plc")
            works(rig)


def test_doctor_names_missing_registers() -> None:
    def findings(plc: Plc, running: tuple[str, ...] = ()) -> list[tuple[str, str]]:
        rig = {"name": "rig1", "controller": plc.address, "registers": ECHO, "client": FAST}
        lab = LabConfig.model_validate({"rigs": [rig]})
        return [(result.level.value, result.text) for result in check_controllers(lab, running)]

    with Plc() as plc:
        assert findings(plc) == [("ok", f"rig 'rig1': {plc.address} has all registers")]
        assert not plc.written()
        assert findings(plc, ("edge",))[0][1].endswith("is not tested while the edge runs; see hilrig lease")
        plc.fault = lambda t, _, pdu: frame(t, bytes((0x83, 2)) if pdu[1:3] == b"\0\4" else plc.execute(pdu))
        [(level, text)] = findings(plc)
        assert level == "error"
        assert "reading positions from holding registers 4–8 (40005–40009): they do not all exist" in text
        plc.shut()
        [(level, text)] = findings(plc)
        assert level == "error"
        assert "connection refused" in text


def test_doctor_finds_two_names_of_one_controller(monkeypatch: pytest.MonkeyPatch) -> None:
    resolve = socket.getaddrinfo

    def getaddrinfo(name: str, *arguments: Any, **options: Any) -> Any:
        return resolve("127.0.0.1" if name == "plc.lab" else name, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    rigs = [{"name": "a", "controller": "127.0.0.1:5502"}, {"name": "b", "controller": "plc.lab:5502"}]
    found = check_controllers(LabConfig.model_validate({"rigs": rigs}), ("edge",))
    assert [result.text for result in found][1] == "rig 'b': plc.lab:5502 is also the controller of 'a'"


# -- failures, each as an event in the terms of PLC users


def frame(transaction: int, pdu: bytes, *, unit: int = 1, length: int | None = None) -> bytes:
    return HEADER.pack(transaction, 0, len(pdu) + 1 if length is None else length, unit) + pdu


def on_reads(plc: Plc, answer: Callable[[int, bytes], bytes | None]) -> Callable[[int, int, bytes], bytes | None]:
    """Let every fifth read of the torques be answered by `answer`, with its transaction and correct response."""
    count = 0

    def fault(transaction: int, unit: int, pdu: bytes) -> bytes | None:
        nonlocal count
        response = plc.execute(pdu)
        if pdu[0] == 3 and (count := count + 1) % 5 == 0:
            return answer(transaction, response)
        return frame(transaction, response)

    return fault


def test_refused_connection() -> None:
    with Plc() as plc:
        plc.shut()
        with client_of(plc) as rig:
            event = fault(rig, "connection refused: nothing listens on port")
            assert event.severity == Event.WARNING
            assert event.controller_data.reason == "connection refused"
            assert event.controller_data.controller == plc.address
            assert "connection refused" in lease(rig).controller_fault
            plc.listen()
            works(rig)
            rig.event(Event.CONTROLLER_BACK)


def test_name_without_address() -> None:
    with Plc() as plc, client_of(plc, controller="no-such-host.invalid:502") as rig:
        fault(rig, "the name 'no-such-host.invalid' has no address")


FAILURES: dict[str, tuple[Callable[[int, bytes], bytes | None], str]] = {
    "reset": (lambda _, __: None, "the controller closed the connection"),
    "exception": (
        lambda t, _: frame(t, bytes((0x83, 4))),
        "exception 04 (server device failure) to function 3, reading",
    ),
    "busy": (lambda t, _: frame(t, bytes((0x83, 6))), "exception 06 (server device busy)"),
    "partial": (
        lambda t, pdu: frame(t, pdu)[:11],
        "incomplete response of 11 bytes to function 3, reading torques from",
    ),
    "silent": (lambda _, __: b"", "no response to function 3, reading torques from holding registers 0–9"),
    "transaction": (lambda t, pdu: frame(t + 9, pdu), "response with transaction identifier"),
    "length": (lambda t, pdu: frame(t, pdu[:-2]), "malformed response: 20 bytes to function 3, expected 22"),
    "byte count": (lambda t, pdu: frame(t, b"\x03\x08" + pdu[2:]), "malformed response: function 3 answered with 08"),
    "frame": (lambda t, pdu: frame(t, pdu, length=1), "malformed response: length 1 in the MBAP header"),
    "protocol": (lambda *_: b"HTTP/1.1 400 Bad Request\r\n", "malformed response: protocol identifier"),
    "unit": (lambda t, pdu: frame(t, pdu, unit=7), "malformed response: unit identifier 7, expected 1"),
    "function": (lambda t, pdu: frame(t, b"\x04" + pdu[1:]), "malformed response: function code 4, expected 3"),
}


def on_all_reads(plc: Plc | PymodbusPlc, answer: Callable[[int, bytes], bytes | None]) -> None:
    """Let every read of the torques be answered by `answer`, with its transaction and correct response."""
    if isinstance(plc, PymodbusPlc):
        plc.fault = answer
    else:
        plc.fault = lambda transaction, _, pdu: (answer if pdu[0] == 3 else frame)(transaction, plc.execute(pdu))


@pytest.mark.parametrize("server", [Plc, PymodbusPlc])
def test_failed_reads_are_reported_and_overcome(server: type[Plc] | type[PymodbusPlc]) -> None:
    with server() as plc, client_of(plc, session_grace_ms=20_000.0) as rig:
        for answer, text in FAILURES.values():
            works(rig)
            on_all_reads(plc, answer)
            eventually(lambda: text in lease(rig).controller_fault)  # noqa: B023
            plc.fault = None
        works(rig)
        assert rig.kinds().count("SESSION_START") == 1
        # The failures are repeated, the events are limited: to one of a kind.
        kinds = [event.controller_data.reason for event in rig.events if event.kind == Event.CONTROLLER_FAULT]
        assert len(kinds) < 2 * len(set(kinds))
        assert {"connection closed", "exception response", "incomplete response", "no response"} < set(kinds)


def test_pymodbus_server_stops_and_returns() -> None:
    with PymodbusPlc() as plc, client_of(plc, session_grace_ms=20_000.0) as rig:
        works(rig)
        plc.running = False
        assert "it is stopped" in rig.event(Event.WATCHDOG_TRIP).text
        fault(rig, "does not copy the step number")
        plc.running = True
        works(rig)
        plc.shut()
        fault(rig, "connection refused")
        plc.listen()
        works(rig)
        assert rig.kinds().count("SESSION_START") == 1


def test_pymodbus_server_lacks_registers() -> None:
    with PymodbusPlc() as plc, client_of(plc, registers={"echo": 16}) as rig:
        fault(rig, "exception 02 (illegal data address) to function 3, reading torques from holding registers 0–16")
        assert not torques(rig)


def test_connection_that_is_closed_after_each_response() -> None:
    with Plc() as plc, client_of(plc) as rig:
        plc.closes_after_response = True
        fault(rig, "closed the connection after one response: configure it to keep connections open")
        plc.closes_after_response = False
        works(rig)


def test_ipv6_and_several_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    resolve = socket.getaddrinfo

    def getaddrinfo(name: str, *arguments: Any, **options: Any) -> Any:
        # The first address never answers: it is reserved for documentation (RFC 5737).
        names = ["192.0.2.1", "::1"] if name == "plc.lab" else [name]
        return [found for each in names for found in resolve(each, *arguments, **options)]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    with Plc(host="::1") as plc:
        assert plc.address.startswith("[::1]:")
        with client_of(plc) as rig:
            works(rig)
        with client_of(plc, controller=f"plc.lab:{plc.port}") as rig:
            works(rig)


def test_late_response_is_recognized() -> None:
    with Plc() as plc:

        def answer(transaction: int, response: bytes) -> bytes:
            time.sleep(0.2)  # longer than the response time-out of 150 ms
            return frame(transaction, response)

        plc.fault = on_reads(plc, answer)
        with client_of(plc, session_grace_ms=20_000.0) as rig:
            fault(rig, "no response to function 3")
            fault(rig, "response after its timeout of 150 ms was discarded")
            works(rig)
            # One late response is no reason to connect again.
            assert plc.connections == 1


def test_refused_write_names_the_positions() -> None:
    with Plc() as plc:
        plc.fault = lambda t, _, pdu: frame(t, bytes((0x90, 2)) if pdu[0] == 16 else plc.execute(pdu))
        with client_of(plc) as rig:
            fault(rig, "to function 16, writing positions to holding registers 4–8 (40005–40009)")
            assert not torques(rig)
            assert lease(rig).session == ""


def test_missing_magnet_coil_is_named() -> None:
    with Plc() as plc:
        plc.fault = lambda t, _, pdu: frame(t, bytes((0x81, 2)) if pdu[0] == 1 else plc.execute(pdu))
        with client_of(plc) as rig:
            fault(rig, "exception 02 (illegal data address) to function 1, reading the magnet from coil 0 (00001)")


def test_restarted_device_continues_from_its_first_scan() -> None:
    with Plc() as plc, client_of(plc, session_grace_ms=20_000.0) as rig:
        works(rig)
        plc.shut()
        rig.event(Event.WATCHDOG_TRIP)
        plc.registers[:] = bytes(200)
        plc.listen()
        works(rig)
        rig.event(Event.WATCHDOG_REARM)


def test_changed_address_of_a_name_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    resolve, host = socket.getaddrinfo, "127.0.0.1"

    def getaddrinfo(name: str, *arguments: Any, **options: Any) -> Any:
        return resolve(host if name == "plc.lab" else name, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    with (
        Plc() as first,
        Plc(host="127.0.0.2", port=first.port) as second,
        client_of(first, controller=f"plc.lab:{first.port}", session_grace_ms=20_000.0) as rig,
    ):
        works(rig)
        host = "127.0.0.2"
        first.shut()
        works(rig)
        assert second.connections
        event = rig.event(Event.CONTROLLER_BACK)
        assert event.text == f"controller plc.lab:{first.port} is at 127.0.0.2 now, not 127.0.0.1"


def test_backoff_is_at_most_two_seconds() -> None:
    from hilrig_modbus_edge.client.exchange import MAX_BACKOFF_S, MIN_BACKOFF_S

    assert (MIN_BACKOFF_S, MAX_BACKOFF_S) == (0.1, 2.0)
    with Plc() as plc:
        plc.fault = lambda *_: None
        with client_of(plc) as rig:
            eventually(lambda: plc.connections >= 4)
            times = [time_ns for time_ns, _ in plc.requests]
            gaps_s = [(later - earlier) / 1e9 for earlier, later in pairwise(times)]
            assert gaps_s[0] >= 0.09
            assert gaps_s[1] >= 1.5 * 0.1
            assert not torques(rig)
