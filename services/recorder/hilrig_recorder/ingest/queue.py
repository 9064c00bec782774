"""The ingest queue: a bounded queue between the bus and the recorder's thread that counts dropped messages.

The bus callback decodes the envelope of a batch (not its messages), stamps its arrival and enqueues it. If the queue is
full, the messages of the batch are dropped, and their number per key is enqueued in place of the batch. So later
messages do not look like the first ones after a transport loss. Events are kept, because they start and end sessions.
"""

import threading
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.recording_stream import Entry, decode_batch, entries_of, put_entries
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import LogBatch
from hilrig_schemas.topics import EVENT, source_of_key

_EVENT_SUFFIX: Final = f"/{EVENT.name}"
MAX_EVENTS_PER_OVERFLOW: Final = 10_000
"""Maximum number of events kept from dropped batches; it bounds the memory of a recorder that is blocked for hours."""


@dataclass(slots=True)
class DroppedMessages:
    """Messages of one key that were dropped because the queue was full."""

    count: int = 0
    last_sequence: int = 0


@dataclass(slots=True)
class ReceivedBatch:
    """A received batch, or an overflow marker that replaces one or more dropped batches."""

    batch: LogBatch
    wall_ns: int
    """Arrival, wall clock, ns."""
    dropped: dict[str, DroppedMessages] = field(default_factory=dict)
    """Messages dropped because the queue was full, by key."""
    batch_count: int = 1
    """Number of batches that it represents."""
    message_count: int = 0
    """Messages that count against the capacity of the queue."""


class IngestQueue:
    """The queue; the bus thread calls `put`, the recorder's thread calls `get`."""

    def __init__(self, capacity: int, clock: Clock, counters: Counters) -> None:
        self.capacity = capacity
        self.received = 0
        """Messages received, including dropped ones."""
        self.dropped = 0
        """Messages dropped because the queue was full."""
        self.counters = counters
        """Count batches that can't be decoded, whose checksum is wrong, or that contradict their key."""
        self._wall_ns = clock.wall_ns
        self._queue: SimpleQueue[ReceivedBatch] = SimpleQueue()
        self._removed = 0
        self._added = 0
        # One overflow marker per source, until a batch of that source is enqueued again.
        self._markers: dict[str, ReceivedBatch] = {}
        self._lock = threading.Lock()

    @property
    def depth(self) -> int:
        """Messages in the queue."""
        return self._added - self._removed

    def put(self, key: str, payload: bytes) -> None:
        """Enqueue a batch from the bus; never blocks."""
        wall_ns = self._wall_ns()
        try:
            batch = decode_batch(payload)
            if batch.source != source_of_key(key):
                raise DecodeError(f"batch of {batch.source!r}")
        except DecodeError as error:
            self.counters.reject(key, error)
            return
        count = len(batch.keys)
        with self._lock:
            self.received += count
            # An empty queue accepts a batch of any size, so that a small capacity does not exclude a large lab.
            if self.depth + count <= self.capacity or not self.depth:
                self._added += count
                if self._markers:
                    self._markers.pop(batch.source, None)
                self._queue.put(ReceivedBatch(batch, wall_ns, message_count=count))
            else:
                self._drop(batch, wall_ns)

    def _drop(self, batch: LogBatch, wall_ns: int) -> None:
        marker = self._markers.get(batch.source)
        if marker is not None and marker.batch.incarnation != batch.incarnation:
            marker = None
        is_new = marker is None
        if marker is None:
            marker = self._markers[batch.source] = ReceivedBatch(
                LogBatch(source=batch.source, incarnation=batch.incarnation), wall_ns, batch_count=0
            )
        kept: list[Entry] = []
        for entry in entries_of(batch):
            key, sequence, *_ = entry
            if key.endswith(_EVENT_SUFFIX) and len(marker.batch.keys) + len(kept) < MAX_EVENTS_PER_OVERFLOW:
                kept.append(entry)
                continue
            dropped = marker.dropped.setdefault(key, DroppedMessages())
            dropped.count += 1
            dropped.last_sequence = sequence
            self.dropped += 1
        put_entries(marker.batch, kept)
        if not batch.events:
            marker.batch.sequence = batch.sequence
            marker.batch_count += 1
        if batch.complete_sessions or batch.sessions:
            marker.batch.complete_sessions = batch.complete_sessions
            del marker.batch.sessions[:]
            marker.batch.sessions.extend(batch.sessions)
        if is_new:
            self._queue.put(marker)

    def get(self, timeout_s: float) -> ReceivedBatch | None:
        """The next batch in order of arrival; None: no batch arrived within the timeout."""
        try:
            received = self._queue.get(timeout=timeout_s) if timeout_s > 0 else self._queue.get_nowait()
        except Empty:
            return None
        with self._lock:
            if self._markers.get(received.batch.source) is received:
                del self._markers[received.batch.source]
            self._removed += received.message_count
        return received
