"""Waits for conditions with a timeout, and measures scheduling stalls of the machine."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, TypeVar

T = TypeVar("T")

LONG_TIMEOUT_S = 60.0
"""Timeout where the duration is not under test: other tests may load the machine."""


def eventually(
    condition: Callable[[], T | Literal[False] | None], *, timeout_s: float = LONG_TIMEOUT_S, every_s: float = 0.01
) -> T:
    """Call `condition` until it returns a true value, and return that; fail after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > deadline:
            raise AssertionError(f"condition not met within {timeout_s} s (last value: {value!r})")
        time.sleep(every_s)  # polls


def cpu_wait_s(pid: int) -> float:
    """Time that the threads of a process waited for a processor, s; 0: unknown on this system."""
    waited_ns = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        # A thread may end meanwhile.
        with suppress(OSError):
            waited_ns += int(path.read_text().split()[1])
    return waited_ns / 1e9


class StallMonitor:
    """Context manager that measures the longest scheduling delay of a thread of this process."""

    PERIOD_S = 0.005

    def __init__(self) -> None:
        self.worst_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def reset(self) -> None:
        """Measure from now on."""
        self.worst_s = 0.0

    def _watch(self) -> None:
        before_s = time.monotonic()
        while not self._ended.wait(self.PERIOD_S):
            now_s = time.monotonic()
            self.worst_s = max(self.worst_s, now_s - before_s - self.PERIOD_S)
            before_s = now_s

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
