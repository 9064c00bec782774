"""Calls on the owner thread: result, exception, timeout, and the asyncio adapter."""

import asyncio
import threading

import pytest

from hilrig_runtime.bus.memory_bus import MemoryBus
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from support.waiting import eventually


def test_timed_out_call_fails_and_is_not_executed_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hilrig_runtime.process.mailbox.CALL_TIMEOUT_S", 0.01)
    executor, done = OwnerThreadExecutor(), []
    with pytest.raises(OperationError, match=r"the service did not reply within 0.01 s: it is overloaded; try again"):
        executor.call(lambda: done.append(1))
    executor.run_pending()
    assert done == []


def test_posted_work_raises_on_the_owner_thread() -> None:
    executor = OwnerThreadExecutor()
    executor.post(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        executor.run_pending()


def test_calls_run_in_order_on_the_thread_that_runs_them() -> None:
    executor, threads, results = OwnerThreadExecutor(), [], []

    def ask() -> None:
        executor.post(lambda: threads.append(threading.current_thread()))
        results.append(executor.call(threading.current_thread))

    asking = threading.Thread(target=ask)
    asking.start()

    def has_run() -> bool:
        executor.run_pending()
        return bool(results)

    eventually(has_run)
    asking.join()
    assert threads == results == [threading.main_thread()]


def test_queries_are_answered_on_the_event_loop() -> None:
    async def serve() -> tuple[list[bytes], list[str], bool]:
        loop, bus, main = asyncio.get_running_loop(), MemoryBus(), threading.current_thread()
        executor = OwnerThreadExecutor(loop.call_soon_threadsafe)

        def handler(payload: bytes) -> bytes:
            if not payload:
                raise OperationError("empty")
            return payload if threading.current_thread() is main else b"wrong thread"

        with executor.serve(bus, "key", handler):
            replies = [*await asyncio.to_thread(bus.query, "key", b"x"), *await asyncio.to_thread(bus.query, "key")]
        return [reply.payload for reply in replies], [reply.error for reply in replies], bus.query("key") == []

    assert asyncio.run(serve()) == ([b"x", b""], ["", "empty"], True)
