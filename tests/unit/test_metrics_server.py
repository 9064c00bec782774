"""HTTP server of the metrics: scrapes are answered whatever other clients do."""

import http.client
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from urllib.request import urlopen

import pytest

from hilrig_monitoring import metrics_server
from hilrig_monitoring.metrics_server import MAX_CONNECTIONS, MetricsServer
from hilrig_runtime.listen_address import ListenAddress
from support.waiting import eventually


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[MetricsServer]:
    monkeypatch.setattr(metrics_server, "POLL_S", 0.02)
    with MetricsServer(ListenAddress("127.0.0.1", 0), lambda: "a 1\n") as server:
        yield server
    # The threads of the ended connections close them.
    eventually(lambda: not server._open)


def scrape(server: MetricsServer) -> bytes:
    with urlopen(f"http://127.0.0.1:{server.port}/metrics", timeout=3) as answer:
        return bytes(answer.read())


def connect(server: MetricsServer, source: str = "127.0.0.1") -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), timeout=3, source_address=(source, 0))


def is_closed(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(100) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def test_metrics_are_at_their_path_only(server: MetricsServer) -> None:
    assert scrape(server) == b"a 1\n"
    with urlopen(f"http://127.0.0.1:{server.port}/metrics", timeout=3) as answer:
        assert answer.headers["Content-Type"].split(";")[0] == "text/plain"
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=3)
    connection.request("GET", "/")
    assert connection.getresponse().status == 404
    connection.close()


def test_half_sent_requests_take_no_place(server: MetricsServer, monkeypatch: pytest.MonkeyPatch) -> None:
    # The time-out of a request closes none of them: they give way.
    monkeypatch.setattr(metrics_server, "REQUEST_TIMEOUT_S", 600.0)
    with ExitStack() as closing:
        opened = []
        for number in range(2 * MAX_CONNECTIONS):
            one = closing.enter_context(connect(server, f"127.0.6.{number % 9 + 1}" if number % 2 else "127.0.0.1"))
            one.sendall(b"GET /metrics HTTP/1.1\r\nHost: ")
            opened.append(one)
        start_s = time.monotonic()
        assert scrape(server) == b"a 1\n"
        assert time.monotonic() - start_s < 2
        eventually(lambda: sum(map(is_closed, opened)) >= MAX_CONNECTIONS)


def test_slow_request_ends_at_its_time(server: MetricsServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Although it sends a byte now and then."""
    monkeypatch.setattr(metrics_server, "REQUEST_TIMEOUT_S", 0.3)
    with connect(server) as slow:
        start_s = time.monotonic()
        with suppress(OSError):
            while time.monotonic() - start_s < 3:
                slow.sendall(b"X")
                time.sleep(0.05)  # several bytes within the time-out
        assert time.monotonic() - start_s < 2


@pytest.mark.parametrize(
    "data",
    [b"GET /metrics\r\n", b"GET /metrics HTTP/1.1\r\n" + b"X: a\r\n" * 1000, b"\0" * 70_000, b"\x16\x03\x01\x02\0\1"],
    ids=["HTTP/0.9", "many headers", "binary", "TLS"],
)
def test_odd_requests_end(server: MetricsServer, data: bytes, caplog: pytest.LogCaptureFixture) -> None:
    with connect(server) as odd, suppress(ConnectionError):
        odd.sendall(data)
        odd.shutdown(socket.SHUT_WR)
        while odd.recv(65536):
            pass
    assert scrape(server) == b"a 1\n"
    assert not caplog.records


def test_reset_connections_are_no_errors(server: MetricsServer, caplog: pytest.LogCaptureFixture) -> None:
    for number in range(200):
        reset = connect(server, f"127.0.7.{number + 1}")
        reset.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        reset.sendall(b"GET /metrics HTTP/1.1\r\n\r\n" if number % 2 else b"GET ")
        reset.close()
    assert scrape(server) == b"a 1\n"
    eventually(lambda: not len(server._open))
    assert not caplog.records
