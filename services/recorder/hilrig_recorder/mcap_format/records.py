"""The records of an MCAP file: their layout, and functions that encode and decode each of them. Pure.

This module is the only place of the layout. Times are wall clock, ns. A decode function checks every length in the
record before it is used, and raises `DamagedError`.
"""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Final, NamedTuple

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
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

from hilrig_recorder.mcap_format.file_names import MAGIC

COMPRESSION: Final = "zstd"
"""Compression of the chunks that hilrig writes; `chunk.compressor` makes it, `reader.decompress` reads it."""
MAX_CHUNK_BYTES: Final = 128 << 20
"""Maximum uncompressed size of a chunk, bytes. A chunk that states a larger size is treated as damaged."""
MAX_CHUNK_RATIO: Final = 1000
"""Maximum ratio of uncompressed and compressed size of a chunk larger than `MIN_CHUNK_LIMIT`; that of states is 10."""
MIN_CHUNK_LIMIT: Final = 1 << 20
MAX_TIME_NS: Final = (1 << 63) - 1
COPY_SUFFIX: Final = ".copy"
"""End of the name of a metadata record that repeats one of the beginning of the file. The first copy has precedence."""

Buffer = bytes | memoryview

RECORD_HEAD: Final = struct.Struct("<BQ")
"""Opcode, and length of the content that follows."""
MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
"""`RECORD_HEAD`, channel id, sequence, log time, publish time; the payload follows."""
_MESSAGE_CONTENT: Final = struct.Struct("<HIQQ")
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
_INDEX_HEAD: Final = struct.Struct("<HI")
_CHUNK_INDEX_HEAD: Final = struct.Struct("<QQQQI")
_CHUNK_INDEX_TAIL: Final = struct.Struct("<QI")
_SIZES: Final = struct.Struct("<QQ")
_CHANNEL_OFFSET: Final = struct.Struct("<HQ")
_CHANNEL_AND_LOG_TIME: Final = struct.Struct("<9xH4xQ").unpack_from
_FOOTER: Final = struct.Struct("<BQQQI")
_U32: Final = struct.Struct("<I")
_U64: Final = struct.Struct("<Q")

FOOTER_BYTES: Final = _FOOTER.size
CHUNK_HEAD_BYTES: Final = _CHUNK_HEAD.size + len(COMPRESSION) + _U64.size
"""Size of the content of a chunk before its data, if its compression is `COMPRESSION`."""
_INDEX_ENTRY_BYTES: Final = 16

MESSAGE: Final = int(Opcode.MESSAGE)
"""Cached, because the lookup of an enum value takes as long as reading a message."""
MESSAGE_FIXED_BYTES: Final = MESSAGE_HEAD.size - RECORD_HEAD.size
OPCODES: Final = frozenset(opcode.value for opcode in Opcode)
_TYPES: Final[dict[int, type[McapRecord]]] = {
    Opcode.HEADER.value: Header,
    Opcode.SCHEMA.value: Schema,
    Opcode.CHANNEL.value: Channel,
    Opcode.ATTACHMENT.value: Attachment,
    Opcode.METADATA.value: Metadata,
    Opcode.STATISTICS.value: Statistics,
    Opcode.ATTACHMENT_INDEX.value: AttachmentIndex,
    Opcode.METADATA_INDEX.value: MetadataIndex,
}
_pack_message: Final = MESSAGE_HEAD.pack


class DamagedError(Exception):
    """A file or a record with inconsistent content; the problem has the value found and the one expected."""

    def __init__(self, problem: str, offset: int | None = None) -> None:
        self.problem = problem
        super().__init__(problem if offset is None else f"{problem}, at offset {offset}")


class Message(NamedTuple):
    """A message."""

    channel_id: int
    sequence: int
    log_time: int
    """Arrival at the recorder."""
    publish_time: int
    data: bytes
    """The payload."""


class MessageHead(NamedTuple):
    """Fields of a message record before its payload."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk that is not decompressed yet."""

    offset: int
    first_ns: int
    last_ns: int
    compression: str
    uncompressed_size: int
    uncompressed_crc: int
    data: Buffer


class ChunkInfo(NamedTuple):
    """The entry of a chunk in the summary section of the file."""

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


class ChunkIndex(NamedTuple):
    """Position of a chunk, from the summary section of a file."""

    first_ns: int
    last_ns: int
    offset: int
    length: int
    channels: tuple[int, ...]
    """Ids of the channels with messages in the chunk."""


# -- any record -----------------------------------------------------------------------------------------------------


