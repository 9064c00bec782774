"""Reads MCAP files that may be truncated or damaged: yields each complete record, and each damaged range between them.

After a damaged record, reading continues at the next complete chunk, which its lengths and its checksum verify. A chunk
with a wrong checksum is skipped entirely.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Final

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, McapRecord, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from hilrig_recorder.mcap_format.summary_section import encode_records

MAX_CHUNK_BYTES: Final = 1 << 30
"""Maximum uncompressed size of a chunk, bytes. A chunk that states a larger size is treated as damaged."""

Buffer = bytes | memoryview

_RECORD_HEADER: Final = struct.Struct("<BQ")
_CHUNK_HEADER: Final = struct.Struct("<QQQII")
_MESSAGE_HEADER: Final = struct.Struct("<HIQQ")
_OPCODES: Final = frozenset(opcode.value for opcode in Opcode)
_READERS: Final = {
    Opcode.HEADER.value: Header.read,
    Opcode.SCHEMA.value: Schema.read,
    Opcode.CHANNEL.value: Channel.read,
    Opcode.ATTACHMENT.value: Attachment.read,
    Opcode.METADATA.value: Metadata.read,
}


@dataclass(frozen=True, slots=True)
class Chunk:
    """A complete chunk; times are wall clock, ns."""

    offset: int
    first_ns: int
    last_ns: int
    compression: str
    uncompressed_size: int
    uncompressed_crc: int
    data: Buffer


@dataclass(frozen=True, slots=True)
class Message:
    """A message; `record` is the complete MCAP record. Times are wall clock, ns."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int
    record: bytes

    @property
    def data(self) -> bytes:
        """The payload of the message."""
        return self.record[_RECORD_HEADER.size + _MESSAGE_HEADER.size :]


@dataclass(frozen=True, slots=True)
class Damage:
    """A range of bytes without a complete record."""

    offset: int
    length: int
    reason: str


class DamagedError(Exception):
    """The content of a record is inconsistent."""


Item = Chunk | Message | McapRecord | Damage


def scan(buffer: Buffer) -> Iterator[tuple[int, Item]]:
    """Yield each complete record up to the end of the data section, and each damaged range.

    Message indexes are skipped. Chunks are not decompressed: use `read_chunk`.

    Yields:
        (offset, item): a `Chunk`, a `Message` outside chunks, a record of the mcap library, or `Damage`.
    """
    view = memoryview(buffer)
    end = len(view)
    offset = 0
    if bytes(view[: len(MCAP0_MAGIC)]) == MCAP0_MAGIC:
        offset = len(MCAP0_MAGIC)
    else:
        following = _next_chunk(view, 0)
        yield 0, Damage(0, following, "bad magic")
        offset = following
    while offset < end:
        head = view[offset : offset + _RECORD_HEADER.size]
        if len(head) < _RECORD_HEADER.size:
            yield offset, Damage(offset, end - offset, "truncated record")
            return
        opcode, length = _RECORD_HEADER.unpack(head)
        start, stop = offset + _RECORD_HEADER.size, offset + _RECORD_HEADER.size + length
        try:
            if opcode not in _OPCODES and opcode < 0x80:
                raise DamagedError("unknown opcode")
            if stop > end:
                raise DamagedError("truncated record")
            if opcode in (Opcode.DATA_END.value, Opcode.FOOTER.value):
                # No chunk follows the end of the data section. If one does, this record is damaged.
                if _next_chunk(view, stop) < end:
                    raise DamagedError("data end record before the last chunk")
                return
            item = _record(opcode, offset, view[start:stop])
        except DamagedError as damage:
            following = _next_chunk(view, offset + 1)
            yield offset, Damage(offset, following - offset, str(damage))
            offset = following
            continue
        if item is not None:
            yield offset, item
        offset = stop


def read_chunk(chunk: Chunk) -> Iterator[Message | Schema | Channel]:
    """Decompress a chunk and return an iterator over its records.

    Raises:
        DamagedError: the checksum does not match, or decompression fails. No record was yielded.
    """
    raw = memoryview(_decompress(chunk))
    return _chunk_records(raw)


def read_message_keys(chunk: Chunk) -> Iterator[tuple[int, int, int]]:
    """Yield channel id, sequence and publish time of each message of a chunk, much faster than `read_chunk`.

    Raises:
        DamagedError: as in `read_chunk`.
    """
    raw = _decompress(chunk)
    record_header, message_header, size = _RECORD_HEADER.unpack_from, _MESSAGE_HEADER.unpack_from, _RECORD_HEADER.size
    message, offset, end = int(Opcode.MESSAGE), 0, len(raw) - size - _MESSAGE_HEADER.size
    while offset <= end:
        opcode, length = record_header(raw, offset)
        if opcode == message:
            channel_id, sequence, _, publish_time = message_header(raw, offset + size)
            yield channel_id, sequence, publish_time
        offset += size + length


def is_complete(buffer: Buffer) -> bool:
    """Whether a file is finished: magic at both ends, a valid footer, and a summary that matches its checksum."""
    view = memoryview(buffer)
    magic, footer_size = len(MCAP0_MAGIC), _RECORD_HEADER.size + 20
    if len(view) < 2 * magic + footer_size or view[:magic] != MCAP0_MAGIC or view[-magic:] != MCAP0_MAGIC:
        return False
    footer_at = len(view) - magic - footer_size
    opcode, length, summary_start, _, crc = struct.unpack_from("<BQQQI", view, footer_at)
    if opcode != Opcode.FOOTER.value or length != 20 or not 0 < summary_start <= footer_at:
        return False
    return bool(crc == 0 or zlib.crc32(view[summary_start : len(view) - magic - 4]) == crc)


