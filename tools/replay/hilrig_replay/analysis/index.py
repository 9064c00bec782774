"""Index of the recordings in a folder: caches the metadata of each, so listing ten thousand recordings is fast.

A finished recording never changes, so its entry is valid as long as size and modification time are the same. The index
is only a cache: it can be deleted at any time and is rebuilt from the files.
"""

import contextlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, MetadataIndex, Statistics

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX, UNFINISHED_SUFFIX
from hilrig_recorder.mcap_format.fsutil import open_file
from hilrig_recorder.mcap_format.reader import NoMcapError, Record, RecordReader, TruncatedError, file_reader
from hilrig_recorder.mcap_format.records import DamagedError, decode_chunk_index, decode_record
from hilrig_recorder.mcap_format.scan import MAX_BEGIN_BYTES, session_metadata
from hilrig_replay.analysis.data_quality import Reason
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.extent import Extent, state_extent
from hilrig_replay.io.isolation import EvaluationError, isolated
from hilrig_replay.io.paths import walk_recordings
from hilrig_replay.io.recording_file import DamagedRecordingError
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import HilrigError, InputError
from hilrig_schemas.topics import STATE

INDEX_NAME: Final = ".hilrig-index.json"
INDEX_VERSION: Final = 5
VERDICT_SUFFIX: Final = ".verified"
"""Suffix of the file next to a recording with the result of `hilrig verify`."""
IN_PROGRESS: Final = "recording"
"""Value of `RunEntry.ended` for a recording that is being written."""


@dataclass(frozen=True, slots=True)
class RunEntry:
    """Entry of the index for one recording."""

    path: str
    """Relative to the folder of the index."""
    size: int
    """Size of the file, bytes."""
    mtime_ns: int
    rig: str = ""
    lab: str = ""
    session: str = ""
    part: int = 1
    """Number of the segment in its session, from 1."""
    controller: str = ""
    certificate: str = ""
    """Name in the controller's certificate; empty: it had none."""
    start_wall_ns: int = 0
    """Time of the first state by the clock of its sender, ns since 1970-01-01 UTC."""
    duration_s: float = 0.0
    """Time from the first state to the last."""
    messages: int = 0
    ended: str = ""
    """How the recording ended, as recorded; `recording`: it is being written."""
    reason: str = ""
    lost_transport: int = 0
    lost_recorder: int = 0
    lost_file: int = 0
    """Number of messages that the file counts, but does not contain."""
    overruns: int = 0
    missed_steps: int = 0
    clock_steps: int = 0
    error: str = ""
    """Error that makes the file unusable; empty: no error."""
    measured: bool = False
    """Whether the next fields, up to `verified`, were measured."""
    loop_p50_ms: float | None = None
    loop_p99_ms: float | None = None
    age_p50_ms: float | None = None
    """Age of the acting torque's basis, over all steps."""
    age_p99_ms: float | None = None
    control_period_ms: float | None = None
    fit: bool | None = None
    """Whether the recording is valid for latency measurements."""
    unfit_reasons: tuple[Reason, ...] = ()
    verified: bool | None = None
    """Whether the re-simulation reproduced the states; None: not verified."""


