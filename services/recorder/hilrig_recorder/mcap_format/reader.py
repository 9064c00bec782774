"""Strict reader of MCAP files: every opcode, offset, length and checksum is checked before it is used.

All code that reads records of a file uses this module. A `RecordReader` reads from an open file or from a buffer.
"""

import zlib
from array import array
from collections.abc import Callable, Container, Iterator
from itertools import pairwise
from typing import IO, NamedTuple, overload

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, McapRecord, Metadata, MetadataIndex, Schema, Statistics

from hilrig_recorder.mcap_format.file_names import MAGIC
from hilrig_recorder.mcap_format.metadata_checks import check_numbers
from hilrig_recorder.mcap_format.records import (
    CHUNK_HEAD_BYTES,
    FOOTER_BYTES,
    MESSAGE,
    MESSAGE_FIXED_BYTES,
    MESSAGE_HEAD,
    RECORD_HEAD,
    Buffer,
    Chunk,
    ChunkIndex,
    ChunkInfo,
    DamagedError,
    Message,
    decode_chunk,
    decode_chunk_index,
    decode_chunk_info,
    decode_footer,
    decode_message_index,
    decode_record,
)


class NoMcapError(DamagedError):
    """The file is empty, or does not start with the magic bytes."""


class TruncatedError(DamagedError):
    """The file does not end with the magic bytes: it is being written, or was truncated."""


class Record(NamedTuple):
    """A record of a file."""

    offset: int
    opcode: int
    content: Buffer
    """The content, or the part that was requested."""
    length: int
    """Length of the complete content, bytes."""

    @property
    def end(self) -> int:
        """Offset after the record."""
        return self.offset + RECORD_HEAD.size + self.length


class Summary(NamedTuple):
    """Position of the summary section."""

    start: int
    """Offset; 0: the file has none."""
    end: int
    checksum: int
    """Checksum of the section and the footer; 0: none."""


