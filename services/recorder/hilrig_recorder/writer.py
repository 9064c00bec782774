"""One recording: an MCAP file that is called `.part` while it is written and gets its name when it is whole.

Chunks of at most 64 KiB leave in one write each, so that a kill tears at most the last one; the index is collected
on the way and written at the end. A write that fails is taken back to the last whole chunk, and the file can still
be finished: what did not fit is tried again then, and where no space is left even for the index, the newest chunks
make room for it.
"""

import os
import struct
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping
from io import FileIO
from pathlib import Path
from typing import Final, NamedTuple

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from hilrig_recorder.channels import CHANNELS, SCHEMAS

if sys.platform != "win32":
    import fcntl

CHUNK_BYTES: Final = 64 * 1024
PART_SUFFIX: Final = ".part"
LIBRARY: Final = "hilrig"

_CHUNK: Final = struct.Struct("<BQQQQII4sQ")
_INDEX_HEAD: Final = struct.Struct("<BQHI")
_CHUNK_INDEX_HEAD: Final = struct.Struct("<BQQQQQI")
_CHUNK_INDEX_TAIL: Final = struct.Struct("<QI4sQQ")
_ENTRY: Final = struct.Struct("<QQQIIB")
_COUNT: Final = struct.Struct("<HI")
_CHANNEL_OFFSET: Final = struct.Struct("<HQ")
_COMPRESSION: Final = b"zstd"
# Tables of the size that a second of one rig needs: the same size on the disk as by default, for half the time.
_COMPRESSOR: Final = zstandard.ZstdCompressionParameters.from_level(1, source_size=16 * 1024)


def compressor() -> Callable[[bytes], bytes]:
    """What compresses chunks; for one thread, and best shared by all files of it: its tables then stay in the cache."""
    return zstandard.ZstdCompressor(compression_params=_COMPRESSOR).compress


def part_path(path: Path) -> Path:
    """What a recording is called while it is written."""
    return path.with_name(path.name + PART_SUFFIX)


class _Chunk(NamedTuple):
    """What is kept of a chunk that is written; times are wall clock, ns."""

    start: int
    first_ns: int
    last_ns: int
    data_size: int
    raw_size: int
    counts: tuple[tuple[int, int], ...]
    """Channel and number of its messages; their indexes follow the chunk in this order."""

    def index_record(self) -> bytes:
        """The record that leads a reader to it."""
        chunk_size = _CHUNK.size + self.data_size
        offset = self.start + chunk_size
        channel_offsets = b""
        for channel_id, count in self.counts:
            channel_offsets += _CHANNEL_OFFSET.pack(channel_id, offset)
            offset += _INDEX_HEAD.size + 16 * count
        head = _CHUNK_INDEX_HEAD.pack(
            Opcode.CHUNK_INDEX.value,
            _CHUNK_INDEX_HEAD.size + len(channel_offsets) + _CHUNK_INDEX_TAIL.size - 9,
            self.first_ns,
            self.last_ns,
            self.start,
            chunk_size,
            len(channel_offsets),
        )
        tail = _CHUNK_INDEX_TAIL.pack(
            offset - self.start - chunk_size, len(_COMPRESSION), _COMPRESSION, self.data_size, self.raw_size
        )
        return head + channel_offsets + tail


