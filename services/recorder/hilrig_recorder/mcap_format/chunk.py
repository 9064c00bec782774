"""Encodes chunks of a recording: compressed blocks of messages, each with its message index. Pure."""

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import zstandard
from mcap.opcode import Opcode

CHUNK_BYTES: Final = 64 * 1024
"""Maximum uncompressed size of a chunk; only a single larger message exceeds it."""

Compress = Callable[[bytes], bytes]

_COMPRESSION: Final = b"zstd"
# The hash table fits into the L1 cache, and only every second byte is searched. Files are 1 to 4 % larger than at level
# 1, in little more than half the time. Compression is the largest part of the cost of a message.
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
_INDEX_HEADER: Final = struct.Struct("<BQHI")
_CHUNK_INDEX_HEADER: Final = struct.Struct("<BQQQQQI")
_CHUNK_INDEX_TAIL: Final = struct.Struct("<QI4sQQ")
_CHANNEL_OFFSET: Final = struct.Struct("<HQ")
_CHANNEL_AND_LOG_TIME: Final = struct.Struct("<9xH4xQ").unpack_from
"""Reads channel id and log time of a message record."""
_RECORD_HEADER: Final = struct.Struct("<BQ")


class ChunkInfo(NamedTuple):
    """The entry of a chunk in the summary section of the file; times are wall clock, ns."""

    start: int
    """Offset in the file."""
    first_ns: int
    last_ns: int
    data_size: int
    """Compressed size, bytes."""
    raw_size: int
    """Uncompressed size, bytes."""
    counts: tuple[tuple[int, int], ...]
    """(channel id, number of messages), in the order of the message indexes that follow the chunk."""

    @property
    def messages(self) -> int:
        """Number of messages."""
        return sum(count for _, count in self.counts)

    def index_record(self) -> bytes:
        """The chunk index record."""
        chunk_size = _CHUNK.size + self.data_size
        offset = self.start + chunk_size
        channel_offsets = b""
        for channel_id, count in self.counts:
            channel_offsets += _CHANNEL_OFFSET.pack(channel_id, offset)
            offset += _INDEX_HEADER.size + 16 * count
        head = _CHUNK_INDEX_HEADER.pack(
            Opcode.CHUNK_INDEX.value,
            _CHUNK_INDEX_HEADER.size + len(channel_offsets) + _CHUNK_INDEX_TAIL.size - 9,
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
    """A function that compresses chunks, for use in one thread.

    All files of a thread should share it: its tables then stay in the CPU cache.
    """
    return zstandard.ZstdCompressor(compression_params=_COMPRESSOR).compress


def split_into_chunks(records: Sequence[bytes]) -> Iterator[Sequence[bytes]]:
    """Split message records into groups that fit into one chunk each."""
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
    """Encode a chunk record and the message index records that follow it in a file.

    Args:
        records: one or more complete MCAP message records (`channels.encode_message`).
        compress: a function made by `compressor`.
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
        pieces.append(_INDEX_HEADER.pack(Opcode.MESSAGE_INDEX.value, 6 + size, channel_id, size))
        pieces.append(struct.pack(f"<{len(index)}Q", *index))
    return b"".join(pieces)


def read_chunk_infos(read: Callable[[int, int], bytes], begin: int, end: int) -> Iterator[ChunkInfo]:
    """Read the chunk infos back from a file, in order, so that a writer keeps no list of its chunks.

    Args:
        read: `read(offset, size)` returns `size` bytes of the file, or fewer at its end.
        begin: offset of the first record, bytes.
        end: offset after the last record, bytes.

    Raises:
        ValueError: the bytes from `begin` to `end` are not a sequence of complete records.
    """
    at = begin
    info: ChunkInfo | None = None
    counts: list[tuple[int, int]] = []
    try:
        while at < end:
            head = read(at, _CHUNK.size)
            opcode, length = _RECORD_HEADER.unpack_from(head)
            if opcode == Opcode.CHUNK.value:
                if info is not None:
                    yield info._replace(counts=tuple(counts))
                _, _, first_ns, last_ns, raw_size, _, _, _, data_size = _CHUNK.unpack(head)
                info = ChunkInfo(at, first_ns, last_ns, data_size, raw_size, ())
                counts.clear()
            elif opcode == Opcode.MESSAGE_INDEX.value:
                _, _, channel_id, size = _INDEX_HEADER.unpack_from(head)
                counts.append((channel_id, size // 16))
            at += _RECORD_HEADER.size + length
    except struct.error as error:
        raise ValueError(f"no record at offset {at}") from error
    if at != end:
        raise ValueError(f"the last record ends at offset {at}, after the end {end}")
    if info is not None:
        yield info._replace(counts=tuple(counts))
