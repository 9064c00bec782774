"""Runs calls of other threads on the thread that owns a service's state, between two ticks."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import Any, Final, TypeVar

from hilrig_runtime.errors import OperationError

T = TypeVar("T")
CALL_TIMEOUT_S: Final = 1.0


class OwnerThreadExecutor:
    """A queue of calls: other threads use `call`, the owner thread uses `run_pending`."""

    def __init__(self) -> None:
        self.exclusive = threading.Lock()
        """Serializes other threads whose changes take more than one call."""
        self._pending: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()

    def call(self, work: Callable[[], T]) -> T:
        """Run `work` on the owner thread; return its result or raise its exception.

        Raises:
            OperationError: the owner thread did not run it within `CALL_TIMEOUT_S`.
        """
        done: Future[T] = Future()
        self._pending.put((work, done))
        try:
            return done.result(CALL_TIMEOUT_S)
        except TimeoutError as error:
            # Must not run later, when no thread waits for the result.
            done.cancel()
            raise OperationError("the service is too busy to answer") from error

    def run_pending(self) -> None:
        """Run all pending calls."""
        while not self._pending.empty():
            try:
                work, done = self._pending.get_nowait()
            except Empty:
                return
            if not done.set_running_or_notify_cancel():
                continue
            try:
                done.set_result(work())
            except Exception as error:
                done.set_exception(error)
