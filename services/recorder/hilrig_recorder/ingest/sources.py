"""Tracks publishers: detects lost messages by sequence numbers, and wall clock steps by time stamps. Pure."""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from hilrig_recorder.ingest.queue import ReceivedBatch
from hilrig_schemas import LogBatch

WALL_CLOCK_STEP_THRESHOLD_NS: Final = 50_000_000
"""A larger change of the difference between a wall clock and a monotonic clock is a clock step."""
SETTLE_TIME_NS: Final = 15_000_000_000
"""Time after the first batch of a new publisher in which it may deliver older, cached batches."""
MAX_GAP: Final = (1 << 32) - 1
"""Maximum number of messages that one gap may state, three years of one rig; a larger one is an invalid number."""
MAX_PUBLISHERS: Final = 1024
"""Maximum number of publishers; a service that invents incarnations evicts its own."""
PUBLISHER_TIMEOUT_NS: Final = 120_000_000_000
"""Files no longer wait for a publisher that is silent for this time; it is evicted if its service was restarted."""
MAX_DRIFT: Final = 2000
"""Two clocks that are being slewed drift apart by at most 1 ns in this time, ns (500 ppm, the limit of the kernel)."""
MAX_HELD_BATCHES: Final = 4096
"""Maximum number of batches of events of one publisher that wait for the batches before them."""


@dataclass(slots=True, eq=False)
class KeyStream:
    """The messages of one publisher on one key."""

    key: str
    rig: str
    channel_id: int
    expected: int
    """Next sequence number; 0: unknown."""
    pending: list[bytes]
    """The encoded messages of the rig that are not written yet: `PreRollBuffer.pending`."""

    def missing_before(self, sequence: int) -> int:
        """Number of messages missing before this one; negative: it is a duplicate."""
        return sequence - self.expected if self.expected else 0


@dataclass(slots=True, eq=False)
class PublisherState:
    """Sequence numbers and clock of one incarnation of a service."""

    name: str
    """Its source, "<service>/<instance>"."""
    incarnation: int
    first_ns: int
    """Arrival of its first batch, monotonic clock, ns."""
    restarted: bool
    """Whether an earlier incarnation was received. Then its first message on each key must have sequence number 1."""
    last_ns: int = 0
    """Arrival of its last batch, monotonic clock, ns."""
    last_publish_ns: int = 0
    """Publish time of its last message, wall clock of the publisher, ns."""
    streams: dict[str, KeyStream | None] = field(default_factory=dict)
    """By key; None: the key is not recorded."""
    continuous_rigs: set[str] = field(default_factory=set)
    """Rigs for which it publishes other messages than events."""
    held: deque[ReceivedBatch] = field(default_factory=lambda: deque(maxlen=MAX_HELD_BATCHES))
    """Batches of events that wait for the other batches before them: after an outage both arrive independently."""
    earlier_events: dict[str, list[bytes]] = field(default_factory=dict)
    """Encoded events that precede its first other batch, by session: for sessions that continue."""
    passed_ns: int = 0
    """Everything that it published before this time was received, wall clock of the publisher, ns."""
    _first_batch: int = 0
    _next_batch: int = 0
    _offset_ns: int | None = None

    def update(self, received: ReceivedBatch, now_ns: int) -> tuple[int, bool]:
        """Update the state with a received batch.

        Returns:
            The number of batches missing before it, and whether the wall clock of the publisher stepped since the
            previous batch.
        """
        batch = received.batch
        missing = 0
        if self._next_batch:
            missing = min(max(0, batch.sequence - self._next_batch - (received.batch_count - 1)), MAX_GAP)
        else:
            self._first_batch = batch.sequence
        self._next_batch = max(self._next_batch, batch.sequence + 1)
        stepped = bool(batch.keys) and self._clock_stepped(batch.publish_wall_ns[-1], now_ns)
        self.last_ns = now_ns
        return missing, stepped

    @property
    def is_streaming(self) -> bool:
        """Whether a batch of its recording stream arrived; its events have a stream of their own."""
        return self._next_batch > 0

    def next_events(self) -> LogBatch | None:
        """Remove and return the next batch of events that may be processed; None: it must wait."""
        return self.held.popleft().batch if self.held and self.held[0].batch.sequence < self._next_batch else None

    def is_before_first(self, events: LogBatch) -> bool:
        """Whether events were published before everything else that was received of this publisher."""
        return events.sequence < self._first_batch - 1

    def _clock_stepped(self, publish_ns: int, now_ns: int) -> bool:
        # A delay decreases the offset, an outage decreases it by much. Only a forward step increases it, and only a
        # backward step makes publish times decrease.
        offset_ns, before_ns = publish_ns - now_ns, self._offset_ns
        backward = publish_ns < self.last_publish_ns - WALL_CLOCK_STEP_THRESHOLD_NS
        self.last_publish_ns = self.passed_ns = publish_ns
        if before_ns is None or backward:
            self._offset_ns = offset_ns
            return before_ns is not None
        self._offset_ns = max(before_ns, offset_ns)
        threshold_ns = WALL_CLOCK_STEP_THRESHOLD_NS + (now_ns - self.last_ns) // MAX_DRIFT
        return offset_ns > before_ns + threshold_ns and now_ns - self.first_ns > SETTLE_TIME_NS


class PublisherTracker:
    """The publishers by source and incarnation: the newest one of each source, and others that were active recently."""

    def __init__(self) -> None:
        self._publishers: dict[tuple[str, int], PublisherState] = {}
        self._evicted: list[PublisherState] = []

    def publisher_of(self, received: ReceivedBatch, now_ns: int) -> PublisherState:
        """The publisher of a batch."""
        name, incarnation = identity = received.batch.source, received.batch.incarnation
        publisher = self._publishers.get(identity)
        if publisher is None:
            restarted = any(known == name for known, _ in self._publishers)
            if len(self._publishers) >= MAX_PUBLISHERS:
                self._evict(min(self._publishers.values(), key=lambda each: (each.name != name, each.last_ns)))
            publisher = PublisherState(name, incarnation, first_ns=now_ns, restarted=restarted, last_ns=now_ns)
            self._publishers[identity] = publisher
        return publisher

    def last_received(self) -> dict[str, int]:
        """Arrival of the last batch of each source, monotonic clock, ns; safe from any thread.

        A source is missing while only its events arrive: its states are not received yet.
        """
        last: dict[str, int] = {}
        for publisher in list(self._publishers.values()):
            if publisher.is_streaming:
                last[publisher.name] = max(last.get(publisher.name, 0), publisher.last_ns)
        return last

    def evict_superseded(self, now_ns: int) -> list[PublisherState]:
        """Evict silent publishers of restarted services, and return all that were evicted; forget old events.

        The newest publisher of a source stays: after an outage of any length its numbers show the loss.
        """
        newest_ns = self.last_received()
        for publisher in list(self._publishers.values()):
            if now_ns - publisher.first_ns > SETTLE_TIME_NS:
                publisher.earlier_events.clear()
            if publisher.last_ns < min(newest_ns.get(publisher.name, 0), now_ns - PUBLISHER_TIMEOUT_NS):
                self._evict(publisher)
        evicted, self._evicted = self._evicted, []
        return evicted

    def _evict(self, publisher: PublisherState) -> None:
        del self._publishers[publisher.name, publisher.incarnation]
        self._evicted.append(publisher)
