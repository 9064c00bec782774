"""Index of the runs in a folder: caches the metadata of each recording, so listing ten thousand of them is fast.

A finished recording never changes, so its entry is valid as long as size and modification time are the same. The index
is only a cache: it can be deleted at any time and is rebuilt from the files.
"""

import contextlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX, UNFINISHED_SUFFIX
from hilrig_recorder.mcap_format.fsutil import open_file
from hilrig_recorder.mcap_format.reader import NoMcapError, Record, RecordReader, TruncatedError, file_reader
from hilrig_recorder.mcap_format.records import DamagedError, decode_chunk_index
from hilrig_recorder.mcap_format.scan import MAX_BEGIN_BYTES, session_metadata
from hilrig_replay.analysis.data_quality import Reason
from hilrig_replay.grading.overlap import NO_SPAN, Span, overlapping
from hilrig_replay.io.extent import Extent, extent_of, state_range
from hilrig_replay.io.isolation import EvaluationError, isolated
from hilrig_replay.io.joined_recording import open_segments
from hilrig_replay.io.output_file import output_file
from hilrig_replay.io.paths import walk_recordings
from hilrig_replay.io.recording_file import DamagedRecordingError
from hilrig_replay.io.run import open_run
from hilrig_replay.io.segments import (
    UNKNOWN,
    FileSummary,
    RunFiles,
    Segment,
    as_files,
    group_segments,
    read_file_summary,
)
from hilrig_runtime.errors import HilrigError, InputError

INDEX_NAME: Final = ".hilrig-index.json"
INDEX_VERSION: Final = 6
_MAX_DIGITS: Final = 20
"""Digits of the largest integer of 64 bits."""
VERDICT_SUFFIX: Final = ".verified"
"""Suffix of the file next to a recording with the result of `hilrig verify`."""
_ADDED: Final = (
    "messages",
    "lost_transport",
    "lost_recorder",
    "lost_file",
    "overruns",
    "missed_steps",
    "clock_steps",
)
"""Fields that are added over the segments of a run."""
IN_PROGRESS: Final = "recording"
"""Value of `RunEntry.ended` for a recording that is being written."""


