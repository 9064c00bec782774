"""The list of recordings in a folder: what each says of itself, kept in an index that makes ten thousand quick.

A finished recording never changes, so what was read of it once holds as long as its size and time are the same. The
index is a help and nothing more: it can be deleted at any time and is made again from the files.
"""

import contextlib
import json
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Metadata, MetadataIndex, Statistics
from mcap.writer import MCAP0_MAGIC

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX, UNFINISHED_SUFFIX
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.recording_file import DamagedRecordingError
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import HilrigError, InputError

INDEX_NAME: Final = ".hilrig-index.json"
INDEX_VERSION: Final = 3
VERDICT_SUFFIX: Final = ".verified"
"""What `hilrig verify` found stands beside a recording, in a file of the recording's name and this."""
RECORDING: Final = "recording"
"""How a recording that is being written "ended"."""

_HEAD: Final = struct.Struct("<BQ")
_FOOTER: Final = struct.Struct("<BQQQI")
_TAIL_BYTES: Final = 64 * 1024


@dataclass(frozen=True, slots=True)
class RunEntry:
    """What the list says of one recording."""

    path: str
    """Relative to the folder that is listed."""
    size: int
    """Bytes."""
    mtime_ns: int
    rig: str = ""
    lab: str = ""
    session: str = ""
    part: int = 1
    """Which file of its session it is, from 1."""
    controller: str = ""
    start_wall_ns: int = 0
    """Arrival of the first message, ns since 1970-01-01 UTC."""
    duration_s: float = 0.0
    messages: int = 0
    ended: str = ""
    """How it ended, one word or two; `recording`: it has not yet."""
    reason: str = ""
    lost_transport: int = 0
    lost_recorder: int = 0
    lost_file: int = 0
    """Messages that were in it before it was damaged."""
    overruns: int = 0
    missed_steps: int = 0
    clock_steps: int = 0
    trouble: str = ""
    """Why the file can't be used; empty: it can."""
    measured: bool = False
    """Whether the four below were looked for."""
    loop_p50_ms: float | None = None
    loop_p99_ms: float | None = None
    fit: bool | None = None
    """Whether its latencies can be relied on."""
    unfit_reasons: tuple[str, ...] = ()
    verified: bool | None = None
    """Whether re-simulation gave the same states; None: nobody tried."""


class RunIndex:
    """The recordings below a folder, newest first."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[str, RunEntry] = {}
        self._changed = False

    def load(self, *, rebuild: bool = False) -> list[RunEntry]:
        """Read what is new below the folder; with `rebuild` everything.

        Raises:
            InputError: there is no such folder.
        """
        if not self.folder.is_dir():
            what = "a file, where a folder of recordings was expected" if self.folder.exists() else "no such folder"
            raise InputError(f"{self.folder}: {what}")
        # What was read before holds also where the folder can't be written.
        known = {} if rebuild else self._known or self._read()
        self._changed = rebuild
        self._known = {}
        for relative, info in _walk(self.folder):
            entry = known.get(relative)
            if entry is None or (entry.size, entry.mtime_ns) != (info.st_size, info.st_mtime_ns):
                entry = read_entry(self.folder, relative, info)
                self._changed = True
            self._known[relative] = entry
        self._changed |= len(known) != len(self._known)
        entries = [replace(entry, verified=read_verdict(self.folder / entry.path)) for entry in self._known.values()]
        return sorted(entries, key=lambda entry: (entry.start_wall_ns, entry.path), reverse=True)

    def measure(self, entries: list[RunEntry], on_progress: Callable[[int], None] | None = None) -> list[RunEntry]:
        """The same entries with the loop's latency, read from the recordings where it was not looked for before."""
        measured = []
        for done, entry in enumerate(entries):
            if on_progress is not None:
                on_progress(done)
            if not entry.measured and not entry.trouble and entry.ended != RECORDING:
                found = measure_entry(self.folder, entry)
                self._known[entry.path] = replace(found, verified=None)
                self._changed = True
                measured.append(found)
            else:
                measured.append(entry)
        return measured

    def save(self) -> None:
        """Keep what was read, if it changed; a folder that can't be written is read again next time."""
        if not self._changed:
            return
        names = [field.name for field in fields(RunEntry)]
        rows = [list(asdict(entry).values()) for entry in self._known.values() if entry.ended != RECORDING]
        path = self.folder / INDEX_NAME
        draft = path.with_name(f"{INDEX_NAME}.{os.getpid()}")
        with contextlib.suppress(OSError):
            try:
                draft.write_text(json.dumps({"version": INDEX_VERSION, "fields": names, "runs": rows}))
                draft.replace(path)
            finally:
                draft.unlink(missing_ok=True)

    def _read(self) -> dict[str, RunEntry]:
        try:
            index = json.loads((self.folder / INDEX_NAME).read_text())
            names = index["fields"]
            if index["version"] != INDEX_VERSION or names != [field.name for field in fields(RunEntry)]:
                return {}
            reasons = names.index("unfit_reasons")
            known = {}
            for row in index["runs"]:
                row[reasons] = tuple(row[reasons])
                known[row[0]] = RunEntry(*row)
            return known
        except (OSError, ValueError, KeyError, TypeError, IndexError):
            # Damaged, or of another version: it is made again.
            return {}


