"""Punctual calls on an asyncio loop: in order, at their moment and not before, and none after the end."""

import asyncio
import threading

from hilrig_modbus_edge.alarm import Alarm
from hilrig_runtime.clock import SYSTEM_CLOCK

MS = 1_000_000


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "alarm"]


def test_calls_come_in_order_and_not_before_their_moment() -> None:
    async def body() -> list[tuple[int, int]]:
        alarm = Alarm(asyncio.get_running_loop(), SYSTEM_CLOCK)
        called: list[tuple[int, int]] = []
        done = asyncio.Event()
        start_ns = SYSTEM_CLOCK.monotonic_ns()

        def call(offset_ms: int) -> None:
            called.append((offset_ms, SYSTEM_CLOCK.monotonic_ns() - start_ns))
            if len(called) == 5:
                done.set()

        for offset_ms in (40, 10, 30, 10, 20):
            alarm.call_at(start_ns + offset_ms * MS, lambda offset_ms=offset_ms: call(offset_ms))  # type: ignore[misc]
        await asyncio.wait_for(done.wait(), 10)
        alarm.close()
        return called

    called = asyncio.run(body())
    assert [offset_ms for offset_ms, _ in called] == [10, 10, 20, 30, 40]
    assert all(after_ns >= offset_ms * MS for offset_ms, after_ns in called)


def test_it_is_called_on_the_loop() -> None:
    async def body() -> str:
        alarm = Alarm(asyncio.get_running_loop(), SYSTEM_CLOCK)
        called: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        alarm.call_at(0, lambda: called.set_result(threading.current_thread().name))
        name = await asyncio.wait_for(called, 10)
        alarm.close()
        return name

    assert asyncio.run(body()) == threading.current_thread().name


def test_a_loop_without_alarms_has_no_thread_and_a_closed_one_none_any_more() -> None:
    async def body() -> tuple[list[str], list[str]]:
        alarm = Alarm(asyncio.get_running_loop(), SYSTEM_CLOCK)
        before = threads()
        alarm.call_at(SYSTEM_CLOCK.monotonic_ns() + 3_600_000 * MS, lambda: None)
        during = threads()
        alarm.close()
        return before, during

    assert asyncio.run(body()) == ([], ["alarm"])
    assert threads() == []
