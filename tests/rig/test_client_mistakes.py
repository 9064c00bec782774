"""Clients with a mistake, on real sockets: each is named with its cause and the fix, counted, and harms no other."""

import logging
import socket
import sys
import time

import pytest

from hilrig_modbus_edge.server.exception_log import MAX_HOSTS, OTHER_HOSTS
from hilrig_schemas import Event, ExceptionCount, RigReport
from support.edge_rig import EdgeRig, RawClient, running_edge
from support.waiting import eventually

pytestmark = pytest.mark.rig


def crc(data: bytes) -> bytes:
    """Return the CRC-16 of a frame of Modbus RTU, from the definition of its polynomial."""
    register = 0xFFFF
    for bit in range(8 * len(data)):
        register ^= data[bit // 8] >> bit % 8 & 1
        register = register >> 1 ^ 0xA001 * (register & 1)
    return register.to_bytes(2, "little")


def rtu(pdu: str) -> bytes:
    frame = b"\x01" + bytes.fromhex(pdu)
    return frame + crc(frame)


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.startswith("hilrig_modbus_edge")]


def report_of(rig: EdgeRig) -> RigReport:
    [report] = rig.service.health.rig_reports()
    return report


# -- refused requests


def test_refused_requests_are_counted_and_explained(caplog: pytest.LogCaptureFixture) -> None:
    mistakes = {
        "03 0000 000A": (3, 2, "read holding registers 1-10, only 1-8 exist (exception 02): reduce the count to 8"),
        "05 0000 0001": (5, 3, "use FF00 for on and 0000 for off"),
        "08 0000 0000": (0, 1, "sent function 8, the rig does not have this function"),
    }
    with caplog.at_level(logging.WARNING), running_edge() as rig, rig.client() as client:
        for _ in range(20):
            for request in mistakes:
                assert client.ask(request)[0] & 0x80
        assert client.ask("03 0004 0004", unit=16)[0] & 0x80
        found = {(row.function, row.code): (row.host, row.count) for row in report_of(rig).exceptions}
        assert found == {(f, c): ("127.0.0.1", 20) for f, c, _ in mistakes.values()} | {(3, 11): ("127.0.0.1", 1)}
        logged = lines(caplog)
        assert len(logged) == len(mistakes) + 1
        for line, (_, _, text) in zip(logged, mistakes.values(), strict=False):
            assert line.startswith(f"rig rig1: {client.address} ")
            assert text in line
        assert "set unit id 1" in report_of(rig).alert
        assert rig.service.counters.refused == 0


def test_refused_writes_are_counted_as_refused() -> None:
    with running_edge(lease="connection") as rig, rig.client() as holder, rig.client() as other:
        holder.write(0, 5)
        for _ in range(3):
            assert other.write(0, 6).hex() == "9006"
        assert rig.service.counters.refused == 3
        [row] = report_of(rig).exceptions
        assert row == ExceptionCount(host="127.0.0.1", function=16, code=6, count=3)


def test_hosts_beyond_the_limit_are_counted_together() -> None:
    hosts = MAX_HOSTS + 3
    with running_edge(max_connections=hosts) as rig:
        for number in range(hosts):
            with socket.create_connection(("127.0.0.1", rig.port), 5, (f"127.0.1.{number + 1}", 0)) as connected:
                connected.sendall(bytes.fromhex("0001 0000 0006 01 03 0000 000A"))
                assert connected.recv(99)[7:] == b"\x83\x02"
        counted = {row.host: row.count for row in report_of(rig).exceptions}
        assert len(counted) == MAX_HOSTS + 1
        assert counted[OTHER_HOSTS] == 3


# -- other protocols


