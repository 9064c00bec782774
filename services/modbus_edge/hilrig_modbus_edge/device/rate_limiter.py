"""Rate limit of repeated events and log messages: counts the suppressed ones."""

from collections.abc import Hashable


class RateLimiter:
    """Allows one report per key and period, and counts the occurrences between two reports. Time is passed in."""

    def __init__(self, period_ns: int, keys: int = 256) -> None:
        self._period_ns = period_ns
        self._keys = keys
        self._reported: dict[Hashable, tuple[int, int]] = {}
        """By key: time of the last report, ns, and the number of occurrences since then."""

    def record(self, key: Hashable, now_ns: int) -> int:
        """Record one occurrence at `now_ns`, monotonic clock.

        Returns the number of occurrences since the last report if a report is due, else 0.
        """
        reported_ns, suppressed = self._reported.get(key, (now_ns - self._period_ns, 0))
        count = suppressed + 1
        if now_ns - reported_ns < self._period_ns:
            self._reported[key] = (reported_ns, count)
            return 0
        if len(self._reported) >= self._keys:
            self._reported.clear()
        self._reported[key] = (now_ns, 0)
        return count
