"""Leak test of the edge: file handles and memory do not grow with connections, also malformed or aborted ones.

A few hundred connections; with HILRIG_LONG=1 ten thousand in ten minutes.
"""

import contextlib
import os
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from support.labs import RunningLab, write_lab
from support.waiting import eventually

pytestmark = [
    pytest.mark.rig,
    pytest.mark.skipif(sys.platform != "linux", reason="counts handles and memory in /proc"),
]

READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
WRITE = struct.pack(">HHHBBHH", 2, 0, 6, 1, 6, 0, 0)
NOT_MODBUS = b"GET / HTTP/1.1\r\n\r\n"
MIB = 2**20


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[RunningLab]:
    with RunningLab(write_lab(tmp_path, extra="edge.session_grace_ms = 100")) as running:
        yield running


def connect_once(port: int, number: int) -> None:
    """Open and close a connection; some of them write, send malformed data or half a request, or are reset."""
    with socket.create_connection(("127.0.0.1", port), timeout=5) as client:
        kind = number % 10
        if kind == 1:
            client.sendall(NOT_MODBUS)
        elif kind == 2:
            client.sendall(READ[:7])
        elif kind == 3:
            client.sendall(READ)
            # Reset instead of closed, with a response in flight.
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            return
        elif kind == 4:
            client.sendall(WRITE)
        else:
            client.sendall(READ)
        client.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            while client.recv(300):
                pass


def handles(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def resident(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def churn(lab: RunningLab, connections: int, seconds: float) -> tuple[int, int]:
    """Return the growth of handles and bytes by so many connections, after a warm-up with a tenth of them."""
    pid = lab.service_pid("edge")
    for number in range(max(200, connections // 10)):
        connect_once(lab.port, number)
    before_handles, before_bytes = settled(pid), resident(pid)
    begin_s = time.monotonic()
    for number in range(connections):
        connect_once(lab.port, number)
        # Spread over the time, so that growth with time is detected as well.
        time.sleep(max(0.0, begin_s + (number + 1) * seconds / connections - time.monotonic()))
    return settled(pid) - before_handles, resident(pid) - before_bytes


def settled(pid: int) -> int:
    """Return the number of handles when two consecutive readings agree."""

    def same_twice() -> int:
        first = handles(pid)
        time.sleep(0.1)  # the edge closes connections between the two readings
        return first if handles(pid) == first else 0

    return eventually(same_twice)


def test_hundreds_of_connections_leak_nothing(lab: RunningLab) -> None:
    more_handles, more_bytes = churn(lab, 600, 0.0)
    assert more_handles <= 0
    assert more_bytes < 4 * MIB
    assert "Traceback" not in lab.output()


@pytest.mark.long("takes ten minutes")
@pytest.mark.timeout(900)
def test_ten_thousand_connections_leak_nothing(lab: RunningLab, record_property: Callable[[str, object], None]) -> None:
    more_handles, more_bytes = churn(lab, 10_000, 600.0)
    record_property("handles", more_handles)
    record_property("bytes", more_bytes)
    print(f"10,000 connections over 600 s: {more_handles:+d} handles, {more_bytes / MIB:+.2f} MiB")
    assert more_handles <= 0
    assert more_bytes < 2 * MIB
    assert "Traceback" not in lab.output()
