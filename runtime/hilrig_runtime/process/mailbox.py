"""Runs calls of other threads on the thread that owns a service's state: between two ticks, or on its event loop."""

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Final, TypeVar

from hilrig_runtime.bus.api import Bus, Handle
from hilrig_runtime.errors import OperationError

T = TypeVar("T")
CALL_TIMEOUT_S: Final = 1.0
"""Timeout for the owner thread to run a call, s."""


class OwnerThreadExecutor:
    """A queue of calls: other threads use `call`, `post` and `serve`, the owner thread runs them by `run_pending`.

    Args:
        schedule: makes the owner thread call a function, as `loop.call_soon_threadsafe`; None: the owner thread calls
            `run_pending` once per tick.
    """

    def __init__(self, schedule: Callable[[Callable[[], None]], object] | None = None) -> None:
        self._schedule = schedule
        self._pending: SimpleQueue[tuple[Callable[[], Any], Future[Any] | None]] = SimpleQueue()

    def call(self, work: Callable[[], T]) -> T:
        """Run `work` on the owner thread; return its result or raise its exception.

        Raises:
            OperationError: the owner thread did not run it within `CALL_TIMEOUT_S`.
        """
        done: Future[T] = Future()
        self._put(work, done)
        try:
            return done.result(CALL_TIMEOUT_S)
        except TimeoutError as error:
            # Must not run later, when no thread waits for the result.
            done.cancel()
            raise OperationError(
                f"the service did not reply within {CALL_TIMEOUT_S:g} s: it is overloaded; try again"
            ) from error

    def post(self, work: Callable[[], object]) -> None:
        """Run `work` on the owner thread, without waiting; its exception is raised there."""
        self._put(work, None)

    def serve(self, bus: Bus, key: str, handler: Callable[[bytes], bytes]) -> Handle:
        """Answer the queries on `key` with `handler`, called on the owner thread."""
        return bus.declare_queryable(key, lambda payload: self.call(partial(handler, payload)))

    def run_pending(self) -> None:
        """Run all pending calls."""
        while not self._pending.empty():
            try:
                work, done = self._pending.get_nowait()
            except Empty:
                return
            if done is None:
                work()
            elif done.set_running_or_notify_cancel():
                try:
                    done.set_result(work())
                except Exception as error:
                    done.set_exception(error)

    def _put(self, work: Callable[[], object], done: Future[Any] | None) -> None:
        self._pending.put((work, done))
        if self._schedule is not None:
            self._schedule(self.run_pending)
