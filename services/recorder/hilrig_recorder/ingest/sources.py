"""Tracks publishers: detects lost messages by sequence numbers, and wall clock steps by time stamps. Pure."""

from collections import deque
from collections.abc import Iterator
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
"""Maximum number of publishers; if one invents incarnations, the publisher that is silent for longest is evicted."""
PUBLISHER_TIMEOUT_NS: Final = 120_000_000_000
"""A publisher that is silent for this time is evicted."""
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
        self.last_ns = now_ns
        stepped = bool(batch.keys) and self._clock_stepped(batch.publish_wall_ns[-1], now_ns)
        return missing, stepped

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
        return offset_ns > before_ns + WALL_CLOCK_STEP_THRESHOLD_NS and now_ns - self.first_ns > SETTLE_TIME_NS


class PublisherTracker:
    """The publishers that were active recently, by source and incarnation."""

    def __init__(self) -> None:
        self._publishers: dict[tuple[str, int], PublisherState] = {}

    def publisher_of(self, received: ReceivedBatch, now_ns: int) -> PublisherState:
        """The publisher of a batch."""
        identity = (received.batch.source, received.batch.incarnation)
        publisher = self._publishers.get(identity)
        if publisher is None:
            restarted = any(name == identity[0] for name, _ in self._publishers)
            if len(self._publishers) >= MAX_PUBLISHERS:
                # Evicted at the next tick.
                oldest = min(self._publishers.values(), key=lambda each: each.last_ns)
                oldest.last_ns = -PUBLISHER_TIMEOUT_NS
            publisher = PublisherState(*identity, first_ns=now_ns, restarted=restarted, last_ns=now_ns)
            self._publishers[identity] = publisher
        return publisher

    def last_received(self) -> dict[str, int]:
        """Arrival of the last batch of each source, monotonic clock, ns."""
        last: dict[str, int] = {}
        for publisher in self._publishers.values():
            last[publisher.name] = max(last.get(publisher.name, 0), publisher.last_ns)
        return last

    def evict_silent(self, now_ns: int) -> Iterator[PublisherState]:
        """Evict the publishers that exceed `PUBLISHER_TIMEOUT_NS`, and yield them; forget old events of the others."""
        for identity, publisher in list(self._publishers.items()):
            if now_ns - publisher.first_ns > SETTLE_TIME_NS:
                publisher.earlier_events.clear()
            if now_ns - publisher.last_ns > PUBLISHER_TIMEOUT_NS:
                del self._publishers[identity]
                yield publisher
