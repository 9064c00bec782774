"""The two clocks of a process: the monotonic clock for measurements, and the wall clock for dates.

No measurement subtracts timestamps of two clocks (docs/timing.md). Code that reads the time gets a `Clock`, so that
tests can control it.
"""

import time
from typing import Final, Protocol


class Clock(Protocol):
    """A source of time in integer nanoseconds."""

    def monotonic_ns(self) -> int:
        """Return the time of the monotonic clock, ns; it never steps, and its zero is only valid on this host."""
        ...

    def wall_ns(self) -> int:
        """Return the time since 1970-01-01 UTC, ns; it may step."""
        ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until `deadline_ns` of the monotonic clock; return at once if it has passed."""
        ...


class SystemClock:
    """The clocks of the operating system."""

    # Bound to the C functions: a timestamp costs one call.
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
    """A clock that is advanced by the caller, for tests and for simulated time."""

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
        """Advance both clocks by `duration_ns`."""
        self._monotonic_ns += duration_ns
        self._wall_ns += duration_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Advance to the deadline."""
        self.advance(max(0, deadline_ns - self._monotonic_ns))
