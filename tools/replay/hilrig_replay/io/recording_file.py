"""A recording file: validation, metadata, and its messages as bytes.

Chunks are read one at a time in file order, which preserves the order of each sender, so memory does not depend on the
length. For a time range, only the chunks that the file's index lists for it are read.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from mcap.records import Attachment, AttachmentIndex, Channel, McapRecord, Metadata, MetadataIndex, Schema, Statistics

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX, PART_SUFFIX
from hilrig_recorder.mcap_format.fsutil import map_file, open_file
from hilrig_recorder.mcap_format.metadata_checks import add_metadata
from hilrig_recorder.mcap_format.reader import (
    NoMcapError,
    RecordReader,
    TruncatedError,
    chunk_records,
    file_reader,
)
from hilrig_recorder.mcap_format.records import MAX_TIME_NS, Chunk, ChunkIndex, DamagedError, Message
from hilrig_recorder.mcap_format.scan import Damage, read_chunk, scan
from hilrig_replay.io.columns import RowBuffer, Rows
from hilrig_replay.io.extent import Extent, StateRange, extent_of, state_range
from hilrig_runtime.errors import InputError
from hilrig_schemas.topics import RECORDED

SCHEMA_PACKAGE: Final = "hilrig.v1"
"""Package of the message schemas that this version reads."""
MAX_CHANNELS: Final = 1000
"""Largest number of channels of a recording; those of hilrig have one a topic."""
CHUNK_DTYPE: Final = np.dtype(
    [("first_ns", "<i8"), ("last_ns", "<i8"), ("offset", "<u8"), ("length", "<u8"), ("channels", "<u8")]
)
"""One row per chunk: arrival of its first and last message, position and size in the file, and a bit mask of its
channels (bit = channel id modulo 64; 0: not known). At most one chunk per second, so an index of a day takes 4 MB."""


class DamagedRecordingError(InputError):
    """A recording whose content is damaged."""

    def __init__(self, path: Path, detail: str) -> None:
        self.description = (
            f"damaged ({detail or 'unexpected end of data'}): run `hilrig recover {path}` to save the intact messages"
        )
        """The defect and its fix, without the file name."""
        super().__init__(f"{path}: {self.description}")


@dataclass(frozen=True)
class RecordingFile:
    """A validated recording file; create it with `open_recording`."""

    path: Path
    metadata: dict[str, dict[str, str]]
    """Metadata values by record name, then by key."""
    attachment_records: tuple[Attachment, ...]
    counts: dict[str, int]
    """Number of messages by topic."""
    start_ns: int
    """Arrival of the first message at the recorder, ns, wall clock."""
    end_ns: int
    """Arrival of the last message at the recorder, ns, wall clock."""
    topics: dict[int, str]
    """Name of the topic in the topic registry, by channel id."""
    _chunks: Rows
    """In file order, fields as `CHUNK_DTYPE`."""

    def messages(
        self, topics: frozenset[str], *, from_ns: int | None = None, until_ns: int | None = None
    ) -> Iterator[Message]:
        """The messages of some topics in file order.

        Args:
            topics: names of the topics.
            from_ns: start of the range of arrival times, wall clock; None: the beginning.
            until_ns: end of the range, excluded; None: the end.

        Raises:
            InputError: the file is damaged.
        """
        wanted = {channel for channel, topic in self.topics.items() if topic in topics}
        low = -1 if from_ns is None else from_ns
        high = MAX_TIME_NS if until_ns is None else until_ns
        try:
            if not len(self._chunks):
                for record in _scan(self.path):
                    if isinstance(record, Message) and record.channel_id in wanted and low <= record.log_time < high:
                        yield record
                return
            with open_file(self.path) as stream:
                reader = file_reader(stream)
                for chunk in self._select_chunks(wanted, low, high):
                    messages = chunk_records(reader.indexed_chunk(int(chunk["offset"]), int(chunk["length"])), wanted)
                    if low <= chunk["first_ns"] and chunk["last_ns"] < high:
                        yield from messages
                    else:
                        yield from (message for message in messages if low <= message.log_time < high)
        except (DamagedError, OSError) as error:
            raise DamagedRecordingError(self.path, str(error)) from error

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files that it is read from."""
        return (self.path,)

    @cached_property
    def attachments(self) -> dict[str, bytes]:
        """Content of the attachments by name; of several with one name the last."""
        return {item.name: item.data for item in self.attachment_records}

    @property
    def extent(self) -> Extent:
        """Beginning and duration of the states; without states, or an index of them, of the arrivals.

        Raises:
            InputError: the file is damaged.
        """
        if self.states is None:
            return Extent(self.start_ns, (self.end_ns - self.start_ns) / 1e9)
        return extent_of(self.states)

    @cached_property
    def states(self) -> StateRange | None:
        """The first and the last state; None: there are no states, or no index of them.

        Raises:
            InputError: the file is damaged.
        """
        channels = [channel for channel, topic in self.topics.items() if topic == "state"]
        chunks = self._select_chunks(channels, -1, MAX_TIME_NS)
        try:
            if channels and len(chunks):
                with open_file(self.path) as stream:
                    places = [(int(chunk["offset"]), int(chunk["length"])) for chunk in chunks]
                    return state_range(file_reader(stream), places, places[::-1], channels[0])
        except (DamagedError, OSError) as error:
            raise DamagedRecordingError(self.path, str(error)) from error
        return None

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
    attachments: list[Attachment] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    """Number of messages by channel id."""
    start_ns: int = 0
    end_ns: int = 0
    chunks: RowBuffer = field(default_factory=lambda: RowBuffer(CHUNK_DTYPE))

    def add(self, record: McapRecord | Message, offset: int = 0) -> None:
        """Add a record of the data section, or a schema or channel of the summary section."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
            if len(self.channels) > MAX_CHANNELS:
                raise DamagedError(f"more than {MAX_CHANNELS} channels")
        elif isinstance(record, Metadata):
            add_metadata(self.metadata, record, offset)
        elif isinstance(record, Attachment):
            self.attachments.append(record)
        elif isinstance(record, Message):
            if not self.counts:
                self.start_ns = self.end_ns = record.log_time
            self.counts[record.channel_id] = self.counts.get(record.channel_id, 0) + 1
            self.start_ns = min(self.start_ns, record.log_time)
            self.end_ns = max(self.end_ns, record.log_time)


def open_recording(path: Path) -> RecordingFile:
    """Validate a file and read its metadata; the messages are not read.

    Raises:
        InputError: the file is missing, not a recording, truncated, damaged, or of a newer version.
    """
    try:
        with open_file(path) as stream:
            contents = _read_summary(file_reader(stream)) or _scan_contents(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a recording ({MCAP_SUFFIX}), found a folder") from None
    except OSError as error:
        raise InputError(f"{path}: can't be read: {error.strerror or error}") from error
    except NoMcapError as error:
        raise InputError(f"{path}: {error}") from error
    except TruncatedError as error:
        unfinished = "still being written, or " if path.suffix == PART_SUFFIX else ""
        raise InputError(f"{path}: {unfinished}{error}: run `hilrig recover {path}` to complete it") from error
    except DamagedError as error:
        raise DamagedRecordingError(path, str(error)) from error
    chunks = contents.chunks.drain()
    chunks = chunks[np.argsort(chunks["offset"], kind="stable")]
    topics = _topics(path, contents)
    counts = dict.fromkeys(RECORDED, 0)
    for channel, count in contents.counts.items():
        if channel in topics:
            counts[topics[channel]] += count
    return RecordingFile(
        path=path,
        metadata=contents.metadata,
        attachment_records=tuple(contents.attachments),
        counts=counts,
        start_ns=contents.start_ns,
        end_ns=contents.end_ns,
        topics=topics,
        _chunks=chunks,
    )


def _read_summary(reader: RecordReader) -> _FileContents | None:
    """Contents of the summary section at the end of a file; None: the file has no summary section."""
    summary = reader.summary()
    if not summary.start:
        return None
    contents = _FileContents()
    index: list[MetadataIndex | AttachmentIndex] = []
    for item in reader.summary_items(summary):
        if isinstance(item, ChunkIndex):
            row = item.first_ns, item.last_ns, item.offset, item.length, _bits(item.channels)
            contents.chunks.add(contents.chunks.pack(*row))
        elif isinstance(item, Schema | Channel):
            contents.add(item)
        elif isinstance(item, Statistics):
            contents.counts = item.channel_message_counts
            contents.start_ns, contents.end_ns = item.message_start_time, item.message_end_time
        elif isinstance(item, MetadataIndex | AttachmentIndex):
            index.append(item)
    for entry in index:
        contents.add(reader.indexed_record(entry), entry.offset)
    return contents


def _scan(path: Path) -> Iterator[McapRecord | Message]:
    """All records of a file, in the file and in its chunks."""
    for _, item in scan(map_file(path)):
        if isinstance(item, Damage):
            raise DamagedError(item.reason, item.offset)
        if isinstance(item, Chunk):
            yield from read_chunk(item)
        else:
            yield item


def _scan_contents(path: Path) -> _FileContents:
    """Contents of a file without a summary section (optional in MCAP), collected from all its records."""
    contents = _FileContents()
    for record in _scan(path):
        contents.add(record)
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
