"""Joins the segments of one session into one file. The segments are not changed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final

from mcap.records import Attachment, Channel, Metadata

from hilrig_recorder.mcap_format.channels import CHANNELS
from hilrig_recorder.mcap_format.file_names import recovering_path
from hilrig_recorder.mcap_format.fsutil import map_file
from hilrig_recorder.mcap_format.metadata_checks import add_metadata
from hilrig_recorder.mcap_format.records import Chunk, DamagedError, Message, encode_message
from hilrig_recorder.mcap_format.scan import Damage, is_complete, read_chunk, scan
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_runtime.errors import InputError, OperationError

OVERLAP_NS: Final = 60_000_000_000
"""Messages of this time before the end of a segment are compared with those of the next one."""
_COUNTS: Final = ("lost_transport", "lost_recorder", "lost_batches", "overruns", "missed_steps", "clock_steps")
_NUMBERED: Final = ("hilrig.config", "hilrig.source", "hilrig.loss")
"""Kinds of metadata records of which a file has several, with a number from 2."""


@dataclass(slots=True)
class Segment:
    """The metadata and attachments of a segment."""

    path: Path
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)

    @property
    def number(self) -> int:
        """Number of the segment in its session."""
        return int(self.metadata["hilrig.session"].get("part", "1"))


def join(paths: Sequence[Path], path: Path) -> int:
    """Write the segments of one session as one file; return the number of messages.

    Raises:
        InputError: the files are not complete segments of one session, or `path` exists.
        OperationError: the file can't be written.
    """
    segments = sorted((_read(source) for source in paths), key=lambda segment: segment.number)
    _check(segments)
    summary = dict(segments[-1].metadata.get("hilrig.summary", {}))
    summaries = [segment.metadata.get("hilrig.summary", {}) for segment in segments]
    summary |= {name: str(sum(int(one.get(name, 0)) for one in summaries)) for name in _COUNTS}
    try:
        if path.exists():
            raise InputError(f"{path}: file exists; choose another name")
        session = Metadata("hilrig.session", {**segments[0].metadata["hilrig.session"]})
        recovering_path(path).unlink(missing_ok=True)
        writer = RecordingWriter(path, temporary_path=recovering_path(path), metadata=(session,))
        try:
            _copy_metadata(writer, segments)
            for message in _messages(segments):
                writer.add(encode_message(*message))
            writer.finish(lambda: {"hilrig.summary": summary | {"messages": str(writer.message_count)}})
            if writer.dropped_count:
                raise OperationError(f"{path}: can't be written: no space left on the disk")
            writer.publish()
        except BaseException:
            writer.discard()
            raise
    except OSError as error:
        raise OperationError(f"{path}: can't be written: {error.strerror}") from error
    return writer.message_count


def _read(path: Path) -> Segment:
    view = map_file(path)
    segment = Segment(path)
    own = {(channel.id, channel.topic) for channel in CHANNELS}
    try:
        if not is_complete(view):
            raise DamagedError("not a complete MCAP file")
        for offset, item in scan(view):
            if isinstance(item, Damage):
                raise DamagedError(item.reason, item.offset)
            if isinstance(item, Metadata):
                add_metadata(segment.metadata, item, offset)
            elif isinstance(item, Attachment):
                segment.attachments.append(item)
            elif isinstance(item, Channel) and (item.id, item.topic) not in own:
                raise InputError(
                    f"{path}: not a segment: channel {item.id} is {item.topic}; expected a hilrig recording"
                )
    except DamagedError as damage:
        raise InputError(f"{path}: damaged ({damage}): run `hilrig recover {path}` first") from damage
    if not segment.metadata.get("hilrig.session", {}).get("session"):
        raise InputError(f"{path}: not a hilrig recording: no session is recorded")
    return segment


def _check(segments: Sequence[Segment]) -> None:
    first = segments[0]
    for before, segment in pairwise(segments):
        mine, others = (one.metadata["hilrig.session"]["session"] for one in (segment, first))
        if mine != others:
            raise InputError(f"{segment.path}: of session {mine}, but {first.path} is of session {others}")
        if segment.number != before.number + 1:
            expected = f"expected segment {before.number + 1} after {before.path}"
            raise InputError(f"{segment.path}: segment {segment.number}; {expected}")


def _copy_metadata(writer: RecordingWriter, segments: Sequence[Segment]) -> None:
    """Copy each different configuration, source, loss and attachment once."""
    for kind in _NUMBERED:
        found: list[dict[str, str]] = []
        for segment in segments:
            records = (values for name, values in segment.metadata.items() if name.split(".")[:2] == kind.split("."))
            found += (values for values in records if values not in found)
        for number, values in enumerate(found, start=1):
            writer.add_metadata(f"{kind}.{number}" if number > 1 else kind, values, is_repeated=kind == _NUMBERED[0])
    recovered = [one.metadata["hilrig.recovered"] for one in segments if "hilrig.recovered" in one.metadata]
    if recovered:
        names = [name for name in recovered[0] if all(values.get(name, "x").isdecimal() for values in recovered)]
        total = {name: str(sum(int(values[name]) for values in recovered)) for name in names}
        writer.add_metadata("hilrig.recovered", recovered[0] | total)
    copied = set()
    for segment in segments:
        for item in segment.attachments:
            if (item.name, item.data) not in copied:
                copied.add((item.name, item.data))
                writer.add_attachment(
                    item.name, item.media_type, item.data, log_time=item.log_time, create_time=item.create_time
                )


def _messages(segments: Sequence[Segment]) -> Iterator[Message]:
    """The messages of all segments in order, each once."""
    before: set[tuple[int, int, int]] = set()
    for segment in segments:
        chunks = [item for _, item in scan(map_file(segment.path)) if isinstance(item, Chunk)]
        until_ns = max((chunk.last_ns for chunk in chunks), default=0) - OVERLAP_NS
        tail: set[tuple[int, int, int]] = set()
        for chunk in chunks:
            for item in read_chunk(chunk):
                if not isinstance(item, Message):
                    continue
                key = item.channel_id, item.sequence, item.publish_time
                if chunk.last_ns >= until_ns:
                    tail.add(key)
                if key not in before:
                    yield item
        before = tail
