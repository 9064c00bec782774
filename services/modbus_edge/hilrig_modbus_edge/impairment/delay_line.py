"""Messages on an impaired way: each has its time of arrival, and the newest wins, as among datagrams.

A message that takes longer than a newer one is overtaken by it and dropped: control has no use for it. So those that
wait are in the order of their arrival too, and each costs the same however many wait. Pure: time is passed in.
"""

from collections import deque
from collections.abc import Iterator
from typing import Generic, NamedTuple, TypeVar

from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload

T = TypeVar("T")
Fates = Iterator[tuple[int, bool]]
"""Of the messages to come: delay, ns, and whether it is lost (`Impairment.each`)."""


class Arrived(NamedTuple, Generic[T]):
    """A message at the end of its way."""

    item: T
    injected_ns: int
    """How long it was held up on purpose."""


class Line(Generic[T]):
    """One way. Times are ns of the monotonic clock."""

    def __init__(self, fates: Fates) -> None:
        self._waiting: deque[tuple[int, int, T]] = deque()
        self.follow(fates)

    def follow(self, fates: Fates) -> None:
        """Have other fates from now on, and count anew; what is on its way stays so."""
        self._fates = fates
        self.count = 0
        """Messages that set out."""
        self.lost = 0
        """Of them, lost on purpose."""
        self.overtaken = 0
        """Overtaken: by a newer one, or by what made all of them void."""

    @property
    def next_ns(self) -> int | None:
        """When the next one arrives; None: none is on its way."""
        return self._waiting[0][0] if self._waiting else None

    def put(self, item: T, now_ns: int) -> bool:
        """Let a message set out; False: it is lost."""
        delay_ns, lost = next(self._fates)
        self.count += 1
        if lost:
            self.lost += 1
            return False
        release_ns = now_ns + delay_ns
        waiting = self._waiting
        while waiting and waiting[-1][0] > release_ns:
            waiting.pop()
            self.overtaken += 1
        waiting.append((release_ns, delay_ns, item))
        return True

    def take(self, now_ns: int) -> Arrived[T] | None:
        """The next one that has arrived; None: there is none."""
        if not self._waiting or self._waiting[0][0] > now_ns:
            return None
        _, delay_ns, item = self._waiting.popleft()
        return Arrived(item, delay_ns)

    def take_newest(self, now_ns: int) -> Arrived[T] | None:
        """The newest one that is on its way, which arrives now: the way is free again; None: there is none."""
        if not self._waiting:
            return None
        release_ns, delay_ns, item = self._waiting.pop()
        self.void()
        return Arrived(item, min(delay_ns, now_ns - (release_ns - delay_ns)))

    def void(self) -> bool:
        """Drop all that are on their way; whether there were any."""
        count = len(self._waiting)
        self.overtaken += count
        self._waiting.clear()
        return bool(count)


class StateWay:
    """The states of one rig on their way to the controller: looked at when a register is read, so without timers."""

    def __init__(self, fates: Fates, shown: TimestampedPayload | None) -> None:
        self.line: Line[TimestampedPayload] = Line(fates)
        self._shown = shown
        self._arrivals: deque[TimestampedPayload] = deque()
        self.arrive = self._arrivals.append
        """A state came to the edge; called on the bus's thread."""

    def newest(self, now_ns: int) -> TimestampedPayload | None:
        """The newest state that has come to the end of its way; the same object until the next one has."""
        line, arrivals = self.line, self._arrivals
        while arrivals:
            arrival = arrivals.popleft()
            line.put(arrival, arrival.arrived_ns)
        while (arrived := line.take(now_ns)) is not None:
            self._shown = arrived.item._replace(injected_ns=arrived.injected_ns)
        return self._shown