def _record(opcode: int, offset: int, content: memoryview) -> Item | None:
    if opcode == Opcode.CHUNK.value:
        return _chunk(offset, content)
    if opcode == Opcode.MESSAGE.value:
        return _message(content)
    if opcode == Opcode.MESSAGE_INDEX.value:
        if len(content) < 6 or struct.unpack_from("<I", content, 2)[0] != len(content) - 6:
            raise DamagedError("message index with inconsistent lengths")
        return None
    reader = _READERS.get(opcode)
    if reader is None:
        return None
    data = bytes(content)
    try:
        record: McapRecord = reader(ReadDataStream(BytesIO(data)))
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError, MemoryError) as error:
        raise DamagedError(f"{Opcode(opcode).name.lower()} record can't be decoded") from error
    # Encoding must reproduce the input. This verifies the inner lengths and the checksum of an attachment.
    if encode_records(record)[_RECORD_HEADER.size :] != data:
        raise DamagedError(f"{Opcode(opcode).name.lower()} record with inconsistent lengths or wrong checksum")
    return record


def _chunk(offset: int, content: memoryview) -> Chunk:
    try:
        first_ns, last_ns, size, crc, name_length = _CHUNK_HEADER.unpack_from(content)
        name_end = _CHUNK_HEADER.size + name_length
        compression = str(content[_CHUNK_HEADER.size : name_end], "ascii")
        (data_length,) = struct.unpack_from("<Q", content, name_end)
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedError("chunk header can't be decoded") from error
    if name_end + 8 + data_length != len(content) or size > MAX_CHUNK_BYTES:
        raise DamagedError("chunk with inconsistent lengths")
    return Chunk(offset, first_ns, last_ns, compression, size, crc, content[name_end + 8 :])


def _message(content: memoryview) -> Message:
    if len(content) < _MESSAGE_HEADER.size:
        raise DamagedError("message record is too short")
    record = _RECORD_HEADER.pack(Opcode.MESSAGE.value, len(content)) + bytes(content)
    channel_id, sequence, log_time, publish_time = _MESSAGE_HEADER.unpack_from(content)
    return Message(channel_id, sequence, log_time, publish_time, record)


def _decompress(chunk: Chunk) -> bytes:
    try:
        if chunk.compression == "zstd":
            stated = zstandard.frame_content_size(chunk.data)
            if stated not in (-1, chunk.uncompressed_size):
                raise DamagedError("chunk with inconsistent lengths")
            raw = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.uncompressed_size)
        elif chunk.compression == "lz4":
            raw = lz4.frame.decompress(bytes(chunk.data))  # type: ignore[attr-defined]
        elif chunk.compression == "":
            raw = bytes(chunk.data)
        else:
            raise DamagedError(f"unknown compression {chunk.compression!r}")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise DamagedError("decompression failed") from error
    if len(raw) != chunk.uncompressed_size or (chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc):
        raise DamagedError("checksum mismatch")
    return raw


def _chunk_records(raw: memoryview) -> Iterator[Message | Schema | Channel]:
    offset, end = 0, len(raw)
    while end - offset >= _RECORD_HEADER.size:
        opcode, length = _RECORD_HEADER.unpack_from(raw, offset)
        stop = offset + _RECORD_HEADER.size + length
        if stop > end:
            return
        if opcode == Opcode.MESSAGE.value and length >= _MESSAGE_HEADER.size:
            channel_id, sequence, log_time, publish_time = _MESSAGE_HEADER.unpack_from(
                raw, offset + _RECORD_HEADER.size
            )
            yield Message(channel_id, sequence, log_time, publish_time, bytes(raw[offset:stop]))
        elif opcode in (Opcode.SCHEMA.value, Opcode.CHANNEL.value):
            try:
                item = _record(opcode, offset, raw[offset + _RECORD_HEADER.size : stop])
            except DamagedError:
                return
            if isinstance(item, Schema | Channel):
                yield item
        offset = stop


def _next_chunk(view: memoryview, offset: int) -> int:
    """Offset of the next complete chunk at or after `offset`; the end of the buffer if no chunk follows."""
    end = len(view)
    window = 1 << 20
    while offset < end:
        block = bytes(view[offset : offset + window])
        at = block.find(Opcode.CHUNK.value)
        while at >= 0:
            if _is_chunk(view, offset + at):
                return offset + at
            at = block.find(Opcode.CHUNK.value, at + 1)
        offset += len(block)
    return end


def _is_chunk(view: memoryview, offset: int) -> bool:
    head = view[offset : offset + _RECORD_HEADER.size]
    if len(head) < _RECORD_HEADER.size:
        return False
    length = _RECORD_HEADER.unpack(head)[1]
    start = offset + _RECORD_HEADER.size
    if length < _CHUNK_HEADER.size + 8 or start + length > len(view):
        return False
    try:
        _decompress(_chunk(offset, view[start : start + length]))
    except DamagedError:
        return False
    return True
