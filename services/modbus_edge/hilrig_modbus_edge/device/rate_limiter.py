"""Tell of what happens again and again once in a while, with a count: a log that floods is not read."""

from collections.abc import Hashable


class Throttle:
    """At most one telling a key and period; the rest is counted. Pure: time is passed in."""

    def __init__(self, period_ns: int, keys: int = 256) -> None:
        self._period_ns = period_ns
        self._keys = keys
        self._told: dict[Hashable, tuple[int, int]] = {}

    def count(self, key: Hashable, now_ns: int) -> int:
        """Count one; how many there were since the last telling if it is time to tell, else 0; ns, monotonic clock."""
        told_ns, untold = self._told.get(key, (now_ns - self._period_ns, 0))
        untold += 1
        if now_ns - told_ns < self._period_ns:
            self._told[key] = (told_ns, untold)
            return 0
        if len(self._told) >= self._keys:
            self._told.clear()
        self._told[key] = (now_ns, 0)
        return untold
