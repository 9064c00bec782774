"""Rate limit of repeated events and log messages: counts the suppressed ones."""

from collections.abc import Callable, Hashable, Iterator
from typing import Generic, NamedTuple, TypeVar

KeyT = TypeVar("KeyT", bound=Hashable)
ItemT = TypeVar("ItemT")


class RateLimiter(Generic[KeyT]):
    """Allows one report per key and period, and counts the occurrences between two reports. Time is passed in.

    The first occurrence of a key is reported, later ones are counted. The count is reported with the first occurrence
    after the period, or when the period ends if `pop_remainders` is called periodically. At most `keys` keys are
    reported in a period, because a sender may invent them; the table has as many, and counts of others are forgotten.
    """

    def __init__(self, period_ns: int, keys: int = 32) -> None:
        self._period_ns = period_ns
        self._keys = keys
        self._reported: dict[KeyT, tuple[int, int]] = {}
        """By key, in the order of the reports: time of the last report, ns, and number of occurrences since then."""

    def record(self, key: KeyT, now_ns: int) -> int:
        """Record one occurrence at `now_ns`, monotonic clock.

        Returns the number of occurrences since the last report if a report is due, else 0.
        """
        if key not in self._reported and len(self._reported) >= self._keys:
            first_ns, _ = next(iter(self._reported.values()))
            if now_ns - first_ns < self._period_ns:
                return 0
        reported_ns, suppressed = self._reported.get(key, (now_ns - self._period_ns, 0))
        count = suppressed + 1
        if now_ns - reported_ns < self._period_ns:
            self._reported[key] = (reported_ns, count)
            return 0
        self._report(key, now_ns)
        return count

    def pop_remainders(self, now_ns: int) -> Iterator[tuple[KeyT, int]]:
        """Yield each key whose period has ended with suppressed occurrences, and their number: a report is due."""
        for key, (reported_ns, suppressed) in list(self._reported.items()):
            if now_ns - reported_ns < self._period_ns:
                return
            if suppressed:
                self._report(key, now_ns)
                yield key, suppressed
            else:
                del self._reported[key]

    def _report(self, key: KeyT, now_ns: int) -> None:
        # Inserted again: the oldest report is first.
        self._reported.pop(key, None)
        self._reported[key] = (now_ns, 0)
        if len(self._reported) > self._keys:
            del self._reported[next(iter(self._reported))]


class _Reported(NamedTuple, Generic[ItemT]):
    """Entry of a `RepeatReporter` for one key."""

    reported_ns: int
    suppressed: int
    """Number of occurrences since the last report."""
    newest: ItemT


class RepeatReporter(Generic[KeyT, ItemT]):
    """Reports at most once per key and period: the newest occurrence and the number of them since the last report.

    Every occurrence is in exactly one report: those that were suppressed are reported when their period ends (`check`)
    or their cause does (`flush`), never with a later occurrence. Beyond `keys` keys in a period, which a sender may
    invent, the further ones are reported together, as the newest of them. Time is passed in.
    """

    def __init__(self, period_ns: int, report: Callable[[ItemT, int], None], keys: int = 32) -> None:
        self._period_ns = period_ns
        self._report = report
        self._keys = keys
        self._reported: dict[KeyT | None, _Reported[ItemT]] = {}
        """In the order of the reports; None: the keys beyond the capacity."""
        self._suppressed = 0

    def record(self, key: KeyT, item: ItemT, now_ns: int) -> None:
        """Record one occurrence at `now_ns`, monotonic clock, and report it if no report was made within the period."""
        self.check(now_ns)
        place = None if key not in self._reported and self._is_full(now_ns) else key
        before = self._reported.get(place)
        if before is not None and now_ns - before.reported_ns < self._period_ns:
            self._reported[place] = _Reported(before.reported_ns, before.suppressed + 1, item)
            self._suppressed += 1
            return
        self._remember(place, item, now_ns)
        self._report(item, 1)

    def check(self, now_ns: int) -> None:
        """Report the suppressed occurrences of each key whose period has ended."""
        while self._suppressed:
            key = next(iter(self._reported))
            reported_ns, count, newest = self._reported[key]
            if now_ns - reported_ns < self._period_ns:
                return
            del self._reported[key]
            if count:
                self._suppressed -= count
                self._remember(key, newest, now_ns)
                self._report(newest, count)

    def flush(self) -> None:
        """Report all suppressed occurrences; the next one is the first of its key."""
        reported, self._reported, self._suppressed = self._reported, {}, 0
        for _, count, newest in reported.values():
            if count:
                self._report(newest, count)

    def _is_full(self, now_ns: int) -> bool:
        """Return whether all keys of the table were reported within the period."""
        return len(self._reported) >= self._keys and (
            now_ns - next(iter(self._reported.values())).reported_ns < self._period_ns
        )

    def _remember(self, key: KeyT | None, item: ItemT, now_ns: int) -> None:
        # Inserted again: the oldest report is first.
        self._reported.pop(key, None)
        self._reported[key] = _Reported(now_ns, 0, item)
        if len(self._reported) > self._keys + 1:
            # Its period has ended without a suppressed occurrence.
            del self._reported[next(iter(self._reported))]


def repeat_suffix(count: int) -> str:
    """Return " (N times)" for the end of a message; empty for one occurrence."""
    return f" ({count} times)" if count > 1 else ""
