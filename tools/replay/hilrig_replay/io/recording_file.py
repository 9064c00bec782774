"""A recording file: validation, metadata, and its messages as bytes.

Chunks are read one at a time in file order, which preserves the order of each sender, so memory does not depend on the
length. For a time range, only the chunks that the file's index lists for it are read.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Final, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    Footer,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX, PART_SUFFIX
from hilrig_replay.io.columns import RowBuffer, Rows
from hilrig_runtime.errors import InputError
from hilrig_schemas.topics import RECORDED

SCHEMA_PACKAGE: Final = "hilrig.v1"
"""Package of the message schemas that this version reads."""
_NEVER_NS: Final = (1 << 63) - 1

_RECORD_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
_FOOTER_BYTES: Final = 29
_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
_CHANNEL_OFFSET: Final = struct.Struct("<HQ")
CHUNK_DTYPE: Final = np.dtype(
    [("first_ns", "<i8"), ("last_ns", "<i8"), ("offset", "<u8"), ("length", "<u8"), ("channels", "<u8")]
)
"""One row per chunk: arrival of its first and last message, position and size in the file, and a bit mask of its
channels (bit = channel id modulo 64; 0: not known). At most one chunk per second, so an index of a day takes 4 MB."""
_MESSAGE_OPCODE: Final = Opcode.MESSAGE.value
"""Cached, because the lookup of an enum value takes as long as reading a message."""


class RawMessage(NamedTuple):
    """One message of a file; times are in ns, wall clock."""

    topic: str
    """Name of the topic in the topic registry."""
    sequence: int
    log_ns: int
    publish_ns: int
    payload: bytes


class DamagedRecordingError(InputError):
    """A recording whose content is damaged."""

    def __init__(self, path: Path, detail: str) -> None:
        self.description = (
            f"damaged ({detail or 'unexpected end of data'}): run `hilrig recover {path}` to save the intact messages"
        )
        """The defect and its fix, without the file name."""
        super().__init__(f"{path}: {self.description}")


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """A validated recording file; create it with `open_recording`."""

    path: Path
    metadata: dict[str, dict[str, str]]
    """Metadata values by record name, then by key."""
    attachments: dict[str, bytes]
    """Content of the attachments by name."""
    counts: dict[str, int]
    """Number of messages by topic."""
    start_ns: int
    """Arrival of the first message at the recorder, ns, wall clock."""
    end_ns: int
    """Arrival of the last message at the recorder, ns, wall clock."""
    _topic_of_channel: dict[int, str]
    _chunks: Rows
    """In file order, fields as `CHUNK_DTYPE`."""

    def messages(
        self, topics: frozenset[str], *, from_ns: int | None = None, until_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages of some topics in file order.

        Args:
            topics: names of the topics.
            from_ns: start of the range of arrival times, wall clock; None: the beginning.
            until_ns: end of the range, excluded; None: the end.

        Raises:
            InputError: the file is damaged.
        """
        wanted = {channel: topic for channel, topic in self._topic_of_channel.items() if topic in topics}
        low = -1 if from_ns is None else from_ns
        high = _NEVER_NS if until_ns is None else until_ns
        try:
            with self.path.open("rb") as stream:
                if len(self._chunks):
                    for chunk in self._select_chunks(wanted, low, high):
                        messages = _in_chunk(_read_chunk(stream, int(chunk["offset"]), int(chunk["length"])), wanted)
                        if low <= chunk["first_ns"] and chunk["last_ns"] < high:
                            yield from messages
                        else:
                            yield from (message for message in messages if low <= message.log_ns < high)
                else:
                    for record in StreamReader(stream, validate_crcs=True).records:
                        if (
                            isinstance(record, Message)
                            and record.channel_id in wanted
                            and low <= record.log_time < high
                        ):
                            topic = wanted[record.channel_id]
                            yield RawMessage(topic, record.sequence, record.log_time, record.publish_time, record.data)
        except (McapError, ZstdError, struct.error, ValueError, RuntimeError, OSError) as error:
            raise DamagedRecordingError(self.path, str(error)) from error

    def _select_chunks(self, channels: Iterable[int], low: int, high: int) -> Rows:
        """The chunks that may contain messages of the given channels in a time range."""
        chunks = self._chunks
        bits = np.uint64(_bits(channels))
        holds = (chunks["channels"] == 0) | (chunks["channels"] & bits != 0)
        found: Rows = chunks[(chunks["last_ns"] >= low) & (chunks["first_ns"] < high) & holds]
        return found


