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
_RECORD_HEAD: Final = struct.Struct("<BQ")


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


def encode_chunk(records: Sequence[bytes], compress: Compress) -> bytes:
    """A chunk and the message indexes that follow it, as they stand in a file.

    Args:
        records: one message or more, each a whole MCAP record (`channels.encode_message`).
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
    return b"".join(pieces)


def chunks_of(read: Callable[[int, int], bytes], begin: int, end: int) -> Iterator[ChunkNote]:
    """The chunks that stand in a file, in order. Nothing has to be kept of them while it is written.

    Args:
        read: gives so many bytes of the file, or fewer at its end, from an offset on.
        begin: where the first record stands, bytes.
        end: where the last one ends.

    Raises:
        ValueError: records do not follow each other from `begin` to `end`.
    """
    at = begin
    note: ChunkNote | None = None
    counts: list[tuple[int, int]] = []
    try:
        while at < end:
            head = read(at, _CHUNK.size)
            opcode, length = _RECORD_HEAD.unpack_from(head)
            if opcode == Opcode.CHUNK.value:
                if note is not None:
                    yield note._replace(counts=tuple(counts))
                _, _, first_ns, last_ns, raw_size, _, _, _, data_size = _CHUNK.unpack(head)
                note = ChunkNote(at, first_ns, last_ns, data_size, raw_size, ())
                counts.clear()
            elif opcode == Opcode.MESSAGE_INDEX.value:
                _, _, channel_id, size = _INDEX_HEAD.unpack_from(head)
                counts.append((channel_id, size // 16))
            at += _RECORD_HEAD.size + length
    except struct.error as error:
        raise ValueError(f"no record at {at}") from error
    if at != end:
        raise ValueError(f"a record that ends at {at}, behind {end}")
    if note is not None:
        yield note._replace(counts=tuple(counts))
