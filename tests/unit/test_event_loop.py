"""The edge's event loop: asyncio keeps working however busy the sockets are; timers are exact; errors stay local."""

import asyncio
import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from selectors import EVENT_READ
from statistics import median

import pytest

from hilrig_modbus_edge.server.event_loop import (
    HIGH_WATER,
    DirectEventLoop,
    SocketTransport,
    set_receive_timestamps,
)


@pytest.mark.skipif(sys.platform != "linux", reason="the loop of asyncio rounds the time-outs of epoll, on Linux")
def test_timer_is_not_rounded_to_milliseconds() -> None:
    delay_s = 0.000_25

    async def lateness_s() -> list[float]:
        late_s = []
        loop = asyncio.get_running_loop()
        for _ in range(100):
            called: asyncio.Future[float] = loop.create_future()
            due_s = loop.time() + delay_s
            loop.call_at(due_s, lambda called=called: called.set_result(loop.time()))  # type: ignore[misc]
            late_s.append(await called - due_s)
        return late_s

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        exact_s = runner.run(lateness_s())
    with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
        rounded_s = runner.run(lateness_s())
    # asyncio calls a timer that is due within the resolution of its clock.
    assert min(exact_s) > -1e-6
    # A rounded one is late by the rest of a millisecond.
    assert median(exact_s) < median(rounded_s) - 0.0002


def test_timers_are_called_in_order() -> None:
    async def body() -> list[float]:
        loop = asyncio.get_running_loop()
        begin_s, called, done = loop.time(), list[float](), asyncio.Event()
        for delay_s in (0.0041, 0.0012, 0.0003, 0.0012, 0.0007):
            loop.call_at(begin_s + delay_s, called.append, delay_s)
        loop.call_at(begin_s + 0.005, done.set)
        await done.wait()
        return called

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        assert runner.run(body()) == [0.0003, 0.0007, 0.0012, 0.0012, 0.0041]


def test_loop_without_timers_waits_for_other_threads() -> None:
    loop = DirectEventLoop()
    try:
        threading.Timer(0.01, loop.call_soon_threadsafe, (loop.stop,)).start()
        loop.run_forever()
    finally:
        loop.close()


class Flood:
    """A socket in the selector that is always ready; counts its events."""

    def __init__(self, loop: DirectEventLoop) -> None:
        self.served = 0
        self.here, self.there = socket.socketpair()
        self.there.send(b"x")
        loop.direct.register(self.here, EVENT_READ, self.serve)

    def serve(self, events: int) -> None:
        assert events == EVENT_READ
        self.here.recv(1)
        self.there.send(b"x")
        self.served += 1
        self.on_event()

    def on_event(self) -> None:
        """Called at each event; replaced by tests."""


@contextmanager
def flooded() -> Iterator[tuple[DirectEventLoop, Flood]]:
    loop = DirectEventLoop()
    flood = Flood(loop)
    try:
        with flood.here, flood.there:
            yield loop, flood
            loop.direct.unregister(flood.here)
    finally:
        loop.close()


def test_timer_is_called_during_a_flood() -> None:
    with flooded() as (loop, flood):
        loop.call_later(0.01, loop.stop)
        loop.run_forever()
        assert flood.served > 1


def test_call_soon_runs_before_the_next_event() -> None:
    with flooded() as (loop, flood):
        done: list[int] = []

        def on_event() -> None:
            loop.call_soon(done.append, flood.served)
            if flood.served == 10:
                loop.call_soon(loop.stop)

        flood.on_event = on_event  # type: ignore[method-assign]
        loop.run_forever()
        assert done == list(range(1, 11))


def test_earlier_timer_of_an_event_is_not_delayed() -> None:
    with flooded() as (loop, flood):

        def on_event() -> None:
            if flood.served == 1:
                loop.call_later(0.001, loop.stop)

        flood.on_event = on_event  # type: ignore[method-assign]
        loop.call_later(3_600, pytest.fail, "the older timer was called first")
        loop.run_forever()


def test_other_threads_are_served_during_a_flood() -> None:
    with flooded() as (loop, _):
        threading.Timer(0.01, loop.call_soon_threadsafe, (loop.stop,)).start()
        loop.run_forever()


def test_asyncio_sockets_are_served_during_a_flood() -> None:
    async def receive() -> bytes:
        here, there = socket.socketpair()
        with here, there:
            here.setblocking(False)
            threading.Timer(0.01, there.send, (b"hello",)).start()
            return await asyncio.get_running_loop().sock_recv(here, 16)

    with flooded() as (loop, flood):
        assert loop.run_until_complete(receive()) == b"hello"
        assert flood.served > 1


