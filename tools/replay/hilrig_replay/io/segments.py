"""Which files form one run: the segments of one session, in their order.

A session has several files if the recorder was restarted, a disk was full or files are rotated. They are found by the
session that is recorded in them, never by their names. A copy of a segment belongs to another run.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, MetadataIndex, Statistics

from hilrig_recorder.mcap_format.fsutil import open_file
from hilrig_recorder.mcap_format.reader import Record, RecordReader, file_reader
from hilrig_recorder.mcap_format.records import MAX_TIME_NS, DamagedError, decode_record
from hilrig_schemas.topics import STATE

RunFiles: TypeAlias = tuple[Path, ...]
"""The files of one run in their order: one, or the segments of a session."""
_READ: Final = ("hilrig.session", "hilrig.summary", "hilrig.recovered")


def as_files(run: Path | RunFiles) -> RunFiles:
    """The files of a run that is given as one file or as several."""
    return (run,) if isinstance(run, Path) else run


class Segment(NamedTuple):
    """The place of a file in its session."""

    session: str
    """Empty: not recorded."""
    first: int = 1
    """Number of the segment, from 1."""
    last: int = 1
    """Number of the last segment that was joined into this file."""
    start_ns: int = 0
    """Arrival of the first message at the recorder, wall clock, ns."""
    end_ns: int = MAX_TIME_NS
    """Arrival of the last message."""
    is_recovered: bool = False
    is_whole: bool = False
    """Whether the session began and ended in this file."""

    def excludes(self, other: "Segment") -> bool:
        """Whether both can't belong to one run, because they have the same content."""
        same_numbers = self.first <= other.last and other.first <= self.last
        # A number can be used again after the folder was replaced, by a file of a later time.
        return same_numbers and self.start_ns <= other.end_ns and other.start_ns <= self.end_ns


UNKNOWN: Final = Segment("")


@dataclass(slots=True)
class FileSummary:
    """The part of a file's summary section that does not depend on its length."""

    statistics: Statistics | None = None
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """Session, summary and recovery, by record name."""
    state_channel: int = 0
    chunk_indexes: list[Record] = field(default_factory=list)
    """Not decoded, because they are most of the section of a long recording."""

    @property
    def segment(self) -> Segment:
        """The place of the file in its session."""
        session = self.metadata.get("hilrig.session", {})
        number = int(session.get("part", 1))
        times = self.statistics
        return Segment(
            session=session.get("session", ""),
            first=number,
            last=int(session.get("last_part", number)),
            start_ns=times.message_start_time if times else 0,
            end_ns=times.message_end_time if times else MAX_TIME_NS,
            is_recovered="hilrig.recovered" in self.metadata,
            is_whole=number == 1 and self.metadata.get("hilrig.summary", {}).get("ended") == "ended",
        )


def read_file_summary(reader: RecordReader) -> FileSummary:
    """Read the properties of a file from its summary section; it is empty if the file has none.

    Raises:
        DamagedError: the file is not complete, or the section is damaged.
    """
    found = FileSummary()
    section = reader.summary()
    index: dict[str, MetadataIndex] = {}
    for record in reader.summary_records(section) if section.start else ():
        if record.opcode == Opcode.CHUNK_INDEX:
            found.chunk_indexes.append(record)
        elif record.opcode in (Opcode.CHANNEL, Opcode.STATISTICS, Opcode.METADATA_INDEX):
            item = decode_record(record.opcode, record.content, record.offset)
            if isinstance(item, Channel) and item.topic == STATE.channel:
                found.state_channel = item.id
            elif isinstance(item, Statistics):
                found.statistics = item
            elif isinstance(item, MetadataIndex):
                index[item.name] = item
    for name in _READ:
        if name in index:
            metadata = reader.indexed_record(index[name])
            assert isinstance(metadata, Metadata)
            found.metadata[name] = dict(metadata.metadata)
    return found


def read_segment(path: Path) -> Segment:
    """The place of a file in its session; without a session if it can't be read or is damaged."""
    try:
        with open_file(path) as stream:
            return read_file_summary(file_reader(stream)).segment
    except (OSError, DamagedError):
        return UNKNOWN


def group_files(paths: Iterable[Path]) -> list[RunFiles]:
    """The runs of these files, in the order of the first file of each; a file that can't be read is a run."""
    return group_segments({path: read_segment(path) for path in paths})


def group_segments(files: Mapping[Path, Segment]) -> list[RunFiles]:
    """Group files to runs, in the order of the first file of each run in `files`."""
    runs: list[list[Path]] = []
    of_session: dict[str, list[list[Path]]] = {}
    copies: dict[Segment, int] = {}
    # Segments in one folder belong together first; a recovered file has precedence over the damaged one.
    for path in sorted(files, key=lambda path: (path.parent, not files[path].is_recovered)):
        segment = files[path]
        known = of_session.setdefault(segment.session, [])
        # Each earlier file with the same content is in a run of its own.
        passed = copies.get(segment, 0) if segment.session else len(known)
        copies[segment] = passed + 1
        for run in known[passed:]:
            if not any(segment.excludes(files[other]) for other in run):
                run.append(path)
                break
        else:
            known.append([path])
            runs.append(known[-1])
    place = {path: number for number, path in enumerate(files)}
    runs.sort(key=lambda run: min(map(place.__getitem__, run)))
    return [_in_order(run, files) for run in runs]


def _in_order(run: Iterable[Path], files: Mapping[Path, Segment]) -> RunFiles:
    ordered = sorted(run, key=lambda path: files[path].first)
    numbers = [files[path].first for path in ordered]
    if len(set(numbers)) < len(numbers):
        ordered.sort(key=lambda path: files[path].start_ns)
    return tuple(ordered)
