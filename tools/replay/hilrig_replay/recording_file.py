"""A recording as a file: is it one, what does it say of itself, and its messages as bytes.

Chunks are read one at a time in the order of the file, which is each sender's order, so memory does not depend on
the length. Where a range of time is asked for, the file's index tells which chunks to read.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from hilrig_runtime.errors import InputError
from hilrig_schemas.topics import RECORDED

SCHEMA_PACKAGE: Final = "hilrig.v1"
"""The messages that this version reads."""
PART_SUFFIX: Final = ".part"

_RECORD_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
_MESSAGE: Final = Opcode.MESSAGE.value
"""Looked up once: an enumeration's value costs as much as reading a message."""


class RawMessage(NamedTuple):
    """One message of a file; times are wall clock, ns."""

    topic: str
    """Name of its topic in the registry."""
    sequence: int
    log_ns: int
    publish_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """A recording that was found to be one; open it with `open_recording`."""

    path: Path
    metadata: dict[str, dict[str, str]]
    """By name, then by key."""
    attachments: dict[str, bytes]
    """By name."""
    counts: dict[str, int]
    """Messages of each topic."""
    start_ns: int
    """Arrival of the first message at the recorder, ns, wall clock."""
    end_ns: int
    """Arrival of the last, ns, wall clock."""
    _topic_of_channel: dict[int, str]
    _chunks: tuple[ChunkIndex, ...]

    def messages(
        self, topics: frozenset[str], *, from_ns: int | None = None, until_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages of some topics in the order of the file; a range is of their arrival, its end excluded.

        Raises:
            InputError: the file is damaged.
        """
        wanted = {channel: topic for channel, topic in self._topic_of_channel.items() if topic in topics}
        low = -1 if from_ns is None else from_ns
        high = (1 << 64) if until_ns is None else until_ns
        try:
            with self.path.open("rb") as stream:
                if self._chunks:
                    for index in self._chunks:
                        if index.message_end_time < low or index.message_start_time >= high:
                            continue
                        if index.message_index_offsets and wanted.keys().isdisjoint(index.message_index_offsets):
                            continue
                        messages = _in_chunk(_read_chunk(stream, index), wanted)
                        if low <= index.message_start_time and index.message_end_time < high:
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
            raise damaged(self.path, str(error)) from error


def open_recording(path: Path) -> RecordingFile:
    """Read what a file says of itself; its messages stay on the disk.

    Raises:
        InputError: there is no such file, it is no recording, it is torn, or a newer hilrig wrote it.
    """
    try:
        with path.open("rb") as stream:
            _check_ends(path, stream)
            reader = SeekingReader(stream, validate_crcs=True)
            summary = reader.get_summary() or _summary_by_reading(path)
            metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
            attachments = {record.name: record.data for record in reader.iter_attachments()}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: a folder, where a recording (.mcap) was expected") from None
    except OSError as error:
        raise InputError(f"{path}: can't be read: {error.strerror or error}") from error
    except (McapError, ZstdError, struct.error, ValueError, KeyError, RuntimeError, StopIteration) as error:
        raise damaged(path, str(error)) from error
    topic_of_channel = _topics(path, summary, metadata)
    counts = dict.fromkeys(RECORDED, 0)
    statistics = summary.statistics
    if statistics is not None:
        for channel, count in statistics.channel_message_counts.items():
            if channel in topic_of_channel:
                counts[topic_of_channel[channel]] += count
    return RecordingFile(
        path=path,
        metadata=metadata,
        attachments=attachments,
        counts=counts,
        start_ns=statistics.message_start_time if statistics else 0,
        end_ns=statistics.message_end_time if statistics else 0,
        _topic_of_channel=topic_of_channel,
        _chunks=tuple(sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)),
    )


def damaged(path: Path, detail: str) -> InputError:
    """What to say of a file whose inside is not what it should be."""
    return InputError(f"{path}: damaged ({detail or 'it ends too early'}): `hilrig recover {path}` saves what is whole")


def _check_ends(path: Path, stream: IO[bytes]) -> None:
    head = stream.read(len(MCAP0_MAGIC))
    if not head:
        raise InputError(f"{path}: empty: there is nothing in this file")
    if head != MCAP0_MAGIC:
        raise InputError(f"{path}: no MCAP file: its first bytes are not those of one")
    stream.seek(-len(MCAP0_MAGIC), 2)
    if stream.tell() < len(MCAP0_MAGIC) or stream.read() != MCAP0_MAGIC:
        unfinished = "still being written, or torn" if path.suffix == PART_SUFFIX else "torn"
        raise InputError(f"{path}: {unfinished}: it has no end; `hilrig recover {path}` makes a whole file of it")
    stream.seek(0)


def _summary_by_reading(path: Path) -> Summary:
    """The summary of a file that has none: a valid MCAP file may leave it out."""
    summary = Summary()
    counts: dict[int, int] = {}
    times: list[int] = []
    with path.open("rb") as stream:
        for record in StreamReader(stream).records:
            if isinstance(record, Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, Channel):
                summary.channels[record.id] = record
            elif isinstance(record, Message):
                counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
                times = (
                    [min(times[0], record.log_time), max(times[1], record.log_time)]
                    if times
                    else [
                        record.log_time,
                        record.log_time,
                    ]
                )
    start, end = times or (0, 0)
    summary.statistics = Statistics(
        attachment_count=0,
        channel_count=len(summary.channels),
        channel_message_counts=counts,
        chunk_count=0,
        message_count=sum(counts.values()),
        message_start_time=start,
        message_end_time=end,
        metadata_count=0,
        schema_count=len(summary.schemas),
    )
    return summary


def _topics(path: Path, summary: Summary, metadata: dict[str, dict[str, str]]) -> dict[int, str]:
    """Topic of each channel id; channels that are not ours are left out."""
    version = metadata.get("hilrig.session", {}).get("schema_version", SCHEMA_PACKAGE)
    by_channel = {topic.channel: topic for topic in RECORDED.values()}
    found = {}
    for channel in summary.channels.values():
        topic = by_channel.get(channel.topic)
        if topic is None:
            continue
        schema = summary.schemas.get(channel.schema_id)
        name = schema.name if schema is not None else "no schema"
        if name != topic.message.DESCRIPTOR.full_name:
            if not name.startswith("hilrig."):
                raise InputError(f"{path}: no recording of hilrig: its channel {channel.topic} holds {name}")
            version = name.rpartition(".")[0]
        found[channel.id] = topic.name
    if version != SCHEMA_PACKAGE:
        raise InputError(
            f"{path}: recorded with messages {version}, and this hilrig reads {SCHEMA_PACKAGE}: use a newer hilrig"
        )
    return found


def _read_chunk(stream: IO[bytes], index: ChunkIndex) -> bytes:
    stream.seek(index.chunk_start_offset)
    record = stream.read(index.chunk_length)
    if len(record) != index.chunk_length:
        raise EndOfFile
    if record[0] != Opcode.CHUNK.value:
        raise McapError("the index points to something that is no chunk")
    chunk = Chunk.read(ReadDataStream(BytesIO(record[_RECORD_HEAD.size :])))
    data, size = get_chunk_data_stream(chunk, validate_crc=True)
    return data.read(size)


def _in_chunk(data: bytes, wanted: dict[int, str]) -> Iterator[RawMessage]:
    at, end = 0, len(data)
    head, message_head, body_at = _RECORD_HEAD.unpack_from, _MESSAGE_HEAD.unpack_from, _MESSAGE_HEAD.size
    while at < end:
        opcode, length = head(data, at)
        following = at + 9 + length
        if opcode == _MESSAGE:
            _, _, channel, sequence, log_ns, publish_ns = message_head(data, at)
            topic = wanted.get(channel)
            if topic is not None:
                yield RawMessage(topic, sequence, log_ns, publish_ns, data[at + body_at : following])
        at = following
