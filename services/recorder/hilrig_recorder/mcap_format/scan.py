"""Reading an MCAP file that may be torn or damaged: every whole record in it, and what lies between.

A record whose length leads nowhere is damage; reading goes on at the next chunk that is whole, which its lengths and
its checksum prove. Nothing is guessed: a chunk whose checksum does not hold is damage from end to end.
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

from hilrig_recorder.mcap_format.summary_section import encoded

CHUNK_LIMIT: Final = 1 << 30
"""A chunk that claims to be larger, bytes uncompressed, is taken for damage."""

Buffer = bytes | memoryview

_HEAD: Final = struct.Struct("<BQ")
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
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
    """A whole chunk; times are wall clock, ns."""

    offset: int
    first_ns: int
    last_ns: int
    compression: str
    uncompressed_size: int
    uncompressed_crc: int
    data: Buffer


@dataclass(frozen=True, slots=True)
class Message:
    """One message; `record` is the whole MCAP record."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int
    record: bytes

    @property
    def data(self) -> bytes:
        """The message's bytes."""
        return self.record[_HEAD.size + _MESSAGE_HEAD.size :]


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes that hold nothing whole."""

    offset: int
    length: int
    reason: str


class DamagedError(Exception):
    """A record that does not hold what it says."""


Item = Chunk | Message | McapRecord | Damage


def scan(buffer: Buffer) -> Iterator[tuple[int, Item]]:
    """Every whole record up to the end of the data section, with its offset; damage where there is any.

    Message indexes are passed over. Chunks are given as they are: `open_chunk` checks and opens one.

    Yields:
        (offset, record): a `Chunk`, a `Message` that stands outside chunks, a record of mcap's, or `Damage`.
    """
    view = memoryview(buffer)
    end = len(view)
    offset = 0
    if bytes(view[: len(MCAP0_MAGIC)]) == MCAP0_MAGIC:
        offset = len(MCAP0_MAGIC)
    else:
        following = _next_chunk(view, 0)
        yield 0, Damage(0, following, "it does not begin as an MCAP file does")
        offset = following
    while offset < end:
        head = view[offset : offset + _HEAD.size]
        if len(head) < _HEAD.size:
            yield offset, Damage(offset, end - offset, "torn")
            return
        opcode, length = _HEAD.unpack(head)
        start, stop = offset + _HEAD.size, offset + _HEAD.size + length
        try:
            if opcode not in _OPCODES and opcode < 0x80:
                raise DamagedError("no record begins here")
            if stop > end:
                raise DamagedError("torn")
            if opcode in (Opcode.DATA_END.value, Opcode.FOOTER.value):
                # Behind the end of the data there is no chunk; where there is one, this is no end.
                if _next_chunk(view, stop) < end:
                    raise DamagedError("an end that is none")
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


def open_chunk(chunk: Chunk) -> Iterator[Message | Schema | Channel]:
    """What a chunk holds.

    Raises:
        DamagedError: its checksum does not hold, or it can't be decompressed; nothing has been yielded then.
    """
    raw = memoryview(_decompress(chunk))
    return _contents(raw)


def message_keys(chunk: Chunk) -> Iterator[tuple[int, int, int]]:
    """Channel, sequence and publish time of a chunk's messages: much quicker than `open_chunk`.

    Raises:
        DamagedError: as `open_chunk`.
    """
    raw = _decompress(chunk)
    head, message_head, size = _HEAD.unpack_from, _MESSAGE_HEAD.unpack_from, _HEAD.size
    message, offset, end = int(Opcode.MESSAGE), 0, len(raw) - size - _MESSAGE_HEAD.size
    while offset <= end:
        opcode, length = head(raw, offset)
        if opcode == message:
            channel_id, sequence, _, publish_time = message_head(raw, offset + size)
            yield channel_id, sequence, publish_time
        offset += size + length


def is_whole(buffer: Buffer) -> bool:
    """Whether a file is finished: it begins and ends as it should, and its index matches its checksum."""
    view = memoryview(buffer)
    magic, footer_size = len(MCAP0_MAGIC), _HEAD.size + 20
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
            raise DamagedError("a message index whose lengths do not agree")
        return None
    reader = _READERS.get(opcode)
    if reader is None:
        return None
    data = bytes(content)
    try:
        record: McapRecord = reader(ReadDataStream(BytesIO(data)))
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError, MemoryError) as error:
        raise DamagedError(f"a {Opcode(opcode).name.lower()} that can't be read") from error
    # Written again it must be what was read: lengths within it agree, and so does an attachment's checksum.
    if encoded(record)[_HEAD.size :] != data:
        raise DamagedError(f"a {Opcode(opcode).name.lower()} that does not hold what it says")
    return record


def _chunk(offset: int, content: memoryview) -> Chunk:
    try:
        first_ns, last_ns, size, crc, name_length = _CHUNK_HEAD.unpack_from(content)
        name_end = _CHUNK_HEAD.size + name_length
        compression = str(content[_CHUNK_HEAD.size : name_end], "ascii")
        (data_length,) = struct.unpack_from("<Q", content, name_end)
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedError("a chunk that can't be read") from error
    if name_end + 8 + data_length != len(content) or size > CHUNK_LIMIT:
        raise DamagedError("a chunk whose lengths do not agree")
    return Chunk(offset, first_ns, last_ns, compression, size, crc, content[name_end + 8 :])


def _message(content: memoryview) -> Message:
    if len(content) < _MESSAGE_HEAD.size:
        raise DamagedError("a message that is too short")
    record = _HEAD.pack(Opcode.MESSAGE.value, len(content)) + bytes(content)
    channel_id, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(content)
    return Message(channel_id, sequence, log_time, publish_time, record)


def _decompress(chunk: Chunk) -> bytes:
    try:
        if chunk.compression == "zstd":
            stated = zstandard.frame_content_size(chunk.data)
            if stated not in (-1, chunk.uncompressed_size):
                raise DamagedError("a chunk whose lengths do not agree")
            raw = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.uncompressed_size)
        elif chunk.compression == "lz4":
            raw = lz4.frame.decompress(bytes(chunk.data))  # type: ignore[attr-defined]
        elif chunk.compression == "":
            raw = bytes(chunk.data)
        else:
            raise DamagedError(f"a chunk compressed with {chunk.compression!r}, which nobody knows")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise DamagedError("a chunk that can't be decompressed") from error
    if len(raw) != chunk.uncompressed_size or (chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc):
        raise DamagedError("a chunk whose checksum does not hold")
    return raw


def _contents(raw: memoryview) -> Iterator[Message | Schema | Channel]:
    offset, end = 0, len(raw)
    while end - offset >= _HEAD.size:
        opcode, length = _HEAD.unpack_from(raw, offset)
        stop = offset + _HEAD.size + length
        if stop > end:
            return
        if opcode == Opcode.MESSAGE.value and length >= _MESSAGE_HEAD.size:
            channel_id, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(raw, offset + _HEAD.size)
            yield Message(channel_id, sequence, log_time, publish_time, bytes(raw[offset:stop]))
        elif opcode in (Opcode.SCHEMA.value, Opcode.CHANNEL.value):
            try:
                item = _record(opcode, offset, raw[offset + _HEAD.size : stop])
            except DamagedError:
                return
            if isinstance(item, Schema | Channel):
                yield item
        offset = stop


def _next_chunk(view: memoryview, offset: int) -> int:
    """Where the next whole chunk begins, from `offset` on; the end of the buffer where there is none."""
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
    head = view[offset : offset + _HEAD.size]
    if len(head) < _HEAD.size:
        return False
    length = _HEAD.unpack(head)[1]
    start = offset + _HEAD.size
    if length < _CHUNK_HEAD.size + 8 or start + length > len(view):
        return False
    try:
        _decompress(_chunk(offset, view[start : start + length]))
    except DamagedError:
        return False
    return True
