"""Limits of the console's HTTP server: half-sent requests end and take no place of a browser."""

import socket
import ssl
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from hilrig_console import http_limits
from hilrig_console.http_limits import ConnectionTable, LimitedProtocol
from hilrig_console.serving import TlsFiles
from support.bus_certificates import make_bus_folder
from support.waiting import eventually

REQUEST = b"GET / HTTP/1.1\r\nHost: console\r\n\r\n"
LARGE = 8 << 20
"""Size of a response that the buffers of both systems do not hold, bytes."""


async def app(scope: Any, receive: Any, send: Any) -> None:
    del receive
    body = b"ok" if scope["path"] == "/" else bytes(LARGE)
    length = str(len(body)).encode()
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", length)]})
    if scope["path"] == "/parts":
        await send({"type": "http.response.body", "body": body[:-1], "more_body": True})
        body = body[-1:]
    await send({"type": "http.response.body", "body": body})


@dataclass
class Server:
    """A running server with few connections and a short time for requests."""

    address: tuple[str, int]
    table: ConnectionTable


@contextmanager
def running(context: ssl.SSLContext | None = None) -> Iterator[Server]:
    table = ConnectionTable(16, 8)
    http: Any = partial(LimitedProtocol, table, context)
    server = uvicorn.Server(uvicorn.Config(app, http=http, lifespan="off", log_config=None, ws="none"))
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        eventually(lambda: server.started)
        yield Server(listening.getsockname(), table)
        server.should_exit = True
        thread.join(timeout=5)
    assert not len(table.open)
    assert not len(table.waiting)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(http_limits, "REQUEST_TIMEOUT_S", 0.2)
    with running() as server:
        yield server


def get(connection: socket.socket) -> bytes:
    connection.settimeout(3)
    connection.sendall(REQUEST)
    answer = b""
    # Header and body may arrive separately.
    while not answer.endswith(b"ok") and (chunk := connection.recv(1000)):
        answer += chunk
    return answer


def is_closed(connection: socket.socket) -> bool:
    connection.settimeout(3)
    try:
        return connection.recv(100) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize(
    "part",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: con",
        b"POST / HTTP/1.1\r\nHost: console\r\nContent-Length: 9\r\n\r\nhalf",
    ],
)
def test_half_sent_request_is_closed(server: Server, part: bytes) -> None:
    with socket.create_connection(server.address) as connection:
        connection.sendall(part)
        start_s = time.monotonic()
        answer = b""
        connection.settimeout(3)
        try:
            while chunk := connection.recv(1000):
                answer += chunk
        except ConnectionResetError:
            pass
        assert time.monotonic() - start_s < 2


def test_second_request_on_a_connection_is_limited_too(server: Server) -> None:
    with socket.create_connection(server.address) as connection:
        assert get(connection).endswith(b"ok")
        for _ in range(3):
            time.sleep(0.1)  # the sum of the pauses exceeds the time-out of one request
            assert get(connection).endswith(b"ok")
        connection.sendall(REQUEST[:20])
        assert is_closed(connection)


@pytest.mark.parametrize("secured", [False, True])
def test_half_sent_requests_take_no_place(tmp_path: Path, secured: bool) -> None:
    """Neither those of other hosts nor those of the browser's host; with TLS half-sent handshakes."""
    trusting = None
    with ExitStack() as closing:
        context = None
        if secured:
            authority = make_bus_folder(tmp_path / "certs", ["console"])
            context = TlsFiles(tmp_path / "certs/console.pem", tmp_path / "certs/console.key").context()
            trusting = ssl.create_default_context(cadata=authority.certificate_pem.decode())
        server = closing.enter_context(running(context))
        for number in range(60):
            source = (f"127.0.3.{number % 7}" if number % 2 else "127.0.0.1", 0)
            one = closing.enter_context(socket.create_connection(server.address, source_address=source))
            # A half-sent request and the first bytes of a TLS handshake.
            one.sendall(b"\x16\x03\x01\x02" if secured else REQUEST[:30])
        for _ in range(3):
            plain = closing.enter_context(socket.create_connection(server.address, timeout=3))
            browser = plain if trusting is None else trusting.wrap_socket(plain, server_hostname="127.0.0.1")
            assert get(closing.enter_context(browser)).endswith(b"ok")
        assert len(server.table.open) <= 16


def test_answered_requests_keep_no_place() -> None:
    """Connections that stay open after a complete request give way to new ones."""
    with running() as server, ExitStack() as closing:
        for number in range(40):
            source = (f"127.0.3.{number % 5}", 0)
            one = closing.enter_context(socket.create_connection(server.address, source_address=source))
            assert get(one).endswith(b"ok")
        assert len(server.table.open) <= 16


@pytest.mark.parametrize("repeated", [1, 3])
def test_unread_responses_take_no_place(repeated: int) -> None:
    with running() as server, ExitStack() as closing:
        for number in range(40):
            one = closing.enter_context(
                socket.create_connection(server.address, source_address=(f"127.0.3.{number % 5}", 0))
            )
            one.sendall(REQUEST.replace(b"/ ", b"/parts ", 1) * repeated)
            one.settimeout(3)
            with suppress(ConnectionResetError):
                one.recv(100)
        for _ in range(3):
            assert get(closing.enter_context(socket.create_connection(server.address))).endswith(b"ok")
        assert len(server.table.open) <= 16


def test_response_that_is_read_slowly_is_complete(server: Server) -> None:
    with socket.create_connection(server.address, timeout=3) as connection:
        connection.sendall(REQUEST.replace(b"/ ", b"/whole ", 1))
        assert connection.recv(1)
        time.sleep(0.5)  # longer than the time-out of a request
        received = 1
        while received < LARGE and (chunk := connection.recv(1 << 20)):
            received += len(chunk)
    assert received >= LARGE


@pytest.mark.parametrize(
    ("data", "answer"),
    [
        (b"GET /\r\n\r\n", b"HTTP/1.1 400"),
        (b"GET / HTTP/1.1\r\nHost: console\r\nX: " + b"a" * 200_000, b"HTTP/1.1 400"),
        (
            REQUEST[:-2] + b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n",
            b"HTTP/1.1 200",
        ),
        (REQUEST * 200, b"HTTP/1.1 200"),
        (b"\0" * 100, b"HTTP/1.1 400"),
    ],
    ids=["HTTP/0.9", "huge header", "websocket", "pipelined", "binary"],
)
def test_odd_requests_end_within_the_limits(server: Server, data: bytes, answer: bytes) -> None:
    with socket.create_connection(server.address, timeout=3) as connection:
        received = b""
        # The server may answer and close before it has read everything.
        with suppress(OSError):
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
        with suppress(OSError):
            while chunk := connection.recv(65536):
                received += chunk
    assert received.startswith(answer)
    eventually(lambda: not len(server.table.open))


def test_reset_connections_leave_nothing(server: Server) -> None:
    for number in range(300):
        connection = socket.create_connection(server.address, source_address=(f"127.0.4.{number % 250}", 0))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.sendall(REQUEST[: number % len(REQUEST)])
        connection.close()
    with socket.create_connection(server.address) as connection:
        assert get(connection).endswith(b"ok")
    eventually(lambda: not len(server.table.open))