FOREIGN = {
    "RTU, one register": (rtu("03 0000 0001"), "Modbus RTU"),
    "RTU, four registers": (rtu("03 0000 0004"), "Modbus RTU"),
    "RTU, positions": (rtu("03 0004 0004"), "Modbus RTU"),
    "RTU, write of one register": (rtu("06 0000 01F4"), "Modbus RTU"),
    "RTU, write of four registers": (rtu("10 0000 0004 08 01F4 0000 0000 0000"), "Modbus RTU"),
    "RTU, coil": (rtu("05 0000 FF00"), "Modbus RTU"),
    "ASCII": (b":010300040004F4\r\n", "Modbus ASCII"),
    "HTTP": (b"GET / HTTP/1.1\r\nHost: rig\r\n\r\n", "HTTP"),
    "HTTP, POST": (b"POST /api HTTP/1.1\r\n\r\n", "HTTP"),
    "TLS": (bytes.fromhex("16 03 01 02 00 01 00 01 FC 03 03") + bytes(40), "TLS"),
    "part of a request": (bytes.fromhex("0001 0000 0006 01 03"), "8 bytes of a longer request"),
    "random": (bytes.fromhex("DE AD BE EF 00 06 01 03"), "protocol identifier 0xbeef"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_protocol_is_named(name: str, caplog: pytest.LogCaptureFixture) -> None:
    """The client sends its data and closes the connection, as one does that gets no answer."""
    data, expected = FOREIGN[name]
    with caplog.at_level(logging.WARNING), running_edge() as rig:
        with rig.client() as client:
            address = client.address
            client.send(data)
            client.socket.shutdown(socket.SHUT_WR)
            while not client.closed():
                pass
        line = eventually(lambda: next((line for line in lines(caplog) if expected in line), None))
        assert line.startswith(f"rig rig1: {address} ")
        with rig.client() as good:
            assert good.read(0, 1) == [0]


def test_stalled_foreign_frame_is_named_while_connected(caplog: pytest.LogCaptureFixture) -> None:
    """Eight bytes of RTU are the beginning of a longer request of Modbus TCP: the edge can only wait for the rest."""
    with caplog.at_level(logging.WARNING), running_edge() as rig, rig.client() as client:
        client.send(rtu("03 0000 0004"))
        [line] = eventually(lambda: lines(caplog))
        assert "Modbus RTU with CRC-16 and sends nothing more: select Modbus TCP" in line
        assert "01 03 00 00 00 04 44 09" in line
        assert report_of(rig).alert in line


def test_request_in_slow_pieces_is_answered_without_log(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), running_edge() as rig, rig.client() as client:
        for byte in client.frame(b"\x03\x00\x00\x00\x01"):
            client.send(bytes((byte,)))
            time.sleep(0.02)  # a segment of its own for each byte
        assert client.receive()[2] == b"\x03\x02\x00\x00"
        assert not lines(caplog)


# -- header and PDU in two segments


@pytest.mark.skipif(sys.platform != "linux", reason="TCP_QUICKACK is an option of Linux")
@pytest.mark.parametrize("split", [1, 6, 7, 8])
def test_request_in_two_segments_is_not_delayed(split: int) -> None:
    """With Nagle's algorithm the second segment waits for the acknowledgment of the first one, 40 ms if delayed."""
    with running_edge() as rig, rig.client() as client:
        client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0)
        frame = client.frame(b"\x03\x00\x04\x00\x04")
        begin = time.monotonic()
        for _ in range(50):
            client.send(frame[:split])
            client.send(frame[split:])
            client.receive()
        assert time.monotonic() - begin < 1, "delayed requests take two seconds"


# -- idle connections


def test_idle_connection_stays_while_there_is_room() -> None:
    with running_edge(idle_timeout_s=0.2, max_connections=2) as rig, rig.client() as idle, rig.client() as other:
        idle.write(0, 0)
        other.read(0, 1)
        time.sleep(0.9)  # longer than the time-out that must not be applied
        assert idle.read(0, 1) == [0]


def test_longest_idle_connection_makes_room() -> None:
    with running_edge(idle_timeout_s=0.2, max_connections=3) as rig:
        clients = [rig.client() for _ in range(3)]
        for client in clients:
            client.read(0, 1)
        time.sleep(0.3)  # longer than the time-out: all connections are idle
        clients[0].read(0, 1)
        with rig.client() as fourth:
            assert fourth.read(0, 1) == [0]
            assert clients[1].closed()
            clients[2].read(0, 1)
            with rig.client() as refused:
                assert refused.closed()
        assert clients[0].read(0, 1) == [0]
        for client in clients:
            client.close()


def test_idle_connection_of_the_same_host_makes_room() -> None:
    with (
        running_edge(idle_timeout_s=0.2, max_connections_per_host=2) as rig,
        socket.create_connection(("127.0.0.1", rig.port), 5, ("127.0.0.9", 0)) as foreign,
        rig.client() as idle,
        rig.client() as used,
    ):
        frame = used.frame(b"\x03\x00\x00\x00\x01")
        foreign.sendall(frame)
        assert foreign.recv(99)
        idle.read(0, 1)
        time.sleep(0.3)  # longer than the time-out: all connections are idle
        used.read(0, 1)
        with rig.client() as third:
            assert third.read(0, 1) == [0]
            assert idle.closed()
            foreign.sendall(frame)
            assert foreign.recv(99)


def test_abandoned_connections_do_not_lock_a_client_out() -> None:
    """A client opens a connection for each request and never closes it."""
    with running_edge(idle_timeout_s=0.05, max_connections_per_host=4) as rig:
        clients: list[RawClient] = []
        for _ in range(12):
            clients.append(rig.client())
            assert clients[-1].read(0, 1) == [0]
            time.sleep(0.03)  # three connections exceed the time-out, one does not
        assert rig.service.counters.refused == 0
        for client in clients:
            client.close()


# -- a controller that only polls


def test_rig_is_not_held_by_a_client_that_only_polls() -> None:
    with (
        running_edge(watchdog_ms=300.0, watchdog_min_ms=10.0, lease="connection") as rig,
        rig.client() as polls,
        rig.client() as other,
    ):
        polls.write(0, 5)
        assert other.write(0, 6).hex() == "9006"

        def accepted() -> bool:
            polls.read(4, 4)
            return other.write(0, 6).hex() == "1000000001"

        eventually(accepted)
        assert polls.write(0, 7).hex() == "9006"
        assert rig.event(Event.WATCHDOG_TRIP)
