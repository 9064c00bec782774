"""Tests of the edge on real sockets: timestamps, lease, sessions, watchdog, limits, request log, shutdown."""

import socket
import struct
import sys
import threading
import time
from contextlib import ExitStack
from functools import partial

import pytest

from hilrig_modbus_edge.command_scheduler import COALESCE_WINDOW_NS
from hilrig_modbus_edge.registers.map import SEPARATE_WRITES
from hilrig_modbus_edge.service import run
from hilrig_runtime.addresses import format_address
from hilrig_runtime.bus.memory_bus import MemoryBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.service import Service
from hilrig_schemas import Event, LeaseRequest, LeaseStatus, RigBatch, ServiceInfo, TorqueCommand, topics
from support.edge_rig import EdgeRig, RawClient, counts, now_ns, running_edge
from support.foreign_requests import assert_refuses_foreign_requests
from support.labs import free_ports
from support.waiting import eventually

pytestmark = pytest.mark.rig


# -- timestamps


def test_write_has_timestamps_in_chronological_order() -> None:
    with running_edge() as rig, rig.client() as client:
        began_ns = now_ns()
        state = rig.state()
        assert client.read(4, 4) == counts()
        client.write(0, 1000, -1000, 0, 5)
        command = rig.commands[-1]
        assert list(command.effort) == [1.0, -1.0, 0.0, 0.005]
        assert (command.basis_incarnation, command.basis_step) == (state.incarnation, state.step)
        stamps = [
            began_ns,
            command.state_arrived_ns,
            command.state_served_ns,
            *([command.write_received_ns] if sys.platform == "linux" else []),
            command.write_arrived_ns,
            command.sent_ns,
            now_ns(),
        ]
        assert stamps == sorted(stamps)
        assert command.controller == client.address


def test_pipelined_requests_give_no_negative_stage() -> None:
    with running_edge() as rig, rig.client() as client:
        read = client.frame(b"\x03\x00\x04\x00\x04")
        write = client.frame(bytes.fromhex("10 00 00 00 01 02 00 01"))
        for _ in range(200):
            rig.state()
            client.send(read + write + read + write)
            for _ in range(4):
                client.receive()
        measured = [command for command in rig.commands if command.basis_step]
        assert len(measured) > 300
        for command in measured:
            assert 0 < command.state_arrived_ns <= command.state_served_ns
            assert command.state_served_ns <= command.write_arrived_ns <= command.sent_ns
            assert command.write_received_ns == 0 or command.state_served_ns <= command.write_received_ns


def test_two_connections_give_no_negative_stage() -> None:
    """Both are sent at once: the kernel may receive the write before the state is served that the edge serves first."""
    with running_edge() as rig, rig.client() as reader, rig.client() as writer:
        read = reader.frame(b"\x03\x00\x04\x00\x04")
        write = writer.frame(bytes.fromhex("10 00 00 00 01 02 00 01"))
        for _ in range(300):
            rig.state()
            reader.send(read)
            writer.send(write)
            for client in (reader, writer):
                client.receive()
        measured = [command for command in rig.commands if command.basis_step]
        assert len(measured) > 250
        for command in measured:
            assert command.basis_on_other_connection
            assert command.write_received_ns == 0 or command.state_served_ns <= command.write_received_ns


def test_every_request_is_in_the_request_log() -> None:
    with running_edge() as rig, rig.client() as client:
        client.write(0, 7)
        client.read(4, 4)
        client.write(8, 1)
        logged = eventually(lambda: sum(len(t.arrived_ns) for t in rig.traffic) == 3 and rig.traffic)
        kinds = [traffic.kinds[index] for traffic in logged for index in traffic.kind_indexes]
        assert [(kind.function, kind.address, kind.count, kind.exception) for kind in kinds] == [
            (16, 0, 1, 0),
            (3, 4, 4, 0),
            (16, 8, 1, 2),
        ]
        assert all(kind.controller == client.address for kind in kinds)
        arrived_ns = [arrived_ns for traffic in logged for arrived_ns in traffic.arrived_ns]
        assert arrived_ns == sorted(arrived_ns)
        assert all(0 <= after_ns < 1_000_000_000 for traffic in logged for after_ns in traffic.answered_after_ns)


