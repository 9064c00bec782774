"""A recording stream: publishes batches of all messages that a service published or observed.

Recording favors completeness over latency: entries are collected and published together, at most `FLUSH_PERIOD_NS`
later, on the service's own log topic, to which only the recorder subscribes. On the control path this costs one list
entry per message.

Events are few, and the most important messages after an outage. So they are published in batches of their own, by a
publisher whose cache therefore covers minutes, not seconds: the states do not displace them.

A batch has a checksum. A zenoh session that is closed while a peer reads too slowly cancels a write in the middle of a
batch and then writes the rest of its queue: the peer receives the first part of the batch, followed by other bytes.
"""

import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_runtime.bus.api import Publisher
from hilrig_schemas import LogBatch, OpenSession
from hilrig_schemas.bounds import MAX_INTEGER, MAX_ITEMS, MAX_SEQUENCE, check_bounds

FLUSH_PERIOD_NS: Final = 20_000_000
EVENTS_PERIOD_NS: Final = 200_000_000
"""Shortest time between two batches of events, ns: many events must not fill the cache of events within seconds."""
SESSIONS_PERIOD_NS: Final = 500_000_000
"""Interval at which a service that owns sessions announces all of them, ns."""

MAX_CACHED_MESSAGES: Final = 50_000
"""Number of messages that a service caches for a recorder that restarts, within the limits below: about 15 MB."""
MIN_CACHE_S: Final = 10.0
MAX_CACHE_S: Final = 30.0

_CHECKSUM: Final = struct.Struct("<BI")
_CHECKSUM_TAG: Final = LogBatch.CHECKSUM_FIELD_NUMBER << 3 | 5
"""Number and wire type (fixed32) of the field `checksum`."""

Entry = tuple[str, int, int, bytes]
"""Key, sequence number of the publisher on that key, time of publication (ns, wall clock), encoded message."""


def put_entries(batch: LogBatch, entries: Sequence[Entry]) -> None:
    """Add messages to a batch."""
    if entries:
        # Whole columns at once: takes a tenth of the time of one record per message.
        keys, sequences, publish_wall_ns, payloads = zip(*entries, strict=True)
        batch.keys.extend(keys)
        batch.sequences.extend(sequences)
        batch.publish_wall_ns.extend(publish_wall_ns)
        batch.payloads.extend(payloads)


def entries_of(batch: LogBatch) -> Iterable[Entry]:
    """Return the messages of a batch, in order.

    Raises:
        ValueError: during the iteration, if the columns have different lengths.
    """
    return zip(batch.keys, batch.sequences, batch.publish_wall_ns, batch.payloads, strict=True)


def encode_batch(batch: LogBatch) -> bytes:
    """Encode a batch, with its checksum first: transport overwrites the end of a batch."""
    body = batch.SerializeToString()
    return _CHECKSUM.pack(_CHECKSUM_TAG, zlib.crc32(body)) + body


def decode_batch(payload: bytes) -> LogBatch:
    """Decode a batch.

    Raises:
        DecodeError: not a batch, corrupted in transport, or with a value out of its bounds.
    """
    batch = LogBatch.FromString(payload)
    if batch.HasField("checksum"):
        body = memoryview(payload)[_CHECKSUM.size :]
        if payload[: _CHECKSUM.size] != _CHECKSUM.pack(_CHECKSUM_TAG, zlib.crc32(body)):
            raise DecodeError("the checksum of the batch is wrong")
    if not batch.source:
        raise DecodeError("the batch has no source")
    # Whole columns: no step for each message.
    keys, sequences, times = batch.keys, batch.sequences[:], batch.publish_wall_ns[:]
    if not len(keys) == len(sequences) == len(times) == len(batch.payloads):
        raise DecodeError("the columns of the batch have different lengths")
    if sequences and (max(sequences) > MAX_SEQUENCE or min(times) < 0 or max(times) > MAX_INTEGER):
        raise DecodeError("a sequence number or time of the batch is out of its bounds")
    if batch.incarnation > MAX_INTEGER or batch.sequence > MAX_SEQUENCE or len(batch.sessions) > MAX_ITEMS:
        raise DecodeError("a number of the batch is out of its bounds")
    for session in batch.sessions:
        check_bounds(session)
    return batch


