"""A recording stream: the bytes of everything that a service published or observed, in batches.

Recording is complete rather than early: entries are collected as they come and leave together, at most
`FLUSH_PERIOD_NS` later, on the service's own log topic, where the recorder alone listens. So it costs the control
path one list entry a message.

A batch has a checksum. A zenoh session that is closed while a peer reads too slowly stops in the middle of a write and
then writes the rest of its queue: the peer gets the first part of a batch, filled up with bytes of what follows.
"""

import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_runtime.bus.api import Publisher
from hilrig_schemas import LogBatch, OpenSession

FLUSH_PERIOD_NS: Final = 20_000_000
SESSIONS_PERIOD_NS: Final = 500_000_000
"""How often a service that keeps sessions states them all, ns."""

KEPT_MESSAGES: Final = 50_000
"""What a service keeps for a recorder that comes back, where that is more than the shortest while: some 15 MB."""
SHORTEST_KEPT_S: Final = 10.0
LONGEST_KEPT_S: Final = 30.0

_CHECKSUM: Final = struct.Struct("<BI")
_CHECKSUM_TAG: Final = LogBatch.CHECKSUM_FIELD_NUMBER << 3 | 5
"""Number and wire type (fixed32) of the field `checksum`."""

Entry = tuple[str, int, int, bytes]
"""Key, sequence of the sender on that key, time of publication (ns, wall clock), encoded message."""


def put_entries(batch: LogBatch, entries: Sequence[Entry]) -> None:
    """Add messages to a batch."""
    if entries:
        # Whole columns at once: a tenth of what a record for each message would take.
        keys, sequences, publish_wall_ns, payloads = zip(*entries, strict=True)
        batch.keys.extend(keys)
        batch.sequences.extend(sequences)
        batch.publish_wall_ns.extend(publish_wall_ns)
        batch.payloads.extend(payloads)


def entries_of(batch: LogBatch) -> Iterable[Entry]:
    """The messages of a batch, in order.

    Raises:
        ValueError: while it is iterated, that the columns are not equally long.
    """
    return zip(batch.keys, batch.sequences, batch.publish_wall_ns, batch.payloads, strict=True)


def encode_batch(batch: LogBatch) -> bytes:
    """Encode a batch, with its checksum first: what is lost in transport is the end of a batch."""
    body = batch.SerializeToString()
    return _CHECKSUM.pack(_CHECKSUM_TAG, zlib.crc32(body)) + body


def decode_batch(payload: bytes) -> LogBatch:
    """Decode a batch.

    Raises:
        DecodeError: it is no batch, or its bytes are not those that were sent.
    """
    batch = LogBatch.FromString(payload)
    if batch.HasField("checksum"):
        body = memoryview(payload)[_CHECKSUM.size :]
        if payload[: _CHECKSUM.size] != _CHECKSUM.pack(_CHECKSUM_TAG, zlib.crc32(body)):
            raise DecodeError("the checksum of the batch is wrong")
    if not batch.source:
        raise DecodeError("the batch has no source")
    return batch


def batch_cache_depth(rigs: int, step_ms: float) -> int:
    """How many batches of a lab's recording stream its sender keeps: 30 s of a few rigs, 10 s of hundreds.

    The memory that this takes has a bound, and so has what a recorder that comes back must take in at once.
    """
    seconds = KEPT_MESSAGES / (rigs * 1000 / step_ms)
    return round(min(max(seconds, SHORTEST_KEPT_S), LONGEST_KEPT_S) * 1e9 / FLUSH_PERIOD_NS)


class RecordingStream:
    """Collects entries from any thread, and sends them as `LogBatch` from the thread that calls `flush`."""

    def __init__(self, publisher: Publisher, source: str, incarnation: int) -> None:
        self._publisher = publisher
        self._source = source
        self._incarnation = incarnation
        self._sequence = 0
        self._entries: list[Entry] = []
        self._sessions: tuple[OpenSession, ...] | None = None
        self._sessions_due_ns = 0
        self._flush_due_ns = 0

    def append(self, key: str, sequence: int, publish_wall_ns: int, payload: bytes) -> None:
        """Add one message as it stood on the bus; cheap, and safe from any thread."""
        self._entries.append((key, sequence, publish_wall_ns, payload))

    def extend(self, entries: Iterable[Entry]) -> None:
        """Add many messages at once, as `append` does."""
        self._entries.extend(entries)

    def set_sessions(self, sessions: Sequence[OpenSession]) -> None:
        """State the sessions that this service keeps; said at once, and again twice a second."""
        self._sessions = tuple(sessions)
        self._sessions_due_ns = 0

    def flush_if_due(self, now_ns: int) -> None:
        """Send what has come in, at most every `FLUSH_PERIOD_NS`; `now_ns` is of the monotonic clock."""
        if now_ns >= self._flush_due_ns:
            # Not counted from now: a loop of this period, a little early now and then, would skip every other turn.
            self._flush_due_ns = max(self._flush_due_ns + FLUSH_PERIOD_NS, now_ns)
            self.flush(now_ns)

    def flush(self, now_ns: int) -> None:
        """Send what has come in now."""
        # Cut at a fixed length: another thread may append meanwhile.
        entries = self._entries
        count = len(entries)
        sessions_due = self._sessions is not None and now_ns >= self._sessions_due_ns
        if not count and not sessions_due:
            return
        self._sequence += 1
        batch = LogBatch(source=self._source, incarnation=self._incarnation, sequence=self._sequence)
        put_entries(batch, entries[:count])
        del entries[:count]
        if self._sessions is not None and sessions_due:
            self._sessions_due_ns = now_ns + SESSIONS_PERIOD_NS
            batch.sessions.extend(self._sessions)
            batch.complete_sessions = True
        self._publisher.put(encode_batch(batch))