@pytest.mark.skipif(sys.platform != "linux", reason="TCP_INFO has these figures on Linux")
def test_request_log_has_tcp_figures_once_a_second() -> None:
    with running_edge() as rig, rig.client() as client:
        begin_ns = now_ns()
        round_trips_us = []
        while now_ns() < begin_ns + 2_500_000_000:
            sent_ns = now_ns()
            client.read(4, 4)
            round_trips_us.append((now_ns() - sent_ns) // 1000)
            time.sleep(0.02)  # the period of a controller
        figures = [figures for traffic in rig.traffic for figures in traffic.connections]
        assert 2 <= len(figures) <= 4
        for one in figures:
            assert one.controller == client.address
            assert one.retransmissions == 0
            assert 0 < one.min_rtt_us <= min(round_trips_us)


def test_busy_polling_client_sends_few_messages_a_step() -> None:
    steps, burst = 50, 64
    with running_edge() as rig, rig.client() as plc, MemoryBus(rig.hub) as simulation:
        sent: list[TorqueCommand] = []

        def receive(_: str, payload: bytes) -> None:
            (command,) = RigBatch.FromString(payload).messages
            sent.append(TorqueCommand.FromString(command))

        def write(number: int) -> bytes:
            return struct.pack(">BHHBH", 16, 0, 1, 2, number % 1000)

        simulation.subscribe(topics.COMMANDS.key(rig.lab.name, "edge", "*"), receive)
        written = 0
        begin_ns = now_ns()
        for step in range(steps):
            rig.state()
            while now_ns() < begin_ns + (step + 1) * rig.lab.sim.step_ns:
                # Bursts, so that the client is fast even where the machine gives it little time.
                plc.send(b"".join(plc.frame(write(number)) for number in range(written, written + burst)))
                for _ in range(burst):
                    plc.receive()
                written += burst
        elapsed_ns = now_ns() - begin_ns
        recorded = [round(command.effort[0] * 1000) for command in rig.commands if command.controller]
        assert recorded == [number % 1000 for number in range(written)]
    sequences = [command.seq for command in sent]
    assert sequences == sorted(sequences)
    assert len(sent) <= elapsed_ns // COALESCE_WINDOW_NS + (SEPARATE_WRITES + 1) * steps < written


# -- lease


def test_one_client_writes_and_both_read() -> None:
    with running_edge() as rig, rig.client() as holder, rig.client() as other:
        holder.write(0, 500)
        assert other.write(0, 900).hex() == "9006"
        # It may write something else: it is a connection of the same controller.
        assert other.ask("05 00 00 FF 00").hex() == "050000ff00"
        assert other.read(0, 1) == [500]
        refusal = rig.event(Event.LEASE_REFUSED)
        assert (refusal.controller_data.controller, refusal.controller_data.holder) == (other.address, holder.address)
        holder.close()
        eventually(lambda: other.write(0, 900).hex() == "1000000001")
        assert rig.kinds().count("LEASE_GRANTED") == 1


def test_operator_queries_and_revokes_the_lease() -> None:
    with running_edge() as rig, rig.client() as holder, MemoryBus(rig.hub) as teacher:
        key = topics.LEASE.key(rig.lab.name, "rig1")

        def ask(release: bool = False) -> LeaseStatus:
            [answer] = teacher.query(key, LeaseRequest(release=release).SerializeToString())
            return LeaseStatus.FromString(answer.payload)

        assert ask().holder == ""
        holder.write(0, 1)
        assert (ask().holder, ask().connections) == (holder.address, 1)
        assert (released := ask(release=True)).released == holder.address
        assert released.holder == ""
        assert ask(release=True).released == ""
        # The previous holder cannot acquire it again at once.
        assert holder.write(0, 1).hex() == "9006"
        with rig.client() as other:
            other.write(0, 1)
            assert ask().holder == other.address


# -- sessions


def test_session_survives_reconnects_and_ends_after_grace() -> None:
    with running_edge(session_grace_ms=300) as rig:
        for _ in range(3):
            with rig.client() as client:
                client.write(0, 0)
        eventually(lambda: "SESSION_END" in rig.kinds())
        assert [kind for kind in rig.kinds() if "SESSION" in kind] == ["SESSION_START", "SESSION_END"]
        session = rig.event(Event.SESSION_START).session
        assert session
        assert {command.session for command in rig.commands} == {session, ""}
        assert rig.commands[-1].session == ""
        eventually(lambda: not rig.sessions)


TCP_REPAIR = 19
"""Linux socket option: a connection closed in repair mode sends nothing, as if its host had lost its power."""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can close a connection without sending anything")
def test_client_after_power_loss_continues_its_session() -> None:
    write = bytes.fromhex("00 01 00 00 00 06 01 06 00 00 01 F4")
    # No other test connects from this address, so that no other connection gets the port while it is closed.
    with running_edge() as rig, connect_from(rig, "127.0.5.1") as holder:
        source = holder.getsockname()
        holder.sendall(write)
        assert holder.recv(300) == write
        try:
            holder.setsockopt(socket.IPPROTO_TCP, TCP_REPAIR, 1)
        except OSError:
            pytest.skip("needs CAP_NET_ADMIN, to close a connection without sending anything")
        holder.close()
        with socket.create_connection(("127.0.0.1", rig.port), timeout=10, source_address=source) as again:
            again.sendall(write)
            assert again.recv(300) == write
        assert "connection lost" in rig.event(Event.LEASE_LOST).text
        assert rig.kinds().count("SESSION_START") == 1
        eventually(lambda: rig.service.counters.connections == 0)


def test_open_sessions_are_announced() -> None:
    with running_edge() as rig, rig.client() as client:
        client.write(0, 0)
        eventually(lambda: rig.sessions == [rig.event(Event.SESSION_START).session])


def test_shutdown_ends_torque_and_session() -> None:
    with running_edge() as rig, rig.client() as client:
        client.write(0, 1000)
        rig.service.stop()
        eventually(lambda: rig.commands[-1].safe)
        assert list(rig.commands[-1].effort) == [0, 0, 0, 0]
        eventually(lambda: "SESSION_END" in rig.kinds())
        assert client.closed()
    assert rig.sessions == []


# -- watchdog


@pytest.mark.parametrize("how", ["closes", "is silent", "reads on"])
def test_torque_is_zero_within_the_timeout(how: str) -> None:
    timeout_ms = 200
    with running_edge(watchdog_ms=timeout_ms) as rig, rig.client() as client:
        client.write(0, 1000)
        write = rig.commands[-1]
        if how == "closes":
            client.close()
        while not rig.commands[-1].safe:
            if how == "reads on":
                client.read(4, 4)
            else:
                time.sleep(0.001)  # polls for the event without a request to the rig
        safe = rig.commands[-1]
        silent_ms = (safe.sent_ns - write.write_arrived_ns) / 1e6
        # Not later: tests/unit/test_device.py, with a clock of its own.
        assert timeout_ms <= silent_ms < timeout_ms + 1000
        cause = {
            "closes": "no longer holds the lease",
            "is silent": "no request from",
            "reads on": "reads but does not write",
        }[how]
        assert cause in rig.event(Event.WATCHDOG_TRIP).text


def test_timeout_register_is_active_at_once() -> None:
    with running_edge() as rig, rig.client() as client:
        client.write(0, 1000)
        client.write(101, 100)
        eventually(lambda: rig.commands[-1].safe, timeout_s=0.5)


def test_held_command_is_repeated() -> None:
    with running_edge(repeat_ms=50) as rig, rig.client() as client:
        client.write(0, 1000)
        seq = rig.commands[-1].seq
        eventually(lambda: [repeat.seq for repeat in rig.repeats].count(seq) >= 3)


# -- admission and idle timeout


def test_connections_are_limited_and_reported() -> None:
    with running_edge(max_connections=2, max_connections_per_host=5) as rig:
        with rig.client() as one, rig.client() as two:
            one.read(0, 1)
            two.read(0, 1)
            with rig.client() as three:
                assert three.closed()
            refusal = rig.event(Event.CONNECTION_REFUSED)
            assert "max_connections" in refusal.text
            assert rig.service.counters.refused == 1
            assert one.read(0, 1) == [0]
        with rig.client() as four:
            assert four.read(0, 1) == [0]


def test_connections_of_one_host_are_limited() -> None:
    with running_edge(max_connections=5, max_connections_per_host=1) as rig, rig.client() as one:
        one.read(0, 1)
        with rig.client() as two:
            assert two.closed()
        assert "max_connections_per_host" in rig.event(Event.CONNECTION_REFUSED).text


def connect_from(rig: EdgeRig, source: str) -> socket.socket:
    return socket.create_connection(("127.0.0.1", rig.port), timeout=5, source_address=(source, 0))


def test_silent_connections_of_many_hosts_take_no_place() -> None:
    """A hundred hosts send nothing, or reset their connection: neither a new nor a connected client notices."""
    with running_edge(max_connections=8, idle_timeout_s=0) as rig, rig.client() as owner, ExitStack() as closing:
        owner.write(0, 100)
        for number in range(100):
            silent = closing.enter_context(connect_from(rig, f"127.0.9.{number + 1}"))
            if number % 3 == 0:
                silent.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                silent.close()
        for _ in range(3):
            with rig.client() as new:
                assert new.read(4, 4) == counts()
        owner.write(0, 200)
        eventually(lambda: rig.service.counters.connections <= 8)
        assert not [event for event in rig.events if event.kind == Event.LEASE_LOST]
        refusals = [event for event in rig.events if event.kind == Event.CONNECTION_REFUSED]
        assert "no request before its place was needed" in refusals[0].text
        assert len(refusals) <= 40


def test_silent_connection_of_the_most_crowded_host_gives_way() -> None:
    with running_edge(max_connections=4) as rig, ExitStack() as closing:
        patient = closing.enter_context(connect_from(rig, "127.0.0.2"))
        crowd = [closing.enter_context(connect_from(rig, "127.0.0.3")) for _ in range(3)]
        eventually(lambda: rig.service.counters.connections == 4)
        with rig.client() as new:
            assert new.read(0, 1) == [0]
            patient.sendall(new.frame(b"\x03\x00\x00\x00\x01"))
            assert patient.recv(64)
        assert [one.recv(64) for one in crowd[:1]] == [b""]


def test_only_allowed_networks_may_connect() -> None:
    with running_edge(allow=["10.0.0.0/8"]) as rig:
        with rig.client() as client:
            assert client.closed()
        assert "allow-list" in rig.event(Event.CONNECTION_REFUSED).text
    with running_edge(allow=["10.0.0.0/8", "127.0.0.0/8"]) as rig, rig.client() as client:
        assert client.read(0, 1) == [0]


def test_incomplete_request_does_not_keep_connection_open() -> None:
    with running_edge(idle_timeout_s=0.3) as rig, rig.client() as client:
        client.send(client.frame(b"\x03\x00\x00\x00\x01")[:9])
        assert client.closed()


def test_client_that_does_not_read_does_not_delay_others() -> None:
    with running_edge() as rig, rig.client() as blocked, rig.client() as good:
        blocked.socket.settimeout(0.2)
        request = blocked.frame(b"\x04\x00\x00\x00\x24") * 400
        sent = 0
        try:
            while sent < 200_000_000:
                sent += blocked.socket.send(request)
        except TimeoutError:
            pass
        # The edge has stopped reading from it, long before memory was exhausted.
        assert sent < 100_000_000
        for _ in range(200):
            begin = time.monotonic()
            good.read(4, 4)
            assert time.monotonic() - begin < 1


# -- listening addresses


def test_port_in_use_is_reported_with_rig_and_address() -> None:
    port = free_ports(1)
    lab = LabConfig.model_validate({"rigs": [{"name": "left", "port": port}]})
    with running_edge() as other:
        lab = LabConfig.model_validate({"rigs": [{"name": "left", "port": other.port}]})
        with Service("edge", lab, MemoryBus()) as service, pytest.raises(OperationError) as refusal:
            run(service)
    text = str(refusal.value)
    assert "'left'" in text
    assert f"127.0.0.1:{other.port}" in text
    assert "lab.toml" in text


def test_rigs_are_independent() -> None:
    with running_edge(rigs=("left", "right")) as rig, rig.client("left") as left, rig.client("right") as right:
        left.write(0, 100)
        right.write(0, 200)
        assert (left.read(0, 1), right.read(0, 1)) == ([100], [200])
        assert {command.rig: command.effort[0] for command in rig.commands} == {"left": 0.1, "right": 0.2}


def test_requests_of_other_versions_are_refused() -> None:
    with running_edge() as rig, MemoryBus(rig.hub) as bus:
        assert_refuses_foreign_requests(bus, rig.lab.name, ServiceInfo(service="edge", instance="1"))
        for topic, name in ((topics.LEASE, "LeaseRequest"), (topics.IMPAIRMENT, "ImpairmentRequest")):
            (reply,) = bus.query(topic.key(rig.lab.name, "rig1"), b"\xff\x00rubbish")
            assert reply.error == f"not a valid {name}: 9 bytes can't be decoded"


def test_early_client_is_served_after_the_first_state() -> None:
    port = free_ports(1)
    lab = LabConfig.model_validate({"rigs": [{"port": port}]})
    bus = MemoryBus()
    with Service("edge", lab, bus) as service:
        rig = EdgeRig(lab, bus.hub, service)
        thread = threading.Thread(target=run, args=(service,))
        thread.start()
        try:
            client = eventually(lambda: _connect(port))
            with client:
                client.send(client.frame(struct.pack(">BHH", 3, 4, 4)))
                rig.state()
                assert client.receive()[2] == struct.pack(">BB4H", 3, 8, *counts())
        finally:
            service.stop()
            thread.join(10)


def _connect(port: int) -> RawClient | None:
    try:
        return RawClient("127.0.0.1", port)
    except ConnectionRefusedError:
        return None


def accepts_a_write(client: RawClient) -> bool:
    return client.write(0, 5).hex() == "1000000001"


def test_listens_on_ipv4_and_ipv6_at_once() -> None:
    if not socket.has_dualstack_ipv6():
        pytest.skip("this machine has no IPv6")
    with running_edge(host="::", allow=["127.0.0.0/8", "::1/128"], lease="connection") as rig:
        for host in ("127.0.0.1", "::1"):
            with RawClient(host, rig.port) as client:
                eventually(partial(accepts_a_write, client))
                assert rig.commands[-1].controller == format_address(host, client.socket.getsockname()[1])
        address = rig.service.addresses("rig1")
        assert f"{socket.gethostname()}:{rig.port}" in address
        assert ":::" not in address
    with running_edge(host="::", allow=["10.0.0.0/8"]) as rig, RawClient("127.0.0.1", rig.port) as client:
        assert client.closed()


def test_rigs_have_the_same_port_at_several_addresses() -> None:
    port = free_ports(1)
    rigs = [{"name": f"rig{number}", "host": f"127.0.0.{number}", "port": port} for number in (1, 2)]
    with running_edge(("rig1", "rig2"), rig_settings=rigs):
        for number in (1, 2):
            with RawClient(f"127.0.0.{number}", port) as client:
                client.write(0, number)
        for number in (1, 2):
            with RawClient(f"127.0.0.{number}", port) as client:
                assert client.read(0, 1) == [number]


def test_listens_on_ipv6() -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    with running_edge(host="::1", allow=["::1/128"]) as rig, rig.client() as client:
        client.write(0, 5)
        assert rig.commands[-1].controller == f"[::1]:{client.socket.getsockname()[1]}"