def batch_cache_depth(rigs: int, step_ms: float) -> int:
    """Return the cache depth of a recording stream, batches: 30 s of a few rigs, 10 s of hundreds.

    This bounds the memory, and the amount of data that a restarted recorder must receive at once.
    """
    seconds = MAX_CACHED_MESSAGES / (rigs * 1000 / step_ms)
    return round(min(max(seconds, MIN_CACHE_S), MAX_CACHE_S) * 1e9 / FLUSH_PERIOD_NS)


class EventStream:
    """Collects the events of a recording stream, from any thread; they are published by its owner."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._entries: list[Entry] = []
        self._due_ns = 0

    def append(self, key: str, sequence: int, publish_wall_ns: int, payload: bytes) -> None:
        """Add one event, as `RecordingStream.append`."""
        self._entries.append((key, sequence, publish_wall_ns, payload))

    def is_due(self, now_ns: int, *, at_once: bool) -> bool:
        """Return whether there are events to publish now; `at_once`: also within `EVENTS_PERIOD_NS` of the last."""
        return bool(self._entries) and (at_once or now_ns >= self._due_ns)

    def flush(self, batch: LogBatch, now_ns: int) -> None:
        """Publish the collected events in `batch`, which has the number of the last other batch."""
        self._due_ns = now_ns + EVENTS_PERIOD_NS
        count = len(self._entries)
        batch.events = True
        put_entries(batch, self._entries[:count])
        del self._entries[:count]
        self._publisher.put(encode_batch(batch))


class RecordingStream:
    """Collects entries from any thread, and publishes them as `LogBatch` on the thread that calls `flush`.

    `events` publishes the batches of events.
    """

    def __init__(self, publisher: Publisher, events: Publisher, source: str, incarnation: int) -> None:
        self.events = EventStream(events)
        self._publisher = publisher
        self._source = source
        self._incarnation = incarnation
        self._sequence = 0
        self._entries: list[Entry] = []
        self._sessions: tuple[OpenSession, ...] | None = None
        self._sessions_due_ns = 0
        self._flush_due_ns = 0

    def append(self, key: str, sequence: int, publish_wall_ns: int, payload: bytes) -> None:
        """Add one message as published on the bus; cheap, and safe from any thread."""
        self._entries.append((key, sequence, publish_wall_ns, payload))

    def extend(self, entries: Iterable[Entry]) -> None:
        """Add many messages at once, as `append` does."""
        self._entries.extend(entries)

    def set_sessions(self, sessions: Sequence[OpenSession]) -> None:
        """Set the sessions that this service owns; announced with the next flush, and then twice a second."""
        self._sessions = tuple(sessions)
        self._sessions_due_ns = 0

    def flush_if_due(self, now_ns: int) -> None:
        """Publish the collected entries, at most every `FLUSH_PERIOD_NS`; `now_ns`: monotonic clock."""
        if now_ns >= self._flush_due_ns:
            # Not relative to now: a loop with this period that is sometimes early would flush only every second time.
            self._flush_due_ns = max(self._flush_due_ns + FLUSH_PERIOD_NS, now_ns)
            self.flush(now_ns, at_once=False)

    def flush(self, now_ns: int, *, at_once: bool = True) -> None:
        """Publish the collected entries now; events too with `at_once`, otherwise if they are due."""
        # A fixed length, because another thread may append meanwhile.
        entries = self._entries
        count = len(entries)
        sessions_due = self._sessions is not None and now_ns >= self._sessions_due_ns
        if count or sessions_due:
            self._sequence += 1
            batch = self._new_batch()
            put_entries(batch, entries[:count])
            del entries[:count]
            if self._sessions is not None and sessions_due:
                self._sessions_due_ns = now_ns + SESSIONS_PERIOD_NS
                batch.sessions.extend(self._sessions)
                batch.complete_sessions = True
            self._publisher.put(encode_batch(batch))
        if self.events.is_due(now_ns, at_once=at_once):
            self.events.flush(self._new_batch(), now_ns)

    def _new_batch(self) -> LogBatch:
        return LogBatch(source=self._source, incarnation=self._incarnation, sequence=self._sequence)
