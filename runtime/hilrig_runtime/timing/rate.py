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
    """A sequence of deadlines every `period_ns`; the first one is one period after the first `wait`."""

    def __init__(self, period_ns: int, clock: Clock = SYSTEM_CLOCK) -> None:
        if period_ns <= 0:
            raise ValueError(f"the period must be > 0 ns, got {period_ns}")
        self.period_ns = period_ns
        self._clock = clock
        self._deadline_ns: int | None = None

    @property
    def next_ns(self) -> int:
        """The next deadline, ns, monotonic clock, if no whole period is missed."""
        return (self._clock.monotonic_ns() if self._deadline_ns is None else self._deadline_ns) + self.period_ns

    def wait(self) -> Tick:
        """Sleep until the next deadline whose period has not ended, and return the tick."""
        period = self.period_ns
        now = self._clock.monotonic_ns()
        deadline = now + period if self._deadline_ns is None else self._deadline_ns + period
        # A deadline at least one period old is skipped: its step is over.
        missed = max(0, (now - deadline) // period)
        deadline += missed * period
        if now < deadline:
            self._clock.sleep_until_ns(deadline)
            now = self._clock.monotonic_ns()
            # The sleep may have lasted several periods.
            overslept = max(0, (now - deadline) // period)
            missed += overslept
            deadline += overslept * period
        self._deadline_ns = deadline
        return Tick(deadline, max(0, now - deadline), missed)