class Protocol(asyncio.Protocol):
    """Keeps received bytes; raises at the byte `!`."""

    def __init__(self) -> None:
        self.received = b""
        self.paused = False
        self.lost: asyncio.Future[Exception | None] = asyncio.get_running_loop().create_future()

    def data_received(self, data: bytes) -> None:
        self.received += data
        if b"!" in self.received:
            raise ValueError("a fault in the protocol")

    def pause_writing(self) -> None:
        self.paused = True

    def resume_writing(self) -> None:
        self.paused = False

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost.set_result(exc)


async def connect() -> tuple[SocketTransport, Protocol, socket.socket]:
    here, there = socket.socketpair()
    there.setblocking(False)
    loop = asyncio.get_running_loop()
    assert isinstance(loop, DirectEventLoop)
    transport, protocol = SocketTransport(loop, here, "peer"), Protocol()
    transport.set_protocol(protocol)
    return transport, protocol, there


async def until(is_true: object) -> None:
    async with asyncio.timeout(10):
        while not is_true():  # type: ignore[operator]
            await asyncio.sleep(0.001)  # polls


def test_internal_error_closes_one_connection_only(caplog: pytest.LogCaptureFixture) -> None:
    async def body() -> None:
        loop = asyncio.get_running_loop()
        (_, broken, one), (_, whole, other) = await connect(), await connect()
        with one, other, caplog.at_level(logging.ERROR):
            await loop.sock_sendall(one, b"!")
            assert isinstance(await broken.lost, ValueError)
            await loop.sock_sendall(other, b"hello")
            await until(lambda: whole.received == b"hello")

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        runner.run(body())
    assert "connection peer closed: internal error" in caplog.text


def test_slow_peer_pauses_the_protocol_and_receives_everything() -> None:
    async def body() -> None:
        loop = asyncio.get_running_loop()
        transport, protocol, peer = await connect()
        sent = bytes(range(256)) * 4096
        with peer:
            for start in range(0, len(sent), 4096):
                transport.write(sent[start : start + 4096])
            assert protocol.paused
            transport.close()
            received = b""
            while len(received) < len(sent):
                received += await loop.sock_recv(peer, HIGH_WATER)
            assert received == sent
            assert not protocol.paused
            assert await protocol.lost is None
            assert await loop.sock_recv(peer, 1) == b""

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        runner.run(body())


def test_paused_reading_leaves_bytes_in_the_socket() -> None:
    async def body() -> None:
        loop = asyncio.get_running_loop()
        transport, protocol, peer = await connect()
        with peer:
            transport.pause_reading()
            await loop.sock_sendall(peer, b"later")
            await asyncio.sleep(0.01)  # the loop would read the socket in this time
            assert protocol.received == b""
            transport.resume_reading()
            await until(lambda: protocol.received == b"later")
            transport.abort()
            await protocol.lost

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        runner.run(body())


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel stamps received data on Linux")
def test_kernel_timestamp_precedes_a_stall_of_the_loop() -> None:
    async def body() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, DirectEventLoop)
        with socket.create_server(("127.0.0.1", 0)) as listening:
            set_receive_timestamps(listening)
            with socket.create_connection(listening.getsockname()) as peer:
                transport, protocol = SocketTransport(loop, listening.accept()[0], "peer"), Protocol()
                transport.set_protocol(protocol)
                assert transport.received_ns(0, time.monotonic_ns()) == 0
                sent_ns = time.monotonic_ns()
                peer.sendall(b"hello")
                time.sleep(0.05)  # the stall of the event loop
                ended_ns = time.monotonic_ns()
                await until(lambda: protocol.received == b"hello")
                now_ns = time.monotonic_ns()
                stamp_ns = transport.received_ns(sent_ns, now_ns)
                assert sent_ns <= stamp_ns < ended_ns
                # What lies outside the bounds was stamped on another wall clock.
                assert transport.received_ns(stamp_ns + 1_000_000, now_ns) == 0
                assert transport.received_ns(sent_ns, stamp_ns - 1_000_000) == 0
                transport.abort()
                await protocol.lost

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        runner.run(body())


def test_socket_without_timestamps_has_none() -> None:
    async def body() -> None:
        transport, protocol, peer = await connect()
        with peer:
            await asyncio.get_running_loop().sock_sendall(peer, b"hello")
            await until(lambda: protocol.received == b"hello")
            assert transport.received_ns(0, time.monotonic_ns()) == 0
            transport.abort()
            await protocol.lost

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        runner.run(body())