@dataclass(slots=True)
class _FileContents:
    """Schemas, channels, metadata, attachments and counts of a file: from its summary section, or from all records."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    """Number of messages by channel id."""
    start_ns: int = 0
    end_ns: int = 0
    chunks: RowBuffer = field(default_factory=lambda: RowBuffer(CHUNK_DTYPE))


def refuse_recording(output: Path) -> None:
    """Refuse to overwrite a recording: a file with the suffix of a recording or with the MCAP magic bytes.

    Raises:
        InputError: `output` is a recording.
    """
    try:
        with output.open("rb") as file:
            has_magic = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
    except OSError:
        # Missing or unreadable: writing the file reports the error.
        return
    if has_magic or output.name.removesuffix(PART_SUFFIX).endswith(MCAP_SUFFIX):
        raise InputError(f"{output} is a recording and is not overwritten: choose another output name")


def open_recording(path: Path) -> RecordingFile:
    """Validate a file and read its metadata; the messages are not read.

    Raises:
        InputError: the file is missing, not a recording, truncated, damaged, or of a newer version.
    """
    try:
        with path.open("rb") as stream:
            _check_ends(path, stream)
            contents = _read_summary(stream) or _scan_records(stream)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a recording (.mcap), found a folder") from None
    except OSError as error:
        raise InputError(f"{path}: can't be read: {error.strerror or error}") from error
    except (McapError, ZstdError, struct.error, ValueError, KeyError, RuntimeError, StopIteration) as error:
        raise DamagedRecordingError(path, str(error)) from error
    topic_of_channel = _topics(path, contents)
    counts = dict.fromkeys(RECORDED, 0)
    for channel, count in contents.counts.items():
        if channel in topic_of_channel:
            counts[topic_of_channel[channel]] += count
    chunks = contents.chunks.drain()
    return RecordingFile(
        path=path,
        metadata=contents.metadata,
        attachments=contents.attachments,
        counts=counts,
        start_ns=contents.start_ns,
        end_ns=contents.end_ns,
        _topic_of_channel=topic_of_channel,
        _chunks=chunks[np.argsort(chunks["offset"], kind="stable")],
    )


def _check_ends(path: Path, stream: IO[bytes]) -> None:
    head = stream.read(len(MCAP0_MAGIC))
    if not head:
        raise InputError(f"{path}: the file is empty")
    if head != MCAP0_MAGIC:
        raise InputError(f"{path}: not an MCAP file (bad magic)")
    stream.seek(-len(MCAP0_MAGIC), 2)
    if stream.tell() < len(MCAP0_MAGIC) or stream.read() != MCAP0_MAGIC:
        unfinished = "still being written, or truncated" if path.suffix == PART_SUFFIX else "truncated"
        raise InputError(f"{path}: {unfinished} (no footer): run `hilrig recover {path}` to complete it")
    stream.seek(0)


def _read_summary(stream: IO[bytes]) -> _FileContents | None:
    """Contents of the summary section at the end of a file; None: the file has no summary section."""
    stream.seek(-_FOOTER_BYTES - len(MCAP0_MAGIC), 2)
    start = Footer.read(_record(stream, Opcode.FOOTER)).summary_start
    if not start:
        return None
    contents = _FileContents()
    index: list[MetadataIndex | AttachmentIndex] = []
    stream.seek(start)
    for opcode, data in _records(stream):
        if opcode == Opcode.CHUNK_INDEX.value:
            first_ns, last_ns, offset, length, channels = _CHUNK_INDEX.unpack_from(data)
            listed = data[_CHUNK_INDEX.size : _CHUNK_INDEX.size + channels]
            bits = _bits(channel for channel, _ in _CHANNEL_OFFSET.iter_unpack(listed))
            contents.chunks.append(first_ns, last_ns, offset, length, bits)
            continue
        record = ReadDataStream(BytesIO(data))
        if opcode == Opcode.SCHEMA.value:
            schema = Schema.read(record)
            contents.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL.value:
            channel = Channel.read(record)
            contents.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS.value:
            statistics = Statistics.read(record)
            contents.counts = statistics.channel_message_counts
            contents.start_ns, contents.end_ns = statistics.message_start_time, statistics.message_end_time
        elif opcode == Opcode.METADATA_INDEX.value:
            index.append(MetadataIndex.read(record))
        elif opcode == Opcode.ATTACHMENT_INDEX.value:
            index.append(AttachmentIndex.read(record))
        elif opcode == Opcode.FOOTER.value:
            break
    for entry in index:
        stream.seek(entry.offset)
        if isinstance(entry, MetadataIndex):
            metadata = Metadata.read(_record(stream, Opcode.METADATA))
            contents.metadata[metadata.name] = dict(metadata.metadata)
        else:
            attachment = Attachment.read(_record(stream, Opcode.ATTACHMENT))
            contents.attachments[attachment.name] = attachment.data
    return contents


def _records(stream: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of the records from the current position."""
    begin = stream.tell()
    remaining = stream.seek(0, 2) - begin
    stream.seek(begin)
    while remaining >= _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
        remaining -= _RECORD_HEAD.size + length
        if remaining < 0:
            raise EndOfFile
        yield opcode, stream.read(length)


