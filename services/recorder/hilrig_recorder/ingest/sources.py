"""Who sends, what is missing of it, and whether a wall clock was set: read off sequence numbers and stamps. Pure."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from hilrig_recorder.ingest.queue import Arrival

CLOCK_STEP_NS: Final = 50_000_000
"""A wall clock that moves against a monotonic one by more than this has been set."""
SETTLING_NS: Final = 15_000_000_000
"""How long a source that is new may have more to send than has just happened."""
MEMORY_NS: Final = 120_000_000_000
"""A source that is silent so long is forgotten."""


@dataclass(slots=True, eq=False)
class Stream:
    """One sender on one key."""

    key: str
    rig: str
    channel_id: int
    expected: int
    """Next sequence number; 0: any."""
    append: Callable[[bytes], None]
    """Where its messages wait."""

    def missing(self, sequence: int) -> int:
        """How many messages are missing before this one; negative: it has come before."""
        return sequence - self.expected if self.expected else 0


@dataclass(slots=True, eq=False)
class Source:
    """One run of a service."""

    name: str
    incarnation: int
    first_ns: int
    """When it was first heard, monotonic clock, ns."""
    fresh: bool
    """Whether it began while the recorder listened: then its first message on a key has the number 1."""
    last_ns: int = 0
    """When it was last heard, monotonic clock, ns."""
    last_publish_ns: int = 0
    """Stamp of the last message, its wall clock, ns."""
    streams: dict[str, Stream | None] = field(default_factory=dict)
    """By key; None: nothing that is recorded."""
    steady: set[str] = field(default_factory=set)
    """Rigs of which it sends more than events."""
    _next_batch: int = 0
    _offset_ns: int | None = None

    def heard(self, arrival: Arrival, now_ns: int) -> tuple[int, bool]:
        """Take note of a batch.

        Returns:
            How many batches are missing before it, and whether the source's wall clock has been set since the last.
        """
        batch = arrival.batch
        missing = 0
        if self._next_batch:
            missing = max(0, batch.sequence - self._next_batch - (arrival.batches - 1))
        self._next_batch = max(self._next_batch, batch.sequence + 1)
        self.last_ns = now_ns
        stepped = bool(batch.keys) and self._clock_stepped(batch.publish_wall_ns[-1], now_ns)
        return missing, stepped

    def _clock_stepped(self, publish_ns: int, now_ns: int) -> bool:
        # A delay lowers the difference, an outage by much; only a clock set forward lifts it, and only one set
        # backward makes stamps fall.
        offset_ns, before_ns = publish_ns - now_ns, self._offset_ns
        backward = publish_ns < self.last_publish_ns - CLOCK_STEP_NS
        self.last_publish_ns = publish_ns
        if before_ns is None or backward:
            self._offset_ns = offset_ns
            return before_ns is not None
        self._offset_ns = max(before_ns, offset_ns)
        return offset_ns > before_ns + CLOCK_STEP_NS and now_ns - self.first_ns > SETTLING_NS


class Sources:
    """All runs of services that were heard lately."""

    def __init__(self) -> None:
        self._sources: dict[tuple[str, int], Source] = {}

    def of(self, arrival: Arrival, now_ns: int) -> Source:
        """The one that sent a batch."""
        identity = (arrival.batch.source, arrival.batch.incarnation)
        source = self._sources.get(identity)
        if source is None:
            fresh = any(name == identity[0] for name, _ in self._sources)
            source = self._sources[identity] = Source(*identity, first_ns=now_ns, fresh=fresh)
        return source

    def last_heard(self) -> dict[str, int]:
        """When each service was last heard, monotonic clock, ns, by name."""
        heard: dict[str, int] = {}
        for source in self._sources.values():
            heard[source.name] = max(heard.get(source.name, 0), source.last_ns)
        return heard

    def forget(self, now_ns: int) -> Iterator[Source]:
        """Forget those that have been silent for long, and tell which."""
        for identity, source in list(self._sources.items()):
            if now_ns - source.last_ns > MEMORY_NS:
                del self._sources[identity]
                yield source
