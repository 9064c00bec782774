"""Work that other threads hand to a service's own, which does it between two ticks."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import Any, Final, TypeVar

from hilrig_runtime.errors import OperationError

T = TypeVar("T")
TIMEOUT_S: Final = 1.0


class OwnerThreadExecutor:
    """`call` is for other threads, `run_pending` for the service's own."""

    def __init__(self) -> None:
        self.exclusive = threading.Lock()
        """For whoever prepares on another thread what only one may change at a time."""
        self._waiting: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()

    def call(self, work: Callable[[], T]) -> T:
        """Have `work` done by the service's thread; what it gives or raises.

        Raises:
            OperationError: the service did not come to it in time.
        """
        done: Future[T] = Future()
        self._waiting.put((work, done))
        try:
            return done.result(TIMEOUT_S)
        except TimeoutError as error:
            # Not done later, when nobody waits for it any more.
            done.cancel()
            raise OperationError("the service is too busy to answer") from error

    def run_pending(self) -> None:
        """Do what waits."""
        while not self._waiting.empty():
            try:
                work, done = self._waiting.get_nowait()
            except Empty:
                return
            if not done.set_running_or_notify_cancel():
                continue
            try:
                done.set_result(work())
            except Exception as error:
                done.set_exception(error)