class RecordReader:
    """Reads records at offsets of a file.

    Args:
        read: `read(offset, size)` returns `size` bytes of the file, or fewer at its end.
        size: size of the file, bytes.
    """

    def __init__(self, read: Callable[[int, int], Buffer], size: int) -> None:
        self.read = read
        self.size = size

    def heads(self, begin: int, end: int, limit: int | None = None) -> Iterator[Record]:
        """The records from `begin` to `end`, each with at most `limit` bytes of its content.

        Raises:
            DamagedError: the bytes are not a sequence of complete records.
        """
        at = begin
        while at < end:
            record = self.record(at, end, limit)
            yield record
            at = record.end

    def record(self, offset: int, end: int, limit: int | None = None) -> Record:
        """The record at `offset`, which must end at or before `end`.

        Raises:
            DamagedError: there is no complete record.
        """
        start = offset + RECORD_HEAD.size
        head = self.read(offset, RECORD_HEAD.size + (limit or 0)) if start <= end else b""
        if len(head) < RECORD_HEAD.size:
            raise DamagedError("truncated record", offset)
        opcode, length = RECORD_HEAD.unpack_from(head)
        if length > end - start:
            raise DamagedError(f"truncated record: {length} bytes, expected at most {end - start}", offset)
        content = self.read(start, length) if limit is None else head[RECORD_HEAD.size : RECORD_HEAD.size + length]
        return Record(offset, opcode, content, length)

    def indexed(self, opcode: Opcode, offset: int, length: int) -> Buffer:
        """Content of the record of `length` bytes (with its head) at the position that an index states.

        Raises:
            DamagedError: there is another record, or none.
        """
        if not len(MAGIC) <= offset <= self.size - length or length < RECORD_HEAD.size:
            raise DamagedError(f"index entry of {length} bytes, in a file of {self.size} bytes", offset)
        record = memoryview(self.read(offset, length))
        if len(record) < length or RECORD_HEAD.unpack_from(record) != (opcode, length - RECORD_HEAD.size):
            found, size = RECORD_HEAD.unpack_from(record) if len(record) >= RECORD_HEAD.size else (0, 0)
            raise DamagedError(
                f"the index points to opcode {found} with {size} bytes, expected {int(opcode)} ({opcode.name.lower()}) "
                f"with {length - RECORD_HEAD.size}",
                offset,
            )
        return record[RECORD_HEAD.size :]

    def indexed_record(self, index: MetadataIndex | AttachmentIndex) -> McapRecord:
        """The metadata record or attachment at the position that its index states."""
        opcode = Opcode.METADATA if isinstance(index, MetadataIndex) else Opcode.ATTACHMENT
        found = decode_record(opcode, self.indexed(opcode, index.offset, index.length), index.offset)
        assert found is not None
        if isinstance(found, Metadata):
            check_numbers(found, index.offset)
        return found

    def indexed_chunk(self, offset: int, length: int) -> bytes:
        """The decompressed records of the chunk at the position that its index states."""
        return decompress(decode_chunk(self.indexed(Opcode.CHUNK, offset, length), offset))

    def summary(self) -> Summary:
        """Position of the summary section; its checksum is not verified.

        Raises:
            NoMcapError, TruncatedError, DamagedError: begin or end of the file are not those of an MCAP file.
        """
        magic = len(MAGIC)
        if not self.size:
            raise NoMcapError("the file is empty")
        if self.read(0, magic) != MAGIC:
            raise NoMcapError("not an MCAP file (bad magic)")
        if self.size < 2 * magic or self.read(self.size - magic, magic) != MAGIC:
            raise TruncatedError("truncated (no footer)")
        end = self.size - magic - FOOTER_BYTES
        footer = decode_footer(self.read(end, FOOTER_BYTES) if end >= magic else b"", max(0, end))
        if footer.summary_start and not magic <= footer.summary_start <= end:
            raise DamagedError(f"summary section at {footer.summary_start}, expected {magic} to {end}", end)
        return Summary(footer.summary_start, end, footer.summary_crc)

    def summary_records(self, summary: Summary) -> Iterator[Record]:
        """The records of the summary section.

        Raises:
            DamagedError: the checksum does not match, or a record is damaged.
        """
        start, end, checksum = summary
        content = self.read(start, end + FOOTER_BYTES - start)
        found = zlib.crc32(content[:-4])
        if checksum not in (0, found):
            raise DamagedError(f"bad checksum of the summary section: {found:#x}, expected {checksum:#x}", start)
        section = RecordReader(lambda offset, size: content[offset - start : offset - start + size], self.size)
        return section.heads(start, end)

    def summary_items(self, summary: Summary) -> Iterator[McapRecord | ChunkIndex]:
        """The decoded records of the summary section; each chunk is before this section, and has an index.

        Raises:
            DamagedError: as `summary_records`; or an index is wrong or missing.
        """
        found = 0
        stated = None
        offsets, ends = array("Q"), array("Q")
        for offset, opcode, content, _ in self.summary_records(summary):
            if opcode == Opcode.CHUNK_INDEX:
                found += 1
                index = decode_chunk_index(content, offset)
                if not len(MAGIC) <= index.offset <= summary.start - index.length:
                    raise DamagedError(
                        f"chunk index record: {index.length} bytes at {index.offset}, expected between {len(MAGIC)} "
                        f"and {summary.start}",
                        offset,
                    )
                offsets.append(index.offset)
                ends.append(index.offset + index.length)
                yield index
                continue
            item = decode_record(opcode, content, offset)
            if isinstance(item, Statistics):
                stated = item.chunk_count
            if item is not None:
                yield item
        # Otherwise a small file could state any number of messages.
        if any(end > offset for (_, end), (offset, _) in pairwise(sorted(zip(offsets, ends, strict=True)))):
            raise DamagedError("chunk indexes overlap, or two are of the same chunk", summary.start)
        if stated not in (None, found):
            raise DamagedError(f"{found} chunk indexes, expected {stated}", summary.start)

    def check_indexes(self) -> None:
        """Check that every index in the summary section points to a record of its kind.

        Raises:
            DamagedError: one does not.
        """
        for item in self.summary_items(self.summary()):
            if isinstance(item, ChunkIndex):
                self.indexed(Opcode.CHUNK, item.offset, item.length)
            elif isinstance(item, MetadataIndex | AttachmentIndex):
                self.indexed_record(item)

    def chunk_infos(self, begin: int, end: int) -> Iterator[ChunkInfo]:
        """The infos of the chunks that hilrig wrote from `begin` to `end`, so that a writer keeps no list of them.

        Raises:
            DamagedError: the bytes from `begin` to `end` are not a sequence of complete records.
        """
        info: ChunkInfo | None = None
        counts: list[tuple[int, int]] = []
        for offset, opcode, content, length in self.heads(begin, end, CHUNK_HEAD_BYTES):
            if opcode == Opcode.CHUNK:
                if info is not None:
                    yield info._replace(counts=tuple(counts))
                info = decode_chunk_info(content, offset)
                counts.clear()
            elif opcode == Opcode.MESSAGE_INDEX:
                counts.append(decode_message_index(content, length, offset))
        if info is not None:
            yield info._replace(counts=tuple(counts))


