"""Delay lines: messages of an impaired link, delayed and dropped as sampled; the newest delivered message wins.

A message whose delay ends after that of a newer one is superseded and dropped, because control has no use for it. So
the messages in flight are in the order of their delivery, and each costs the same however many are in flight. Time is
passed in.
"""

from collections import deque
from collections.abc import Iterator
from typing import Generic, NamedTuple, TypeVar

from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload

T = TypeVar("T")
ImpairmentSamples = Iterator[tuple[int, bool]]
"""For each message: its delay, ns, and whether it is dropped (`Impairment.samples`)."""


class Delivered(NamedTuple, Generic[T]):
    """A message whose delay has passed."""

    item: T
    injected_ns: int
    """Injected delay, ns."""


class DelayLine(Generic[T]):
    """Delay line of one link. Times are ns of the monotonic clock."""

    def __init__(self, samples: ImpairmentSamples) -> None:
        self._in_flight: deque[tuple[int, int, T]] = deque()
        self.set_samples(samples)

    def set_samples(self, samples: ImpairmentSamples) -> None:
        """Use other samples for the next messages and restart the counters; messages in flight keep their delay."""
        self._samples = samples
        self.count = 0
        """Number of messages put into the line."""
        self.lost = 0
        """Number of messages that the samples dropped."""
        self.superseded = 0
        """Number of messages dropped in flight: because a newer one was faster, or by `drop_in_flight`."""

    @property
    def next_ns(self) -> int | None:
        """Time at which the next message is due; None: none is in flight."""
        return self._in_flight[0][0] if self._in_flight else None

    def put(self, item: T, now_ns: int) -> bool:
        """Put a message into the line; return False if it is dropped."""
        delay_ns, lost = next(self._samples)
        self.count += 1
        if lost:
            self.lost += 1
            return False
        release_ns = now_ns + delay_ns
        in_flight = self._in_flight
        while in_flight and in_flight[-1][0] > release_ns:
            in_flight.pop()
            self.superseded += 1
        in_flight.append((release_ns, delay_ns, item))
        return True

    def pop_due(self, now_ns: int) -> Delivered[T] | None:
        """Remove and return the next message whose delay has passed; None: none."""
        if not self._in_flight or self._in_flight[0][0] > now_ns:
            return None
        _, delay_ns, item = self._in_flight.popleft()
        return Delivered(item, delay_ns)

    def release_newest(self, now_ns: int) -> Delivered[T] | None:
        """Deliver the newest message in flight now, and drop the others; None: none is in flight."""
        if not self._in_flight:
            return None
        release_ns, delay_ns, item = self._in_flight.pop()
        self.drop_in_flight()
        return Delivered(item, min(delay_ns, now_ns - (release_ns - delay_ns)))

    def drop_in_flight(self) -> bool:
        """Drop all messages in flight; return whether there were any."""
        count = len(self._in_flight)
        self.superseded += count
        self._in_flight.clear()
        return bool(count)


class DelayedStates:
    """Delay line of the states of one rig; evaluated when a register is read, so it needs no timers."""

    def __init__(self, samples: ImpairmentSamples, initial: TimestampedPayload | None) -> None:
        self.line: DelayLine[TimestampedPayload] = DelayLine(samples)
        self._newest = initial
        self._arrivals: deque[TimestampedPayload] = deque()
        self.arrive = self._arrivals.append
        """Add a received state; may be called on the bus's thread."""

    def newest(self, now_ns: int) -> TimestampedPayload | None:
        """Return the newest state whose delay has passed; the same object until there is a newer one."""
        line, arrivals = self.line, self._arrivals
        while arrivals:
            arrival = arrivals.popleft()
            line.put(arrival, arrival.arrived_ns)
        while (delivered := line.pop_due(now_ns)) is not None:
            self._newest = delivered.item._replace(injected_ns=delivered.injected_ns)
        return self._newest
