"""Stalls of the edge: ticks more than a period late, because the host was overloaded or the process was stopped."""

from collections.abc import Callable
from typing import Final

from hilrig_runtime.timing.rate import Tick
from hilrig_runtime.timing.rate_limiter import RateLimiter

STALL_EVENT_PERIOD_NS: Final = 1_000_000_000
"""Shortest time between two reports of stalls, ns."""


class StallReporter:
    """Reports late ticks of the edge, rate-limited. Time is passed in.

    Args:
        period_ns: period of the tick, ns.
        report: gets the number of stalls since the last report, and the longest of them, ns.
    """

    def __init__(self, period_ns: int, report: Callable[[int, int], None]) -> None:
        self._period_ns = period_ns
        self._report = report
        self._rate_limiter: RateLimiter[None] = RateLimiter(STALL_EVENT_PERIOD_NS)
        self._longest_ns = 0
        """Longest stall that was not reported yet, ns; 0: all were."""

    def on_tick(self, tick: Tick, now_ns: int) -> None:
        """Record a tick that starts at `now_ns`, monotonic clock, and report stalls if that is due."""
        # Lateness against the original deadline: `lateness_ns` is against the one after the skipped periods.
        late_ns = tick.lateness_ns + tick.missed_steps * self._period_ns
        count = 0
        if late_ns > self._period_ns:
            self._longest_ns = max(self._longest_ns, late_ns)
            count = self._rate_limiter.record(None, now_ns)
        elif self._longest_ns:
            count = sum(remainder for _, remainder in self._rate_limiter.pop_remainders(now_ns))
        if count:
            self._report(count, self._longest_ns)
            self._longest_ns = 0
