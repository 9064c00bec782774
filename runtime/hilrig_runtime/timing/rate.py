"""A fixed-rate loop: absolute deadlines, measured lateness, no burst after a stall.

The deadlines are on one grid, t_0 + k·T, so that lateness does not accumulate to a drift. A late tick keeps its
deadline; deadlines of whole periods that have passed are skipped and counted, not caught up.
"""

from dataclasses import dataclass

from hilrig_runtime.timing.clock import SYSTEM_CLOCK, Clock


@dataclass(frozen=True, slots=True)
class Tick:
    """One tick of the loop."""

    deadline_ns: int
    """Deadline, ns, monotonic clock."""
    lateness_ns: int
    """Start of the tick after the deadline, ns, never negative."""
    missed_steps: int
    """Deadlines skipped since the previous tick."""


class Rate:
    """A sequence of deadlines every `period_ns`; the first one is one period after the construction.

    A thread sleeps in `wait`; a loop that waits otherwise waits for `remaining_s` and calls `tick` or `restart`.
    """

    def __init__(self, period_ns: int, clock: Clock = SYSTEM_CLOCK) -> None:
        if period_ns <= 0:
            raise ValueError(f"the period must be > 0 ns, got {period_ns}")
        self.period_ns = period_ns
        self._clock = clock
        self.next_ns = 0
        """The next deadline, ns, monotonic clock, if no whole period is missed; setting it shifts the grid."""
        self.restart()

    @property
    def remaining_s(self) -> float:
        """Time until the next deadline, s, never negative."""
        return max(0.0, (self.next_ns - self._clock.monotonic_ns()) * 1e-9)

    def restart(self) -> None:
        """Set the next deadline to one period from now."""
        self.next_ns = self._clock.monotonic_ns() + self.period_ns

    def wait(self) -> Tick:
        """Sleep until the next deadline whose period has not ended, and return the tick."""
        self._clock.sleep_until_ns(self.next_ns)
        return self.tick(self._clock.monotonic_ns())

    def tick(self, now_ns: int) -> Tick:
        """Return the tick that starts at `now_ns`, and advance to the next deadline."""
        # A deadline at least one period old is skipped: its step is over.
        missed = max(0, (now_ns - self.next_ns) // self.period_ns)
        deadline_ns = self.next_ns + missed * self.period_ns
        self.next_ns = deadline_ns + self.period_ns
        return Tick(deadline_ns, max(0, now_ns - deadline_ns), missed)
