"""The two clocks of a process: a monotonic one to measure with, and the wall clock to tell people when.

No figure of this project subtracts stamps of two clocks (docs/timing.md). Whatever reads time takes a `Clock`, so
that a test can own it.
"""

import time
from typing import Final, Protocol


class Clock(Protocol):
    """A source of time in integer nanoseconds."""

    def monotonic_ns(self) -> int:
        """Time that never steps, ns; its zero means nothing outside this process's host."""
        ...

    def wall_ns(self) -> int:
        """Time since 1970-01-01 UTC, ns; it may step."""
        ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at `deadline_ns` of the monotonic clock, or at once when it has passed."""
        ...


class SystemClock:
    """The machine's clocks."""

    # Bound to the C functions: a stamp costs one call.
    monotonic_ns = staticmethod(time.monotonic_ns)
    wall_ns = staticmethod(time.time_ns)

    @staticmethod
    def sleep_until_ns(deadline_ns: int) -> None:
        """See `Clock.sleep_until_ns`."""
        remaining = deadline_ns - time.monotonic_ns()
        if remaining > 0:
            time.sleep(remaining * 1e-9)


SYSTEM_CLOCK: Final[Clock] = SystemClock()


class ManualClock:
    """A clock that moves when it is told to: for tests and for simulation in virtual time."""

    def __init__(self, monotonic_ns: int = 1_000_000_000, wall_ns: int = 1_700_000_000_000_000_000) -> None:
        self._monotonic_ns = monotonic_ns
        self._wall_ns = wall_ns

    def monotonic_ns(self) -> int:
        """See `Clock.monotonic_ns`."""
        return self._monotonic_ns

    def wall_ns(self) -> int:
        """See `Clock.wall_ns`."""
        return self._wall_ns

    def advance(self, duration_ns: int) -> None:
        """Let `duration_ns` pass on both clocks."""
        self._monotonic_ns += duration_ns
        self._wall_ns += duration_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Move on to the deadline."""
        self.advance(max(0, deadline_ns - self._monotonic_ns))