@dataclass(frozen=True, slots=True)
class RunEntry:
    """Entry of the index for one recording, or for the segments of one session."""

    path: str
    """Relative to the folder of the index; of several files the first."""
    size: int
    """Size of the files, bytes."""
    mtime_ns: int
    """Newest modification."""
    rig: str = ""
    lab: str = ""
    session: str = ""
    segment: Segment = UNKNOWN
    """Place of the file in its session."""
    segments: tuple[str, ...] = ()
    """Paths of all files, if there are several."""
    span: Span = NO_SPAN
    """When the session was recorded."""
    overlaps: tuple[str, ...] = ()
    """Sessions of the same rig at the same time: a manual recording, or of controllers in it."""
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

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of all files, relative to the folder of the index."""
        return self.segments or (self.path,)


class RunIndex:
    """Index of the runs in a folder and its subfolders, newest first."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[tuple[str, ...], RunEntry] = {}
        """Entries of all files, and of the runs of several files, by their paths."""
        self._changed = False

    def load(self, *, rebuild: bool = False) -> list[RunEntry]:
        """Read new and changed recordings, with `rebuild` all of them; return the runs.

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
            entry = known.get((relative,))
            if entry is None or (entry.size, entry.mtime_ns) != (info.st_size, info.st_mtime_ns):
                entry = read_entry(self.folder, relative, info)
                self._changed = True
            self._known[entry.paths] = entry
        runs = [self._run(paths, known) for paths in self._grouped()]
        self._changed |= len(known) != len(self._known)
        overlaps = overlapping([run.span for run in runs])
        runs = [replace(run, overlaps=sessions) for run, sessions in zip(runs, overlaps, strict=True)]
        entries = [
            entry if entry.error else replace(entry, verified=read_verdict(self._files(entry))) for entry in runs
        ]
        return sorted(entries, key=lambda entry: (entry.start_wall_ns, entry.path), reverse=True)

    def _grouped(self) -> list[tuple[str, ...]]:
        runs = group_segments({Path(path): entry.segment for (path,), entry in self._known.items()})
        return [tuple(path.as_posix() for path in files) for files in runs]

    def _run(self, paths: tuple[str, ...], known: dict[tuple[str, ...], RunEntry]) -> RunEntry:
        """The entry of a run of one or more files."""
        if len(paths) == 1:
            return self._known[paths]
        entries = [self._known[path,] for path in paths]
        size, mtime_ns = sum(entry.size for entry in entries), max(entry.mtime_ns for entry in entries)
        entry = known.get(paths)
        if entry is None or (entry.size, entry.mtime_ns) != (size, mtime_ns):
            entry = replace(_joined(self.folder, entries), segments=paths, size=size, mtime_ns=mtime_ns)
            self._changed = True
        self._known[paths] = entry
        return entry

    def _files(self, entry: RunEntry) -> RunFiles:
        return tuple(self.folder / path for path in entry.paths)

    def measure(self, entries: list[RunEntry], on_progress: Callable[[int], None] | None = None) -> list[RunEntry]:
        """Add the loop latency to the entries; it is measured from recordings that were not measured before."""
        measured = []
        for done, entry in enumerate(entries):
            if on_progress is not None:
                on_progress(done)
            if not entry.measured and not entry.error and entry.ended != IN_PROGRESS:
                found = measure_entry(entry, self._files(entry))
                self._known[entry.paths] = replace(found, verified=None)
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

    def _read(self) -> dict[tuple[str, ...], RunEntry]:
        try:
            index = _read_json(self.folder / INDEX_NAME)
            names = index["fields"]
            if index["version"] != INDEX_VERSION or names != [field.name for field in fields(RunEntry)]:
                return {}
            rows = [dict(zip(names, row, strict=True)) for row in index["runs"]]
            return {entry.paths: entry for entry in _entries_type().validate_python(rows)}
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            # Damaged, or of another version: the index is rebuilt.
            return {}


@cache
def _entries_type() -> TypeAdapter[list[RunEntry]]:
    return TypeAdapter(list[RunEntry])


def _read_json(path: Path) -> Any:
    """Content of a JSON file beside recordings, which anyone may have put there.

    Raises:
        OSError, ValueError, RecursionError: it is not a regular file with JSON of finite numbers.
    """
    with open_file(path) as file:
        return json.loads(file.read(), parse_constant=_finite, parse_float=_finite, parse_int=_integer)


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"expected a finite number, got {text}")
    return number


def _integer(text: str) -> int:
    if len(text) > _MAX_DIGITS:
        raise ValueError(f"expected at most {_MAX_DIGITS} digits, got {len(text)}")
    return int(text)


def read_entry(folder: Path, relative: str, info: os.stat_result) -> RunEntry:
    """Entry of a file from its metadata; a defect of the file is reported in `error`."""
    blank = RunEntry(relative, info.st_size, info.st_mtime_ns, rig=Path(relative).parent.name)
    path = folder / relative
    try:
        with open_file(path) as stream:
            if relative.endswith(UNFINISHED_SUFFIX):
                session = session_metadata(stream.read(MAX_BEGIN_BYTES))
                entry = _with_session(blank, session, FileSummary(metadata={"hilrig.session": session}).segment)
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


def measure_entry(entry: RunEntry, files: RunFiles) -> RunEntry:
    """Add the loop latency of a run to its entry; damage of a file is reported in `error`."""
    # Imports of the evaluation take longer than listing an indexed folder.
    from hilrig_replay.analysis.latency import measure

    try:
        with isolated(files[0]):
            report = measure(open_run(files))
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


def write_verdict(run: Path | RunFiles, verified: bool, detail: str = "") -> None:
    """Write the result of a verification to a file next to the (first) recording of the run.

    Raises:
        OSError: the recording can't be read.
        HilrigError: the file can't be written, or is itself a recording.
    """
    files = as_files(run)
    verdict = {"verified": verified, **_identity(files), "detail": detail}
    with output_file(_verdict_path(files)) as temporary:
        temporary.write_text(json.dumps(verdict) + "\n")


def read_verdict(run: Path | RunFiles) -> bool | None:
    """Result of the last verification of a run; None: no result, or a result of other files of this name."""
    files = as_files(run)
    try:
        verdict = _read_json(_verdict_path(files))
        return bool(verdict["verified"]) if verdict.items() >= _identity(files).items() else None
    except (OSError, AttributeError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _verdict_path(files: RunFiles) -> Path:
    return files[0].with_name(files[0].name + VERDICT_SUFFIX)


def _identity(files: RunFiles) -> dict[str, int | list[int]]:
    """Size, time of modification and checksum of the summary section; lists for several files."""
    sizes, times, checksums = [], [], []
    for path in files:
        with open_file(path) as stream:
            info = os.fstat(stream.fileno())
            try:
                checksums.append(file_reader(stream).summary().checksum)
            except DamagedError:
                checksums.append(0)
        sizes.append(info.st_size)
        times.append(info.st_mtime_ns)
    found = {"size": sizes, "mtime_ns": times, "summary_crc": checksums}
    return {name: numbers[0] if len(files) == 1 else numbers for name, numbers in found.items()}


def _joined(folder: Path, entries: list[RunEntry]) -> RunEntry:
    """Entry of the segments of one session, without its files."""
    first, last = entries[0], entries[-1]
    end_s = last.start_wall_ns / 1e9 + last.duration_s
    extent = Extent(first.start_wall_ns, max(0.0, end_s - first.start_wall_ns / 1e9))
    is_open = any(entry.ended == IN_PROGRESS for entry in entries)
    if not is_open:
        # Damage is reported when the run is measured.
        with contextlib.suppress(HilrigError):
            extent = open_segments([folder / entry.path for entry in entries]).extent

    total: dict[str, Any] = {name: sum(getattr(entry, name) for entry in entries) for name in _ADDED}
    return replace(
        first,
        start_wall_ns=extent.start_wall_ns,
        duration_s=extent.duration_s,
        span=first.span._replace(
            end_ns=last.span.end_ns, incarnations=(*first.span.incarnations, *last.span.incarnations)
        ),
        ended=IN_PROGRESS if is_open else last.ended,
        reason=last.reason,
        **total,
        error="; ".join(f"{Path(entry.path).name}: {entry.error}" for entry in entries if entry.error),
        measured=False,
    )


def _finished_entry(blank: RunEntry, reader: RecordReader) -> RunEntry:
    summary = read_file_summary(reader)
    statistics = summary.statistics
    if statistics is None:
        return replace(blank, error="no summary section with statistics: run `hilrig recover` to add it")
    session, trailer = (summary.metadata.get(name, {}) for name in ("hilrig.session", "hilrig.summary"))
    written = int(trailer.get("messages", 0))
    entry = _with_session(blank, session, summary.segment)
    first_ns, last_ns = statistics.message_start_time, statistics.message_end_time
    extent = Extent(first_ns or entry.start_wall_ns, (last_ns - first_ns) / 1e9)
    span = Span(entry.session, entry.rig, not entry.controller, entry.start_wall_ns, int(trailer.get("end_wall_ns", 0)))
    # Damage of a chunk is reported when the recording is measured.
    with contextlib.suppress(DamagedError):
        chunks, channel = summary.chunk_indexes, summary.state_channel
        states = state_range(reader, _with(channel, chunks), _with(channel, reversed(chunks)), channel)
        if states is not None:
            extent = extent_of(states)
            span = span._replace(incarnations=tuple(one.incarnation for one in states))
    return replace(
        entry,
        start_wall_ns=extent.start_wall_ns,
        duration_s=extent.duration_s,
        span=span,
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


def _with_session(blank: RunEntry, session: dict[str, str], segment: Segment) -> RunEntry:
    return replace(
        blank,
        rig=session.get("rig", blank.rig),
        lab=session.get("lab", ""),
        session=segment.session,
        segment=segment,
        controller=session.get("controller", ""),
        certificate=session.get("certificate", ""),
        start_wall_ns=int(session.get("start_wall_ns", 0)),
    )
