"""The loop whose selector serves sockets itself: asyncio's own has its turn all the same, however busy they are."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from selectors import EVENT_READ

import pytest

from hilrig_modbus_edge.server.event_loop import DirectLoop


class Flood:
    """A socket that is ready to be read always; it counts how often it was."""

    def __init__(self, loop: DirectLoop) -> None:
        self.served = 0
        self.here, self.there = socket.socketpair()
        self.there.send(b"x")
        loop.direct.register(self.here, EVENT_READ, self.serve)

    def serve(self, events: int) -> None:
        assert events == EVENT_READ
        self.here.recv(1)
        self.there.send(b"x")
        self.served += 1
        self.asked()

    def asked(self) -> None:
        """What is asked of asyncio with each event; nothing."""


@contextmanager
def flooded() -> Iterator[tuple[DirectLoop, Flood]]:
    loop = DirectLoop()
    flood = Flood(loop)
    try:
        with flood.here, flood.there:
            yield loop, flood
            loop.direct.unregister(flood.here)
    finally:
        loop.close()


def test_a_timer_comes_in_its_time() -> None:
    with flooded() as (loop, flood):
        loop.call_later(0.01, loop.stop)
        loop.run_forever()
        assert flood.served > 1


def test_what_an_event_asks_of_asyncio_comes_before_the_next_event() -> None:
    with flooded() as (loop, flood):
        done: list[int] = []

        def asked() -> None:
            loop.call_soon(done.append, flood.served)
            if flood.served == 10:
                loop.call_soon(loop.stop)

        flood.asked = asked  # type: ignore[method-assign]
        loop.run_forever()
        assert done == list(range(1, 11))


def test_a_timer_that_an_event_sets_does_not_wait_for_an_older_one() -> None:
    with flooded() as (loop, flood):

        def asked() -> None:
            if flood.served == 1:
                loop.call_later(0.001, loop.stop)

        flood.asked = asked  # type: ignore[method-assign]
        loop.call_later(3_600, pytest.fail, "the old one came first")
        loop.run_forever()


def test_another_thread_is_heard() -> None:
    with flooded() as (loop, _):
        threading.Timer(0.01, loop.call_soon_threadsafe, (loop.stop,)).start()
        loop.run_forever()


def test_asyncios_own_sockets_have_their_turn() -> None:
    async def say() -> bytes:
        here, there = socket.socketpair()
        with here, there:
            here.setblocking(False)
            threading.Timer(0.01, there.send, (b"hello",)).start()
            return await asyncio.get_running_loop().sock_recv(here, 16)

    with flooded() as (loop, flood):
        assert loop.run_until_complete(say()) == b"hello"
        assert flood.served > 1


def test_a_loop_without_a_timer_waits_for_what_comes() -> None:
    loop = DirectLoop()
    try:
        here, there = socket.socketpair()
        with here, there:
            loop.direct.register(here, EVENT_READ, lambda _: loop.call_soon(loop.stop))
            threading.Timer(0.01, there.send, (b"x",)).start()
            loop.run_forever()
            loop.direct.unregister(here)
    finally:
        loop.close()


def test_a_timer_is_not_rounded_to_milliseconds() -> None:
    delay_s, late_s = 0.000_25, list[float]()

    async def body() -> None:
        loop = asyncio.get_running_loop()
        for _ in range(100):
            called: asyncio.Future[float] = loop.create_future()
            due_s = loop.time() + delay_s
            loop.call_at(due_s, lambda called=called: called.set_result(loop.time()))  # type: ignore[misc]
            late_s.append(await called - due_s)

    with asyncio.Runner(loop_factory=DirectLoop) as runner:
        runner.run(body())
    # asyncio takes a timer for due that is so within what its clock resolves.
    assert min(late_s) > -1e-6
    # Of a hundred at least one is not held up by others on the machine.
    assert min(late_s) < 0.001 - delay_s


def test_timers_come_in_their_order() -> None:
    async def body() -> list[float]:
        loop = asyncio.get_running_loop()
        begin_s, came, done = loop.time(), list[float](), asyncio.Event()
        for delay_s in (0.0041, 0.0012, 0.0003, 0.0012, 0.0007):
            loop.call_at(begin_s + delay_s, came.append, delay_s)
        loop.call_at(begin_s + 0.005, done.set)
        await done.wait()
        return came

    with asyncio.Runner(loop_factory=DirectLoop) as runner:
        assert runner.run(body()) == [0.0003, 0.0007, 0.0012, 0.0012, 0.0041]