def read_entry(folder: Path, relative: str, info: os.stat_result) -> RunEntry:
    """What a file says of itself; what is wrong with it stands in `trouble`."""
    blank = RunEntry(relative, info.st_size, info.st_mtime_ns, rig=Path(relative).parent.name)
    path = folder / relative
    try:
        with path.open("rb") as stream:
            if relative.endswith(UNFINISHED_SUFFIX):
                return _part_entry(blank, stream)
            return _finished_entry(blank, stream, info.st_size)
    except OSError as error:
        return replace(blank, trouble=f"can't be read: {error.strerror}")
    except _UnusableError as error:
        return replace(blank, trouble=str(error))
    except (McapError, struct.error, ValueError, KeyError, IndexError) as error:
        return replace(blank, trouble=f"damaged: {error or type(error).__name__}; try `hilrig recover`")


def measure_entry(folder: Path, entry: RunEntry) -> RunEntry:
    """An entry with the latency of its loop, read from its recording; what damage that finds stands in `trouble`."""
    path = folder / entry.path
    try:
        report = measure(open_run(path))
    except HilrigError as error:
        # Whole, and yet without a figure: how it ended says more than that it can't be measured.
        trouble = error.said if isinstance(error, DamagedRecordingError) else ""
        return replace(entry, measured=True, fit=False, unfit_reasons=(str(error),), trouble=trouble)
    loop = report.loop_ms
    return replace(
        entry,
        measured=True,
        loop_p50_ms=None if loop is None else round(loop.p50, 6),
        loop_p99_ms=None if loop is None else round(loop.p99, 6),
        fit=report.fit,
        unfit_reasons=tuple(report.reasons),
    )


def write_verdict(path: Path, verified: bool, detail: str = "") -> None:
    """Note beside a recording whether re-simulation gave the same states.

    Raises:
        OSError: the folder can't be written.
    """
    verdict = {"verified": verified, "size": path.stat().st_size, "detail": detail}
    path.with_name(path.name + VERDICT_SUFFIX).write_text(json.dumps(verdict) + "\n")


def read_verdict(path: Path) -> bool | None:
    """What is noted beside a recording; None: nothing, or it was about another file of that name."""
    try:
        verdict = json.loads(path.with_name(path.name + VERDICT_SUFFIX).read_text())
        return bool(verdict["verified"]) if verdict["size"] == path.stat().st_size else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


class _UnusableError(Exception):
    pass