class RunIndex:
    """Index of the recordings in a folder and its subfolders, newest first."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[str, RunEntry] = {}
        self._changed = False

    def load(self, *, rebuild: bool = False) -> list[RunEntry]:
        """Read new and changed recordings; with `rebuild` all recordings.

        Raises:
            InputError: there is no such folder.
        """
        if not self.folder.is_dir():
            defect = "expected a folder of recordings, found a file" if self.folder.exists() else "no such folder"
            raise InputError(f"{self.folder}: {defect}")
        # Entries in memory are reused, so that a folder without write permission is not read again each time.
        known = {} if rebuild else self._known or self._read()
        self._changed = rebuild
        self._known = {}
        for relative, info in walk_recordings(self.folder, (MCAP_SUFFIX, UNFINISHED_SUFFIX)):
            entry = known.get(relative)
            if entry is None or (entry.size, entry.mtime_ns) != (info.st_size, info.st_mtime_ns):
                entry = read_entry(self.folder, relative, info)
                self._changed = True
            self._known[relative] = entry
        self._changed |= len(known) != len(self._known)
        entries = [
            entry if entry.error else replace(entry, verified=read_verdict(self.folder / entry.path))
            for entry in self._known.values()
        ]
        return sorted(entries, key=lambda entry: (entry.start_wall_ns, entry.path), reverse=True)

    def measure(self, entries: list[RunEntry], on_progress: Callable[[int], None] | None = None) -> list[RunEntry]:
        """Add the loop latency to the entries; it is measured from recordings that were not measured before."""
        measured = []
        for done, entry in enumerate(entries):
            if on_progress is not None:
                on_progress(done)
            if not entry.measured and not entry.error and entry.ended != IN_PROGRESS:
                found = measure_entry(self.folder, entry)
                self._known[entry.path] = replace(found, verified=None)
                self._changed = True
                measured.append(replace(found, verified=None) if found.error else found)
            else:
                measured.append(entry)
        return measured

    def save(self) -> None:
        """Write the index if it changed; ignores a folder without write permission."""
        if not self._changed:
            return
        names = [field.name for field in fields(RunEntry)]
        rows = [list(asdict(entry).values()) for entry in self._known.values() if entry.ended != IN_PROGRESS]
        path = self.folder / INDEX_NAME
        temporary = path.with_name(f"{INDEX_NAME}.{os.getpid()}")
        with contextlib.suppress(OSError):
            try:
                temporary.write_text(json.dumps({"version": INDEX_VERSION, "fields": names, "runs": rows}))
                temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)

    def _read(self) -> dict[str, RunEntry]:
        try:
            index = json.loads((self.folder / INDEX_NAME).read_text())
            names = index["fields"]
            if index["version"] != INDEX_VERSION or names != [field.name for field in fields(RunEntry)]:
                return {}
            reasons = names.index("unfit_reasons")
            known = {}
            for row in index["runs"]:
                row[reasons] = tuple(Reason(**reason) for reason in row[reasons])
                known[row[0]] = RunEntry(*row)
            return known
        except (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError):
            # Damaged, or of another version: the index is rebuilt.
            return {}


def read_entry(folder: Path, relative: str, info: os.stat_result) -> RunEntry:
    """Entry of a file from its metadata; a defect of the file is reported in `error`."""
    blank = RunEntry(relative, info.st_size, info.st_mtime_ns, rig=Path(relative).parent.name)
    path = folder / relative
    try:
        with open_file(path) as stream:
            if relative.endswith(UNFINISHED_SUFFIX):
                entry = _with_session(blank, session_metadata(stream.read(MAX_BEGIN_BYTES)))
                return replace(entry, ended=IN_PROGRESS, reason="being written, or not yet recovered")
            return _finished_entry(blank, file_reader(stream))
    except OSError as error:
        return replace(blank, error=f"can't be read: {error.strerror}")
    except NoMcapError as error:
        return replace(blank, error=str(error))
    except TruncatedError as error:
        return replace(blank, error=f"{error}: run `hilrig recover` to complete it")
    except (DamagedError, ValueError) as error:
        # Metadata has no checksum: a damaged number is a ValueError.
        return replace(blank, error=f"damaged ({error}): run `hilrig recover`")


def measure_entry(folder: Path, entry: RunEntry) -> RunEntry:
    """Add the loop latency of a recording to its entry; damage of the file is reported in `error`."""
    path = folder / entry.path
    try:
        with isolated(path):
            report = measure(open_run(path))
    except HilrigError as error:
        # `error` is for unusable files only: for others, the list shows how the recording ended.
        damage = error.description if isinstance(error, DamagedRecordingError | EvaluationError) else ""
        return replace(entry, measured=True, fit=False, unfit_reasons=(Reason("unreadable", str(error)),), error=damage)
    loop, age = report.loop_ms, report.age_ms
    return replace(
        entry,
        measured=True,
        loop_p50_ms=None if loop is None else round(loop.p50, 6),
        loop_p99_ms=None if loop is None else round(loop.p99, 6),
        age_p50_ms=None if age is None else round(age.p50, 6),
        age_p99_ms=None if age is None else round(age.p99, 6),
        control_period_ms=None if report.control_period_ms is None else round(report.control_period_ms, 6),
        fit=report.fit,
        unfit_reasons=report.reasons,
    )


def write_verdict(path: Path, verified: bool, detail: str = "") -> None:
    """Write the result of a verification to a file next to the recording.

    Raises:
        OSError: the file can't be written.
    """
    verdict = {"verified": verified, **_identity(path), "detail": detail}
    path.with_name(path.name + VERDICT_SUFFIX).write_text(json.dumps(verdict) + "\n")


def read_verdict(path: Path) -> bool | None:
    """Result of the last verification of a recording; None: no result, or a result of another file of this name."""
    try:
        verdict = json.loads(path.with_name(path.name + VERDICT_SUFFIX).read_text())
        return bool(verdict["verified"]) if verdict.items() >= _identity(path).items() else None
    except (OSError, AttributeError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _identity(path: Path) -> dict[str, int]:
    """Size, time of modification and checksum of the summary section of a recording."""
    with open_file(path) as stream:
        info = os.fstat(stream.fileno())
        try:
            checksum = file_reader(stream).summary().checksum
        except DamagedError:
            checksum = 0
    return {"size": info.st_size, "mtime_ns": info.st_mtime_ns, "summary_crc": checksum}


def _finished_entry(blank: RunEntry, reader: RecordReader) -> RunEntry:
    summary = reader.summary()
    statistics: Statistics | None = None
    metadata_index: dict[str, MetadataIndex] = {}
    channel = 0
    chunks: list[Record] = []
    for record in reader.summary_records(summary) if summary.start else ():
        # Chunk indexes are most of the summary section of a long recording. Only the first and last are decoded.
        if record.opcode == Opcode.CHUNK_INDEX:
            chunks.append(record)
        elif record.opcode == Opcode.CHANNEL:
            item = decode_record(record.opcode, record.content, record.offset)
            if isinstance(item, Channel) and item.topic == STATE.channel:
                channel = item.id
        elif record.opcode in (Opcode.STATISTICS, Opcode.METADATA_INDEX):
            item = decode_record(record.opcode, record.content, record.offset)
            if isinstance(item, Statistics):
                statistics = item
            elif isinstance(item, MetadataIndex):
                metadata_index[item.name] = item
    if statistics is None:
        return replace(blank, error="no summary section with statistics: run `hilrig recover` to add it")
    session, trailer = (_metadata(reader, metadata_index.get(name)) for name in ("hilrig.session", "hilrig.summary"))
    written = int(trailer.get("messages", 0))
    entry = _with_session(blank, session)
    first_ns, last_ns = statistics.message_start_time, statistics.message_end_time
    extent = Extent(first_ns or entry.start_wall_ns, (last_ns - first_ns) / 1e9)
    # Damage of a chunk is reported when the recording is measured.
    with contextlib.suppress(DamagedError):
        extent = state_extent(reader, _with(channel, chunks), _with(channel, reversed(chunks)), channel) or extent
    return replace(
        entry,
        start_wall_ns=extent.start_wall_ns,
        duration_s=extent.duration_s,
        messages=statistics.message_count,
        ended=trailer.get("ended", ""),
        reason=trailer.get("reason", ""),
        lost_transport=int(trailer.get("lost_transport", 0)),
        lost_recorder=int(trailer.get("lost_recorder", 0)),
        lost_file=max(0, written - statistics.message_count),
        overruns=int(trailer.get("overruns", 0)),
        missed_steps=int(trailer.get("missed_steps", 0)),
        clock_steps=int(trailer.get("clock_steps", 0)),
        error="" if session else "not a hilrig recording",
    )


def _with(channel: int, chunks: Iterable[Record]) -> Iterator[tuple[int, int]]:
    """Offset and length of the chunks with messages of a channel, from their indexes."""
    for record in chunks:
        index = decode_chunk_index(record.content, record.offset)
        if not index.channels or channel in index.channels:
            yield index.offset, index.length


def _with_session(blank: RunEntry, session: dict[str, str]) -> RunEntry:
    return replace(
        blank,
        rig=session.get("rig", blank.rig),
        lab=session.get("lab", ""),
        session=session.get("session", ""),
        part=int(session.get("part", 1)),
        controller=session.get("controller", ""),
        certificate=session.get("certificate", ""),
        start_wall_ns=int(session.get("start_wall_ns", 0)),
    )


def _metadata(reader: RecordReader, index: MetadataIndex | None) -> dict[str, str]:
    record = None if index is None else reader.indexed_record(index)
    return dict(record.metadata) if isinstance(record, Metadata) else {}
