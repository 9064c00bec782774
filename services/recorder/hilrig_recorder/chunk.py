"""A chunk of a recording: messages compressed together, with the index that leads a reader to each of them. Pure."""

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import zstandard
from mcap.opcode import Opcode

CHUNK_BYTES: Final = 64 * 1024
"""No chunk is larger, uncompressed, unless a single message is."""

Compress = Callable[[bytes], bytes]

_COMPRESSION: Final = b"zstd"
# A table that stays in the first cache, and one try at each second byte: 1 to 4 % larger than at level 1, in little
# more than half the time. Compressing is the largest part of what a message costs.
_COMPRESSOR: Final = zstandard.ZstdCompressionParameters(
    window_log=16,
    chain_log=14,
    hash_log=12,
    search_log=1,
    min_match=5,
    target_length=1,
    strategy=zstandard.STRATEGY_FAST,
)

_CHUNK: Final = struct.Struct("<BQQQQII4sQ")
_INDEX_HEAD: Final = struct.Struct("<BQHI")
_CHUNK_INDEX_HEAD: Final = struct.Struct("<BQQQQQI")
_CHUNK_INDEX_TAIL: Final = struct.Struct("<QI4sQQ")
_CHANNEL_OFFSET: Final = struct.Struct("<HQ")
_CHANNEL_AND_LOG_TIME: Final = struct.Struct("<9xH4xQ").unpack_from
"""Of a message's record."""
_NOTE: Final = struct.Struct("<QqQIIB")
_COUNT: Final = struct.Struct("<HI")
_NOTES_BYTES: Final = 4096
"""So many are compressed together."""


class ChunkNote(NamedTuple):
    """What the index at a file's end needs of a chunk; times are wall clock, ns."""

    start: int
    """Offset in the file."""
    first_ns: int
    last_ns: int
    data_size: int
    """Bytes, compressed."""
    raw_size: int
    counts: tuple[tuple[int, int], ...]
    """Channel and number of its messages; their indexes follow the chunk in this order."""

    @property
    def messages(self) -> int:
        """How many there are."""
        return sum(count for _, count in self.counts)

    @property
    def end(self) -> int:
        """Offset behind it and its indexes."""
        indexes = sum(_INDEX_HEAD.size + 16 * count for _, count in self.counts)
        return self.start + _CHUNK.size + self.data_size + indexes

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


class ChunkNotes:
    """The notes of all chunks of a file, as differences, compressed: an hour of them is sixty kilobytes."""

    def __init__(self) -> None:
        self._older: list[bytes] = []
        self._recent = bytearray()
        self._end = self._last_ns = 0

    def add(self, note: ChunkNote) -> None:
        """Add the next one."""
        gap, since_last_ns, span_ns = (
            note.start - self._end,
            note.first_ns - self._last_ns,
            note.last_ns - note.first_ns,
        )
        self._recent += _NOTE.pack(gap, since_last_ns, span_ns, note.data_size, note.raw_size, len(note.counts))
        for count in note.counts:
            self._recent += _COUNT.pack(*count)
        self._end, self._last_ns = note.end, note.last_ns
        if len(self._recent) >= _NOTES_BYTES:
            self._older.append(zlib.compress(self._recent))
            self._recent.clear()

    def __iter__(self) -> Iterator[ChunkNote]:
        """All of them, in the order of the file."""
        packed = b"".join([*map(zlib.decompress, self._older), self._recent])
        at = end = last_ns = 0
        while at < len(packed):
            gap, since_last_ns, span_ns, data_size, raw_size, channels = _NOTE.unpack_from(packed, at)
            at += _NOTE.size
            counts = tuple(_COUNT.iter_unpack(packed[at : at + channels * _COUNT.size]))
            at += channels * _COUNT.size
            first_ns = last_ns + since_last_ns
            note = ChunkNote(end + gap, first_ns, first_ns + span_ns, data_size, raw_size, counts)
            end, last_ns = note.end, note.last_ns
            yield note

    def take_back(self) -> ChunkNote:
        """Remove the newest, and give it back."""
        *kept, newest = self
        self._older.clear()
        self._recent.clear()
        self._end = self._last_ns = 0
        for note in kept:
            self.add(note)
        return newest

    def __bool__(self) -> bool:
        return bool(self._older or self._recent)

    @property
    def size(self) -> int:
        """What they take in memory, bytes."""
        return sum(map(len, self._older)) + len(self._recent)


def compressor() -> Compress:
    """What compresses chunks; for one thread, and best shared by all files of it: its tables then stay in the cache."""
    return zstandard.ZstdCompressor(compression_params=_COMPRESSOR).compress


def cut(records: Sequence[bytes]) -> Iterator[Sequence[bytes]]:
    """Messages in runs that make a chunk each."""
    begin = size = 0
    for at, record in enumerate(records):
        length = len(record)
        if size + length > CHUNK_BYTES and at > begin:
            yield records[begin:at]
            begin, size = at, 0
        size += length
    if begin < len(records):
        yield records[begin:]


def encode_chunk(records: Sequence[bytes], start: int, compress: Compress) -> tuple[bytes, ChunkNote]:
    """A chunk and the message indexes that follow it, as they stand in a file at the offset `start`.

    Args:
        records: one message or more, each a whole MCAP record (`channels.encode_message`).
        start: where the chunk will stand, bytes.
        compress: see `compressor`.
    """
    indexes: dict[int, list[int]] = {}
    offset = 0
    for record in records:
        channel_id, log_time = _CHANNEL_AND_LOG_TIME(record)
        index = indexes.get(channel_id)
        if index is None:
            index = indexes[channel_id] = []
        index += (log_time, offset)
        offset += len(record)
    first_ns = min(min(index[::2]) for index in indexes.values())
    last_ns = max(max(index[::2]) for index in indexes.values())
    raw = b"".join(records)
    data = compress(raw)
    head = _CHUNK.pack(
        Opcode.CHUNK.value,
        _CHUNK.size + len(data) - 9,
        first_ns,
        last_ns,
        offset,
        zlib.crc32(raw),
        len(_COMPRESSION),
        _COMPRESSION,
        len(data),
    )
    pieces = [head, data]
    for channel_id, index in indexes.items():
        size = 8 * len(index)
        pieces.append(_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX.value, 6 + size, channel_id, size))
        pieces.append(struct.pack(f"<{len(index)}Q", *index))
    counts = tuple((channel_id, len(index) // 2) for channel_id, index in indexes.items())
    return b"".join(pieces), ChunkNote(start, first_ns, last_ns, len(data), offset, counts)
