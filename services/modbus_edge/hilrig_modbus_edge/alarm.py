"""Calls on an asyncio loop at a moment: asyncio's own timers wait for whole milliseconds, this thread does not.

It sleeps until the next moment and then wakes the loop. A loop that sets no alarm has no such thread.
"""

import asyncio
import heapq
import itertools
import threading
from collections.abc import Callable

from hilrig_runtime.clock import Clock


class Alarm:
    """Close it before the loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop, clock: Clock) -> None:
        self._loop = loop
        self._monotonic_ns = clock.monotonic_ns
        self._changed = threading.Condition()
        self._due: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._closing = False
        self._thread: threading.Thread | None = None

    def call_at(self, deadline_ns: int, callback: Callable[[], None]) -> None:
        """Have the loop call `callback` at `deadline_ns` of the monotonic clock."""
        with self._changed:
            entry = (deadline_ns, next(self._numbers), callback)
            heapq.heappush(self._due, entry)
            if self._due[0] is entry:
                self._changed.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="alarm", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """End; what was to be called is not."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        with self._changed:
            while not self._closing:
                if not self._due:
                    self._changed.wait()
                    continue
                remaining_ns = self._due[0][0] - self._monotonic_ns()
                if remaining_ns > 0:
                    self._changed.wait(remaining_ns * 1e-9)
                    continue
                _, _, callback = heapq.heappop(self._due)
                self._loop.call_soon_threadsafe(callback)
