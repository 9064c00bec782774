"""Reads MCAP files that may be truncated or damaged: yields each complete record, and each damaged range between them.

After a damaged record, reading continues at the next complete chunk, which its lengths and its checksum verify. A chunk
with a wrong checksum is skipped entirely.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Metadata, Schema

from hilrig_recorder.mcap_format.file_names import MAGIC
from hilrig_recorder.mcap_format.metadata_checks import check_numbers
from hilrig_recorder.mcap_format.reader import Record, RecordReader, buffer_reader, chunk_records, decompress
from hilrig_recorder.mcap_format.records import (
    OPCODES,
    Buffer,
    Chunk,
    DamagedError,
    Message,
    check_attachment,
    decode_chunk,
    decode_message,
    decode_message_index,
    decode_record,
)

MAX_BEGIN_BYTES: Final = 64 * 1024
"""Size of the begin of a file that contains its header and its session metadata."""
SEARCH_BYTES: Final = 64 * 1024
"""Bytes of a damaged range that are searched without a pause."""


@dataclass(frozen=True, slots=True)
class Damage:
    """A range of bytes without a complete record."""

    offset: int
    length: int
    reason: str


Item = Chunk | Message | McapRecord | Damage


def scan(buffer: Buffer, on_search: Callable[[], None] = lambda: None) -> Iterator[tuple[int, Item]]:
    """Yield each complete record up to the end of the data section, and each damaged range.

    Message indexes are skipped. Chunks are not decompressed: use `read_chunk`.

    Args:
        buffer: the file.
        on_search: called for each 64 KiB of a damaged range that are searched for the next chunk; it may raise.

    Yields:
        (offset, item): a `Chunk`, a `Message` outside chunks, a record of the mcap library, or `Damage`.
    """
    reader = buffer_reader(memoryview(buffer))
    offset = 0
    if reader.read(0, len(MAGIC)) == MAGIC:
        offset = len(MAGIC)
    else:
        following = _next_chunk(reader, 0, on_search)
        yield 0, Damage(0, following, "bad magic")
        offset = following
    while offset < reader.size:
        try:
            record = reader.record(offset, reader.size)
            following = record.end
            if record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                # No chunk follows the end of the data section. If one does, this record is damaged.
                if _next_chunk(reader, following, on_search) < reader.size:
                    raise DamagedError("data end record before the last chunk", offset)
                return
            item = _item(record)
        except DamagedError as damage:
            following = _next_chunk(reader, offset + 1, on_search)
            item = Damage(offset, following - offset, damage.problem)
        if item is not None:
            yield offset, item
        offset = following


def read_chunk(chunk: Chunk) -> Iterator[Message | Schema | Channel]:
    """Decompress a chunk and return an iterator over its records.

    Raises:
        DamagedError: the checksum does not match, or decompression fails. No record was yielded.
    """
    return chunk_records(decompress(chunk))


def is_complete(buffer: Buffer) -> bool:
    """Whether a file is finished: magic at both ends, a valid footer, and an intact summary section."""
    reader = buffer_reader(memoryview(buffer))
    try:
        summary = reader.summary()
        return bool(summary.start and list(reader.summary_items(summary)))
    except DamagedError:
        return False


def session_metadata(begin: Buffer) -> dict[str, str]:
    """The metadata record `hilrig.session` in the first `MAX_BEGIN_BYTES` of a file; empty if it is missing."""
    for _, item in scan(begin):
        if isinstance(item, Metadata) and item.name == "hilrig.session":
            return dict(item.metadata)
    return {}


def _item(found: Record) -> Item | None:
    offset, opcode, content, length = found
    if opcode == Opcode.CHUNK:
        return decode_chunk(content, offset)
    if opcode == Opcode.MESSAGE:
        return decode_message(content, offset)
    if opcode == Opcode.MESSAGE_INDEX:
        decode_message_index(content, length, offset)
        return None
    if opcode not in OPCODES and opcode < 0x80:
        raise DamagedError("unknown opcode", offset)
    record = decode_record(opcode, content, offset)
    if opcode == Opcode.ATTACHMENT:
        check_attachment(content, offset)
    if isinstance(record, Metadata):
        check_numbers(record, offset)
    return record


def _next_chunk(reader: RecordReader, offset: int, on_search: Callable[[], None]) -> int:
    """Offset of the next complete chunk at or after `offset`; the end of the file if no chunk follows."""
    while offset < reader.size:
        block = bytes(reader.read(offset, SEARCH_BYTES))
        on_search()
        at = block.find(Opcode.CHUNK)
        while at >= 0:
            try:
                record = reader.record(offset + at, reader.size)
                decompress(decode_chunk(record.content, record.offset))
            except DamagedError:
                at = block.find(Opcode.CHUNK, at + 1)
            else:
                return offset + at
        offset += len(block)
    return reader.size