def buffer_reader(buffer: Buffer) -> RecordReader:
    """A reader of a file in memory."""
    return RecordReader(lambda offset, size: buffer[offset : offset + size], len(buffer))


def file_reader(stream: IO[bytes]) -> RecordReader:
    """A reader of an open file."""

    def read(offset: int, size: int) -> bytes:
        stream.seek(offset)
        return stream.read(size)

    return RecordReader(read, stream.seek(0, 2))


def decompress(chunk: Chunk) -> bytes:
    """The records of a chunk; never more bytes than its header states.

    Raises:
        DamagedError: size or checksum do not match, or decompression fails.
    """
    size = chunk.uncompressed_size
    try:
        if chunk.compression == "zstd":
            stated = zstandard.frame_content_size(chunk.data)
            if stated not in (-1, size):
                raise DamagedError(f"chunk with inconsistent lengths: {stated}, expected {size}", chunk.offset)
            raw = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
        elif chunk.compression == "lz4":
            decompressor = lz4.frame.LZ4FrameDecompressor()  # type: ignore[no-untyped-call]
            raw = decompressor.decompress(bytes(chunk.data), max_length=size + 1)  # type: ignore[no-untyped-call]
        elif chunk.compression == "":
            raw = bytes(chunk.data)
        else:
            raise DamagedError(f"unknown compression {chunk.compression!r}", chunk.offset)
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise DamagedError("decompression failed", chunk.offset) from error
    if len(raw) != size or (chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc):
        raise DamagedError("checksum mismatch", chunk.offset)
    return raw


@overload
def chunk_records(raw: bytes, wanted: Container[int]) -> Iterator[Message]: ...


@overload
def chunk_records(raw: bytes) -> Iterator[Message | Schema | Channel]: ...


def chunk_records(raw: bytes, wanted: Container[int] | None = None) -> Iterator[Message | Schema | Channel]:
    """The messages of the wanted channels in a decompressed chunk; without `wanted`, all records.

    Raises:
        DamagedError: a record does not end inside the chunk.
    """
    at, end = 0, len(raw)
    last = end - MESSAGE_HEAD.size
    unpack_head, unpack_message = RECORD_HEAD.unpack_from, MESSAGE_HEAD.unpack_from
    head_size, payload_at = RECORD_HEAD.size, MESSAGE_HEAD.size
    # The constructor of a NamedTuple is a Python function that calls this one.
    new_tuple = tuple.__new__
    while at < end:
        if at <= last:
            opcode, length, channel_id, sequence, log_time, publish_time = unpack_message(raw, at)
        elif at <= end - head_size:
            opcode, length = unpack_head(raw, at)
        else:
            raise DamagedError("truncated record in a chunk", at)
        following = at + head_size + length
        if following > end:
            raise DamagedError(f"record of {length} bytes in a chunk of {end} bytes", at)
        if opcode == MESSAGE:
            if length < MESSAGE_FIXED_BYTES:
                raise DamagedError(f"message of {length} bytes, expected at least {MESSAGE_FIXED_BYTES}", at)
            if wanted is None or channel_id in wanted:
                payload = raw[at + payload_at : following]
                yield new_tuple(Message, (channel_id, sequence, log_time, publish_time, payload))
        elif opcode == 0:
            raise DamagedError("opcode 0 in a chunk", at)
        elif wanted is None:
            record = decode_record(opcode, raw[at + head_size : following], at)
            if isinstance(record, Schema | Channel):
                yield record
        at = following
