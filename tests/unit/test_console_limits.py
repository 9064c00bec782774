"""Limits of the console's HTTP server: half-sent requests end, and one host can't take all connections."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import uvicorn

from hilrig_console import http_limits
from hilrig_console.http_limits import LimitedProtocol
from support.waiting import eventually

REQUEST = b"GET / HTTP/1.1\r\nHost: console\r\n\r\n"


async def app(scope: Any, receive: Any, send: Any) -> None:
    del scope, receive
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
    await send({"type": "http.response.body", "body": b"ok"})


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, int]]:
    monkeypatch.setattr(http_limits, "REQUEST_TIMEOUT_S", 0.2)
    monkeypatch.setattr(http_limits, "MAX_CONNECTIONS_PER_HOST", 4)
    config = uvicorn.Config(app, http=LimitedProtocol, lifespan="off", log_config=None, ws="none")
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        eventually(lambda: server.started)
        yield listening.getsockname()
        server.should_exit = True
        thread.join(timeout=5)
    assert not LimitedProtocol.connections_of


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
def test_half_sent_request_is_closed(address: tuple[str, int], part: bytes) -> None:
    with socket.create_connection(address) as connection:
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


def test_second_request_on_a_connection_is_limited_too(address: tuple[str, int]) -> None:
    with socket.create_connection(address) as connection:
        assert get(connection).endswith(b"ok")
        time.sleep(0.3)
        assert get(connection).endswith(b"ok")
        connection.sendall(REQUEST[:20])
        assert is_closed(connection)


def test_connections_of_one_host_are_limited(address: tuple[str, int]) -> None:
    with ExitStack() as closing:
        for _ in range(4):
            closing.enter_context(socket.create_connection(address))
        eventually(lambda: LimitedProtocol.connections_of["127.0.0.1"] == 4)
        assert is_closed(closing.enter_context(socket.create_connection(address)))
    eventually(lambda: not LimitedProtocol.connections_of)
    with socket.create_connection(address) as connection:
        assert get(connection).endswith(b"ok")
