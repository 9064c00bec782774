"""A loop at a fixed rate: absolute deadlines, lateness as data, no burst after a stall.

The deadlines lie on one grid, t_0 + k·T, so that lateness never adds up to drift. A tick that comes late keeps its
deadline; when whole periods have passed, their deadlines are given up and counted rather than caught up with.
"""

from dataclasses import dataclass

from hilrig_runtime.timing.clock import SYSTEM_CLOCK, Clock


@dataclass(frozen=True, slots=True)
class Tick:
    """One turn of the loop."""

    deadline_ns: int
    """When it was due, ns, monotonic clock."""
    lateness_ns: int
    """How much later it began, ns, never negative."""
    missed_steps: int
    """Deadlines given up since the tick before."""


class Rate:
    """Deadlines every `period_ns`; the first one is one period after the first `wait`."""

    def __init__(self, period_ns: int, clock: Clock = SYSTEM_CLOCK) -> None:
        if period_ns <= 0:
            raise ValueError(f"a period must be positive, found {period_ns} ns")
        self.period_ns = period_ns
        self._clock = clock
        self._deadline_ns: int | None = None

    @property
    def next_ns(self) -> int:
        """The next deadline, as long as no period passes wholly, ns, monotonic clock."""
        return (self._clock.monotonic_ns() if self._deadline_ns is None else self._deadline_ns) + self.period_ns

    def wait(self) -> Tick:
        """Sleep until the next deadline that has not wholly passed, and say how that went."""
        period = self.period_ns
        now = self._clock.monotonic_ns()
        deadline = now + period if self._deadline_ns is None else self._deadline_ns + period
        # A deadline at least one period old is given up: its step's time is over.
        missed = max(0, (now - deadline) // period)
        deadline += missed * period
        if now < deadline:
            self._clock.sleep_until_ns(deadline)
            now = self._clock.monotonic_ns()
            # The machine may have slept through whole periods here too.
            overslept = max(0, (now - deadline) // period)
            missed += overslept
            deadline += overslept * period
        self._deadline_ns = deadline
        return Tick(deadline, max(0, now - deadline), missed)