def _walk(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    waiting = [""]
    while waiting:
        below = waiting.pop()
        try:
            found = list(os.scandir(folder / below))
        except OSError:
            continue
        for item in found:
            relative = f"{below}/{item.name}" if below else item.name
            try:
                if item.is_dir(follow_symlinks=False):
                    waiting.append(relative)
                elif item.name.endswith((MCAP_SUFFIX, UNFINISHED_SUFFIX)):
                    yield relative, item.stat()
            except OSError:
                # Renamed or deleted since it was listed.
                continue


def _finished_entry(blank: RunEntry, stream: IO[bytes], size: int) -> RunEntry:
    magic = len(MCAP0_MAGIC)
    if size == 0:
        raise _UnusableError("empty")
    if stream.read(magic) != MCAP0_MAGIC:
        raise _UnusableError("no MCAP file")
    tail_size = min(size, _TAIL_BYTES)
    stream.seek(size - tail_size)
    tail = stream.read(tail_size)
    footer_size = _FOOTER.size
    if tail[-magic:] != MCAP0_MAGIC or len(tail) < magic + footer_size:
        raise _UnusableError("torn: it has no end; `hilrig recover` makes a whole file of it")
    opcode, _, summary_start, _, checksum = _FOOTER.unpack_from(tail, len(tail) - magic - footer_size)
    if opcode != Opcode.FOOTER.value or not 0 < summary_start < size:
        raise _UnusableError("it has no index; `hilrig recover` makes one")
    if summary_start < size - tail_size:
        stream.seek(summary_start)
        summary = stream.read(size - summary_start)
    else:
        summary = tail[summary_start - size :]
    if checksum not in (0, zlib.crc32(summary[: -magic - 4])):
        raise _UnusableError("damaged: the checksum of its index does not hold; try `hilrig recover`")
    statistics: Statistics | None = None
    places: dict[str, MetadataIndex] = {}
    for opcode, content in _records(summary[: -magic - footer_size]):
        if opcode == Opcode.STATISTICS.value:
            statistics = Statistics.read(ReadDataStream(BytesIO(content)))
        elif opcode == Opcode.METADATA_INDEX.value:
            place = MetadataIndex.read(ReadDataStream(BytesIO(content)))
            places[place.name] = place
    if statistics is None:
        raise _UnusableError("it has no statistics; `hilrig recover` makes them")
    session, summing_up = (_metadata(stream, places.get(name)) for name in ("hilrig.session", "hilrig.summary"))
    held = int(summing_up.get("messages", 0)) if "hilrig.recovered" in places else 0
    entry = _described(blank, session)
    return replace(
        entry,
        start_wall_ns=statistics.message_start_time or entry.start_wall_ns,
        duration_s=(statistics.message_end_time - statistics.message_start_time) / 1e9,
        messages=statistics.message_count,
        ended=summing_up.get("ended", ""),
        reason=summing_up.get("reason", ""),
        lost_transport=int(summing_up.get("lost_transport", 0)),
        lost_recorder=int(summing_up.get("lost_recorder", 0)),
        lost_file=max(0, held - statistics.message_count),
        overruns=int(summing_up.get("overruns", 0)),
        missed_steps=int(summing_up.get("missed_steps", 0)),
        clock_steps=int(summing_up.get("clock_steps", 0)),
        trouble="" if session else "no recording of hilrig",
    )


def _part_entry(blank: RunEntry, stream: IO[bytes]) -> RunEntry:
    """A file that is being written, or was left by a recorder that was killed: its beginning tells whose it is."""
    head = stream.read(_TAIL_BYTES)
    session: dict[str, str] = {}
    for opcode, content in _records(head[len(MCAP0_MAGIC) :]):
        if opcode == Opcode.METADATA.value:
            metadata = Metadata.read(ReadDataStream(BytesIO(content)))
            if metadata.name == "hilrig.session":
                session = metadata.metadata
                break
    return replace(_described(blank, session), ended=RECORDING, reason="it is being written, or waits to be recovered")


def _described(blank: RunEntry, session: dict[str, str]) -> RunEntry:
    return replace(
        blank,
        rig=session.get("rig", blank.rig),
        lab=session.get("lab", ""),
        session=session.get("session", ""),
        part=int(session.get("part", 1)),
        controller=session.get("controller", ""),
        start_wall_ns=int(session.get("start_wall_ns", 0)),
    )


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while len(data) - at >= _HEAD.size:
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if at + length > len(data):
            return
        # A long recording's index is mostly chunks, which are of no interest here.
        if opcode != Opcode.CHUNK_INDEX.value:
            yield opcode, data[at : at + length]
        at += length


def _metadata(stream: IO[bytes], place: MetadataIndex | None) -> dict[str, Any]:
    if place is None:
        return {}
    stream.seek(place.offset + _HEAD.size)
    return dict(Metadata.read(ReadDataStream(BytesIO(stream.read(place.length - _HEAD.size)))).metadata)