class RunWriter:
    """Writes one recording; use it from one thread, and `sync` and `publish` from any one other.

    Raises:
        OSError: from every method that writes, when the disk does not take it. What was written before stays whole.
    """

    def __init__(
        self,
        path: Path,
        *,
        schemas: tuple[Schema, ...] = SCHEMAS,
        channels: tuple[Channel, ...] = CHANNELS,
        metadata: tuple[Metadata, ...] = (),
        profile: str = "",
        library: str = LIBRARY,
        part: Path | None = None,
        on_failure: Callable[[OSError], None] | None = None,
        compress: Callable[[bytes], bytes] | None = None,
    ) -> None:
        self.path = path
        self.part = part_path(path) if part is None else part
        self._file = FileIO(self.part, "x")
        lock_file(self._file.fileno())
        self.size = 0
        """Bytes in the file, all of whole records."""
        self.message_count = 0
        self.attachment_count = 0
        self.given_up = 0
        """Messages that the disk did not take."""
        self._on_failure = on_failure
        self._compress = compressor() if compress is None else compress
        self._records: list[bytes] = []
        self._pending_bytes = 0
        self._first_ns = 0
        self._last_ns = 0
        self._indexes: dict[int, list[int]] = {}
        # What the index at the end needs of each chunk, packed: a day of them is four megabytes.
        self._chunks = bytearray()
        self._totals: dict[int, int] = {}
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        try:
            # One write: a laboratory may begin hundreds of files at once, and a file that is there says whose it is.
            begin = MCAP0_MAGIC + encoded(Header(profile, library), *schemas, *channels)
            self._append(begin + encoded(*metadata))
        except OSError:
            self.discard()
            raise
        self._schemas += schemas
        for channel in channels:
            self._know(channel)
        offset = len(begin)
        for item in metadata:
            length = len(encoded(item))
            self._metadata_indexes.append(MetadataIndex(offset, length, item.name))
            offset += length

    # -- records ----------------------------------------------------------------------------------------------------

    def add_schema(self, schema: Schema) -> None:
        """Declare a schema, outside the chunks so that a torn file has it."""
        self._append(encoded(schema))
        self._schemas.append(schema)

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel, outside the chunks too."""
        self._append(encoded(channel))
        self._know(channel)

    def _know(self, channel: Channel) -> None:
        self._channels.append(channel)
        self._indexes[channel.id] = []
        self._totals[channel.id] = 0

    def add(self, channel_id: int, log_time: int, record: bytes) -> None:
        """Add a message that is encoded already (`channels.encode_message`); `log_time` is wall clock, ns.

        A failing disk is told to `on_failure` where there is one, and raises otherwise.
        """
        pending = self._pending_bytes
        if pending + len(record) > CHUNK_BYTES and pending:
            try:
                self.close_chunk()
            except OSError as error:
                if self._on_failure is None:
                    raise
                self._on_failure(error)
            pending = self._pending_bytes
        if not pending:
            self._first_ns = self._last_ns = log_time
        elif log_time > self._last_ns:
            self._last_ns = log_time
        elif log_time < self._first_ns:
            self._first_ns = log_time
        self._indexes[channel_id] += (log_time, pending)
        self._records.append(record)
        self._pending_bytes = pending + len(record)

    @property
    def pending_messages(self) -> int:
        """Messages in the chunk that is not written yet."""
        return len(self._records)

    @property
    def pending_since_ns(self) -> int:
        """Earliest log time in the chunk that is not written yet, ns; 0: it is empty."""
        return self._first_ns if self._records else 0

    def close_chunk(self) -> None:
        """Write what has come in since the last chunk; where the disk does not take it, it waits for `finish`."""
        if not self._records:
            return
        raw = b"".join(self._records)
        data = self._compress(raw)
        head = _CHUNK.pack(
            Opcode.CHUNK.value,
            _CHUNK.size + len(data) - 9,
            self._first_ns,
            self._last_ns,
            len(raw),
            zlib.crc32(raw),
            len(_COMPRESSION),
            _COMPRESSION,
            len(data),
        )
        pieces = [head, data]
        counts: list[tuple[int, int]] = []
        for channel_id, index in self._indexes.items():
            if not index:
                continue
            counts.append((channel_id, len(index) // 2))
            entries = struct.pack(f"<{len(index)}Q", *index)
            pieces.append(_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX.value, 6 + len(entries), channel_id, len(entries)))
            pieces.append(entries)
        start = self.size
        self._append(b"".join(pieces))
        self.message_count += len(self._records)
        for channel_id, part in counts:
            self._chunks += _COUNT.pack(channel_id, part)
            self._totals[channel_id] += part
        self._chunks += _ENTRY.pack(start, self._first_ns, self._last_ns, len(data), len(raw), len(counts))
        self._forget_pending()

    def _forget_pending(self) -> None:
        self._records.clear()
        self._pending_bytes = 0
        for index in self._indexes.values():
            index.clear()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a named set of values."""
        record = encoded(Metadata(name, dict(values)))
        self._append(record)
        self._metadata_indexes.append(MetadataIndex(self.size - len(record), len(record), name))

    def add_attachment(self, name: str, media_type: str, data: bytes, *, log_time: int, create_time: int = 0) -> None:
        """Add a file to the file; times are wall clock, ns."""
        record = encoded(Attachment(create_time, log_time, name, media_type, data))
        self._append(record)
        self._attachment_indexes.append(
            AttachmentIndex(self.size - len(record), len(record), log_time, create_time, len(data), name, media_type)
        )
        self.attachment_count += 1

    # -- the end ----------------------------------------------------------------------------------------------------

    def finish(self, last_words: Callable[[], Mapping[str, Mapping[str, str]]] = dict) -> None:
        """Write the last chunk, `last_words` (metadata by name) and the index.

        Where the disk has no room for them, the newest chunks are given up until it has; `last_words` is asked again
        each time, for it may tell `given_up`.

        Raises:
            OSError: there is not even room for the index of nothing; what stands in the file can be recovered.
        """
        try:
            self.close_chunk()
        except OSError:
            self.given_up += len(self._records)
            self._forget_pending()
        while True:
            try:
                self._end(last_words())
                return
            except OSError:
                if not self._chunks:
                    raise
                self._take_back_chunk()

    def _end(self, last_words: Mapping[str, Mapping[str, str]]) -> None:
        size, known = self.size, len(self._metadata_indexes)
        try:
            for name, values in last_words.items():
                self.add_metadata(name, values)
            self._append(encoded(DataEnd(0)) + self._summary())
        except OSError:
            del self._metadata_indexes[known:]
            self._cut(size)
            raise

    def _summary(self) -> bytes:
        start = self.size + len(encoded(DataEnd(0)))
        summary = bytearray()
        offsets = bytearray()
        chunks = list(self._chunk_entries())
        groups: list[tuple[Opcode, bytes]] = [
            (Opcode.SCHEMA, encoded(*self._schemas)),
            (Opcode.CHANNEL, encoded(*self._channels)),
            (Opcode.STATISTICS, encoded(self._statistics(chunks))),
            (Opcode.CHUNK_INDEX, b"".join(chunk.index_record() for chunk in reversed(chunks))),
            (Opcode.ATTACHMENT_INDEX, encoded(*self._attachment_indexes)),
            (Opcode.METADATA_INDEX, encoded(*self._metadata_indexes)),
        ]
        for opcode, records in groups:
            if records:
                offsets += encoded(SummaryOffset(opcode.value, start + len(summary), len(records)))
                summary += records
        offset_start = start + len(summary)
        summary += offsets
        footer_head = struct.pack("<BQQQ", Opcode.FOOTER.value, 20, start, offset_start)
        crc = zlib.crc32(footer_head, zlib.crc32(summary))
        return bytes(summary) + encoded(Footer(start, offset_start, crc)) + MCAP0_MAGIC

    def _statistics(self, chunks: list[_Chunk]) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts={channel_id: count for channel_id, count in self._totals.items() if count},
            chunk_count=len(chunks),
            message_count=self.message_count,
            message_start_time=min((chunk.first_ns for chunk in chunks), default=0),
            message_end_time=max((chunk.last_ns for chunk in chunks), default=0),
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )

    def _chunk_entries(self) -> Iterator[_Chunk]:
        """The chunks that are written, newest first."""
        end = len(self._chunks)
        while end:
            entry = _ENTRY.unpack_from(self._chunks, end - _ENTRY.size)
            start, first_ns, last_ns, data_size, raw_size, channels = entry
            end -= _ENTRY.size + channels * _COUNT.size
            counts = tuple(_COUNT.iter_unpack(self._chunks[end : end + channels * _COUNT.size]))
            yield _Chunk(start, first_ns, last_ns, data_size, raw_size, counts)

    def _take_back_chunk(self) -> None:
        """Give up the newest chunk, and whatever was written behind it."""
        chunk = next(self._chunk_entries())
        del self._chunks[len(self._chunks) - _ENTRY.size - len(chunk.counts) * _COUNT.size :]
        self._metadata_indexes = [index for index in self._metadata_indexes if index.offset < chunk.start]
        self._attachment_indexes = [index for index in self._attachment_indexes if index.offset < chunk.start]
        for channel_id, count in chunk.counts:
            self._totals[channel_id] -= count
            self.message_count -= count
            self.given_up += count
        self._cut(chunk.start)

    # -- the disk ---------------------------------------------------------------------------------------------------

    def sync(self) -> None:
        """Make what was written survive a power cut."""
        os.fsync(self._file.fileno())

    def publish(self, *, durably: bool = True) -> Path:
        """Give the finished file its name, so that it survives a power cut; the path it has now."""
        try:
            if durably:
                self.sync()
        finally:
            self._file.close()
        self.part.replace(self.path)
        if durably:
            sync_folder(self.path.parent)
        return self.path

    def close(self) -> None:
        """Let go of the file as it is, under its `.part` name."""
        self._file.close()

    def discard(self) -> None:
        """Remove the unfinished file."""
        self._file.close()
        self.part.unlink(missing_ok=True)

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) or 0 :]
        except OSError:
            self._cut(self.size)
            raise
        self.size += len(data)

    def _cut(self, size: int) -> None:
        self._file.truncate(size)
        self._file.seek(size)
        self.size = size


def sync_folder(folder: Path) -> None:
    """Make a renaming in `folder` survive a power cut; where a system can't, its file system does it by itself."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        pass
    finally:
        os.close(descriptor)


def lock_file(descriptor: int) -> bool:
    """Show that a file is being written, as long as it is open; False: another process shows that.

    Where a system has no advisory locks, an open file can't be renamed or removed by others anyway.
    """
    if sys.platform == "win32":
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        # A file system without locks.
        return True
    return True


def encoded(*records: McapRecord) -> bytes:
    """Records as they stand in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