def _record(stream: IO[bytes], expected: Opcode) -> ReadDataStream:
    """Content of the record at the current position."""
    for opcode, data in _records(stream):
        if opcode == expected.value:
            return ReadDataStream(BytesIO(data))
        break
    raise McapError(f"expected a record {expected.name.lower()} at its indexed position")


def _scan_records(stream: IO[bytes]) -> _FileContents:
    """Contents of a file without a summary section (optional in MCAP), collected from all its records."""
    contents = _FileContents()
    stream.seek(0)
    for record in StreamReader(stream).records:
        if isinstance(record, Schema):
            contents.schemas[record.id] = record
        elif isinstance(record, Channel):
            contents.channels[record.id] = record
        elif isinstance(record, Metadata):
            contents.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Attachment):
            contents.attachments[record.name] = record.data
        elif isinstance(record, Message):
            if not contents.counts:
                contents.start_ns = contents.end_ns = record.log_time
            contents.counts[record.channel_id] = contents.counts.get(record.channel_id, 0) + 1
            contents.start_ns = min(contents.start_ns, record.log_time)
            contents.end_ns = max(contents.end_ns, record.log_time)
    return contents


def _topics(path: Path, contents: _FileContents) -> dict[int, str]:
    """Topic of each channel id, without channels that hilrig did not define."""
    version = contents.metadata.get("hilrig.session", {}).get("schema_version", SCHEMA_PACKAGE)
    by_channel = {topic.channel: topic for topic in RECORDED.values()}
    found = {}
    for channel in contents.channels.values():
        topic = by_channel.get(channel.topic)
        if topic is None:
            continue
        schema = contents.schemas.get(channel.schema_id)
        name = schema.name if schema is not None else "no schema"
        if name != topic.message.DESCRIPTOR.full_name:
            if not name.startswith("hilrig."):
                raise InputError(f"{path}: not a hilrig recording: its channel {channel.topic} contains {name}")
            version = name.rpartition(".")[0]
        found[channel.id] = topic.name
    if version != SCHEMA_PACKAGE:
        raise InputError(
            f"{path}: recorded with message schemas {version}, but this version reads {SCHEMA_PACKAGE}: "
            "use a newer hilrig"
        )
    return found


def _bits(channels: Iterable[int]) -> int:
    bits = 0
    for channel in channels:
        bits |= 1 << (channel & 63)
    return bits


def _read_chunk(stream: IO[bytes], offset: int, length: int) -> bytes:
    stream.seek(offset)
    record = stream.read(length)
    if len(record) != length:
        raise EndOfFile
    if record[0] != Opcode.CHUNK.value:
        raise McapError("an entry of the index does not point to a chunk")
    chunk = Chunk.read(ReadDataStream(BytesIO(record[_RECORD_HEAD.size :])))
    data, size = get_chunk_data_stream(chunk, validate_crc=True)
    return data.read(size)


def _in_chunk(data: bytes, wanted: dict[int, str]) -> Iterator[RawMessage]:
    at, end = 0, len(data)
    head, message_head, body_at = _RECORD_HEAD.unpack_from, _MESSAGE_HEAD.unpack_from, _MESSAGE_HEAD.size
    while at < end:
        opcode, length = head(data, at)
        following = at + 9 + length
        if opcode == _MESSAGE_OPCODE:
            _, _, channel, sequence, log_ns, publish_ns = message_head(data, at)
            topic = wanted.get(channel)
            if topic is not None:
                yield RawMessage(topic, sequence, log_ns, publish_ns, data[at + body_at : following])
        at = following
