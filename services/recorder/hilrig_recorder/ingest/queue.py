"""From the bus to the recorder: a bounded queue, and what had to be dropped when it was full.

The bus's callback decodes a batch's envelope (not the messages in it), stamps its arrival and enqueues it. When the
queue is full the messages of a batch are dropped but not forgotten: their number for each key takes the batch's
place in the queue, so that what follows is not mistaken for a loss on the way. Events are kept, for they begin and
end sessions.
"""

import threading
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_runtime.messaging.recording_stream import Entry, entries_of, put_entries
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import LogBatch
from hilrig_schemas.topics import EVENT

_EVENT_SUFFIX: Final = f"/{EVENT.name}"
EVENT_LIMIT: Final = 10_000
"""Events kept of what was dropped; a recorder that is stuck for hours must not grow without end."""


@dataclass(slots=True)
class Drop:
    """Messages of one key that were dropped."""

    count: int = 0
    last_sequence: int = 0


@dataclass(slots=True)
class Arrival:
    """A batch as it came in, or what is left of one or more that had to be dropped."""

    batch: LogBatch
    wall_ns: int
    """Arrival, wall clock, ns."""
    dropped: dict[str, Drop] = field(default_factory=dict)
    """What is missing from it because the queue was full, by key."""
    batches: int = 1
    """How many batches it stands for."""
    waiting: int = 0
    """Messages that count against the queue's capacity."""


class Intake:
    """The queue; `offer` is for the bus's thread, `take` for the recorder's."""

    def __init__(self, capacity: int, clock: Clock) -> None:
        self.capacity = capacity
        self.received = 0
        """Messages taken in."""
        self.dropped = 0
        """Messages dropped because the queue was full."""
        self.malformed = 0
        """Batches that could not be decoded."""
        self._wall_ns = clock.wall_ns
        self._queue: SimpleQueue[Arrival] = SimpleQueue()
        self._taken = 0
        self._entered = 0
        # Drops of a source pile up in one entry of the queue until a batch of that source gets in again.
        self._dropping: dict[str, Arrival] = {}
        self._lock = threading.Lock()

    @property
    def depth(self) -> int:
        """Messages that wait."""
        return self._entered - self._taken

    def offer(self, key: str, payload: bytes) -> None:  # noqa: ARG002
        """Take a batch from the bus; never blocks."""
        wall_ns = self._wall_ns()
        try:
            batch = LogBatch.FromString(payload)
        except DecodeError:
            self.malformed += 1
            return
        count = len(batch.keys)
        if not count == len(batch.sequences) == len(batch.publish_wall_ns) == len(batch.payloads):
            self.malformed += 1
            return
        with self._lock:
            self.received += count
            # An empty queue takes a batch of any size: a small capacity must not lock a large lab out.
            if self.depth + count <= self.capacity or not self.depth:
                self._entered += count
                if self._dropping:
                    self._dropping.pop(batch.source, None)
                self._queue.put(Arrival(batch, wall_ns, waiting=count))
            else:
                self._drop(batch, wall_ns)

    def _drop(self, batch: LogBatch, wall_ns: int) -> None:
        pile = self._dropping.get(batch.source)
        if pile is not None and pile.batch.incarnation != batch.incarnation:
            pile = None
        fresh = pile is None
        if pile is None:
            pile = self._dropping[batch.source] = Arrival(
                LogBatch(source=batch.source, incarnation=batch.incarnation), wall_ns, batches=0
            )
        kept: list[Entry] = []
        for entry in entries_of(batch):
            key, sequence, *_ = entry
            if key.endswith(_EVENT_SUFFIX) and len(pile.batch.keys) + len(kept) < EVENT_LIMIT:
                kept.append(entry)
                continue
            drop = pile.dropped.setdefault(key, Drop())
            drop.count += 1
            drop.last_sequence = sequence
            self.dropped += 1
        put_entries(pile.batch, kept)
        pile.batch.sequence = batch.sequence
        pile.batches += 1
        if batch.complete_sessions or batch.sessions:
            pile.batch.complete_sessions = batch.complete_sessions
            del pile.batch.sessions[:]
            pile.batch.sessions.extend(batch.sessions)
        if fresh:
            self._queue.put(pile)

    def take(self, timeout_s: float) -> Arrival | None:
        """The next batch in order of arrival; None: nothing came in time."""
        try:
            arrival = self._queue.get(timeout=timeout_s) if timeout_s > 0 else self._queue.get_nowait()
        except Empty:
            return None
        with self._lock:
            if self._dropping.get(arrival.batch.source) is arrival:
                del self._dropping[arrival.batch.source]
            self._taken += arrival.waiting
        return arrival