def encode_records(*records: McapRecord) -> bytes:
    """Encode records of the types of the mcap library."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def decode_record(opcode: int, content: Buffer, offset: int) -> McapRecord | None:
    """Decode the content of a record to a type of the mcap library; None: another type of record.

    Raises:
        DamagedError: the content is inconsistent; `offset` is its place in the file.
    """
    kind = _TYPES.get(opcode)
    if kind is None:
        return None
    name, data = Opcode(opcode).name.lower(), bytes(content)
    try:
        record: McapRecord = kind.read(ReadDataStream(BytesIO(data)))  # type: ignore[attr-defined]
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError, MemoryError) as error:
        raise DamagedError(f"{name} record can't be decoded", offset) from error
    # Encoding must reproduce the input. This verifies the inner lengths.
    encoded = encode_records(record)[RECORD_HEAD.size :]
    if opcode == Opcode.ATTACHMENT:
        encoded, data = encoded[: -_U32.size], data[: -_U32.size]
    if encoded != data:
        raise DamagedError(f"{name} record with inconsistent lengths", offset)
    if isinstance(record, Statistics):
        first_ns, last_ns = record.message_start_time, record.message_end_time
        if not first_ns <= last_ns <= MAX_TIME_NS:
            raise DamagedError(
                f"statistics record with times {first_ns} to {last_ns}, expected increasing times up to {MAX_TIME_NS}",
                offset,
            )
        total = sum(record.channel_message_counts.values())
        if total and total != record.message_count:
            raise DamagedError(f"statistics record with {total} messages, expected {record.message_count}", offset)
    return record


def check_attachment(content: Buffer, offset: int) -> None:
    """Verify the checksum of an attachment. The analysis of a recording doesn't need it, a recovery does.

    Raises:
        DamagedError: the checksum does not match.
    """
    (stated,) = _U32.unpack_from(content, len(content) - _U32.size)
    found = zlib.crc32(content[: -_U32.size])
    if stated not in (0, found):
        raise DamagedError(f"attachment with checksum {found:#x}, expected {stated:#x}", offset)


# -- messages -------------------------------------------------------------------------------------------------------


def encode_message(channel_id: int, sequence: int, log_time: int, publish_time: int, payload: bytes) -> bytes:
    """One message record. MCAP stores the low 32 bits of the sequence number."""
    length = MESSAGE_FIXED_BYTES + len(payload)
    return _pack_message(MESSAGE, length, channel_id, sequence & 0xFFFFFFFF, log_time, publish_time) + payload


def decode_message(content: Buffer, offset: int) -> Message:
    """A message from the content of its record."""
    if len(content) < MESSAGE_FIXED_BYTES:
        raise DamagedError(f"message of {len(content)} bytes, expected at least {MESSAGE_FIXED_BYTES}", offset)
    channel_id, sequence, log_time, publish_time = _MESSAGE_CONTENT.unpack_from(content)
    return Message(channel_id, sequence, log_time, publish_time, bytes(content[MESSAGE_FIXED_BYTES:]))


def decode_message_head(record: bytes) -> MessageHead:
    """The head of a record made by `encode_message`."""
    return MessageHead(*MESSAGE_HEAD.unpack_from(record)[2:])


# -- chunks ---------------------------------------------------------------------------------------------------------


def message_entries(records: Sequence[bytes]) -> dict[int, list[int]]:
    """Log time and offset in the chunk of each message record, in one list a channel."""
    entries: dict[int, list[int]] = {}
    offset = 0
    for record in records:
        channel_id, log_time = _CHANNEL_AND_LOG_TIME(record)
        entry = entries.get(channel_id)
        if entry is None:
            entry = entries[channel_id] = []
        entry += (log_time, offset)
        offset += len(record)
    return entries


def encode_chunk_record(first_ns: int, last_ns: int, raw: bytes, data: bytes) -> bytes:
    """A chunk record; `data` is `raw` compressed with `COMPRESSION`."""
    name = COMPRESSION.encode()
    return b"".join(
        (
            RECORD_HEAD.pack(Opcode.CHUNK.value, CHUNK_HEAD_BYTES + len(data)),
            _CHUNK_HEAD.pack(first_ns, last_ns, len(raw), zlib.crc32(raw), len(name)),
            name,
            _U64.pack(len(data)),
            data,
        )
    )


def decode_chunk(content: Buffer, offset: int) -> Chunk:
    """A chunk from the content of its record."""
    info, compression, crc, data_at = _chunk_head(content, offset)
    limit = min(MAX_CHUNK_BYTES, MIN_CHUNK_LIMIT + MAX_CHUNK_RATIO * info.data_size)
    if data_at + info.data_size != len(content) or info.raw_size > limit:
        raise DamagedError(
            f"chunk with inconsistent lengths: {info.data_size} bytes of data, {info.raw_size} bytes uncompressed; "
            f"expected {len(content) - data_at}, and at most {limit}",
            offset,
        )
    return Chunk(offset, info.first_ns, info.last_ns, compression, info.raw_size, crc, content[data_at:])


def decode_chunk_info(content: Buffer, offset: int) -> ChunkInfo:
    """The info of a chunk without its counts, from the first `CHUNK_HEAD_BYTES` of its content."""
    return _chunk_head(content, offset)[0]


def _chunk_head(content: Buffer, offset: int) -> tuple[ChunkInfo, str, int, int]:
    try:
        first_ns, last_ns, raw_size, crc, name_length = _CHUNK_HEAD.unpack_from(content)
        name_end = _CHUNK_HEAD.size + name_length
        compression = str(content[_CHUNK_HEAD.size : name_end], "ascii")
        (data_size,) = _U64.unpack_from(content, name_end)
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedError("chunk header can't be decoded", offset) from error
    return ChunkInfo(offset, first_ns, last_ns, data_size, raw_size, ()), compression, crc, name_end + _U64.size


def encode_message_index(channel_id: int, entries: Sequence[int]) -> bytes:
    """A message index record, which follows its chunk; `entries` are from `message_entries`."""
    size = _U64.size * len(entries)
    head = RECORD_HEAD.pack(Opcode.MESSAGE_INDEX.value, _INDEX_HEAD.size + size)
    return head + _INDEX_HEAD.pack(channel_id, size) + struct.pack(f"<{len(entries)}Q", *entries)


def decode_message_index(content: Buffer, length: int, offset: int) -> tuple[int, int]:
    """Channel id and number of messages; `content` is the begin of the content, `length` its complete length."""
    if len(content) >= _INDEX_HEAD.size:
        channel_id, size = _INDEX_HEAD.unpack_from(content)
        if size == length - _INDEX_HEAD.size:
            return channel_id, size // _INDEX_ENTRY_BYTES
    raise DamagedError("message index with inconsistent lengths", offset)


def encode_chunk_index(chunk: ChunkInfo) -> bytes:
    """A chunk index record."""
    chunk_size = RECORD_HEAD.size + CHUNK_HEAD_BYTES + chunk.data_size
    offset = begin = chunk.start + chunk_size
    channel_offsets = b""
    for channel_id, count in chunk.counts:
        channel_offsets += _CHANNEL_OFFSET.pack(channel_id, offset)
        offset += RECORD_HEAD.size + _INDEX_HEAD.size + _INDEX_ENTRY_BYTES * count
    name = COMPRESSION.encode()
    content = (
        _CHUNK_INDEX_HEAD.pack(chunk.first_ns, chunk.last_ns, chunk.start, chunk_size, len(channel_offsets))
        + channel_offsets
        + _CHUNK_INDEX_TAIL.pack(offset - begin, len(name))
        + name
        + _SIZES.pack(chunk.data_size, chunk.raw_size)
    )
    return RECORD_HEAD.pack(Opcode.CHUNK_INDEX.value, len(content)) + content


def decode_chunk_index(content: Buffer, offset: int) -> ChunkIndex:
    """A chunk index from the content of its record."""
    try:
        first_ns, last_ns, start, length, size = _CHUNK_INDEX_HEAD.unpack_from(content)
        listed = content[_CHUNK_INDEX_HEAD.size : _CHUNK_INDEX_HEAD.size + size]
        channels = tuple(channel_id for channel_id, _ in _CHANNEL_OFFSET.iter_unpack(listed))
    except struct.error as error:
        raise DamagedError("chunk index record can't be decoded", offset) from error
    if len(listed) != size or not first_ns <= last_ns <= MAX_TIME_NS:
        raise DamagedError(
            f"chunk index record with {size} bytes of channels, times {first_ns} to {last_ns}; expected at "
            f"most {len(listed)} bytes, and increasing times up to {MAX_TIME_NS}",
            offset,
        )
    return ChunkIndex(first_ns, last_ns, start, length, channels)


# -- end of the file ------------------------------------------------------------------------------------------------


def encode_data_end() -> bytes:
    """The record after the last record of the data section."""
    return encode_records(DataEnd(0))


def encode_summary(start: int, groups: Mapping[Opcode, bytes]) -> bytes:
    """The summary section, the footer and the magic bytes.

    Args:
        start: offset of the summary section.
        groups: the encoded records of each type.
    """
    summary, offsets = b"", b""
    for opcode, records in groups.items():
        if records:
            offsets += encode_records(SummaryOffset(opcode.value, start + len(summary), len(records)))
            summary += records
    offset_start = start + len(summary)
    summary += offsets
    checksum = zlib.crc32(encode_records(Footer(start, offset_start, 0))[: -_U32.size], zlib.crc32(summary))
    return summary + encode_records(Footer(start, offset_start, checksum)) + MAGIC


def decode_footer(record: Buffer, offset: int) -> Footer:
    """The footer from its complete record."""
    if len(record) == _FOOTER.size:
        opcode, length, start, offset_start, checksum = _FOOTER.unpack(record)
        if opcode == Opcode.FOOTER.value and length == _FOOTER.size - RECORD_HEAD.size:
            return Footer(start, offset_start, checksum)
    raise DamagedError("no footer record", offset)
