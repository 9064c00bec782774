"""Making a whole file of one that is not: every whole chunk is kept, indexed anew, and what is missing is stated.

The original is not touched before the new file is safe on the disk under its name.
"""

import contextlib
import errno
import mmap
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Final

from mcap.records import Attachment, Channel, Header, Metadata, Schema

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX, PART_SUFFIX, RECOVERING_SUFFIX
from hilrig_recorder.mcap_format.fsutil import lock_file
from hilrig_recorder.mcap_format.scan import (
    Chunk,
    Damage,
    DamagedError,
    Message,
    is_whole,
    message_keys,
    open_chunk,
    scan,
)
from hilrig_recorder.mcap_format.writer import LIBRARY, RunWriter
from hilrig_runtime.errors import InputError, OperationError

_UNFINISHED: Final = "the file had no end: its recorder was killed, or it was cut off; what came last may be missing"
_DAMAGED: Final = "how it ended stood where the file is damaged"
_HEAD_BYTES: Final = 64 * 1024


@dataclass(slots=True)
class Recovery:
    """What was saved, and what was not."""

    source: Path
    path: Path | None = None
    """The new file; None: there was nothing to do, for the file is whole."""
    messages: int = 0
    chunks: int = 0
    attachments: int = 0
    metadata: int = 0
    damaged_chunks: int = 0
    """Chunks that are there but not whole."""
    damaged_bytes: int = 0
    """Bytes of the original that hold nothing whole: the torn end, and damage in between."""
    torn_bytes: int = 0
    """Those of them that belong to a record which the end of the file cut off."""
    orphans: int = 0
    """Messages whose channel is not known any more."""
    reasons: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Tail:
    """The end of a recording, whole or not."""

    end: str
    """How it ended, as its summary says; empty: it has none."""
    keys: set[tuple[int, int, int]]
    """Channel, sequence and publish time of its last messages."""
    last: dict[int, tuple[int, int]]
    """Sequence and publish time of the last message of each channel."""
    last_ns: int
    """Arrival of the last message, wall clock, ns; 0: there is none."""


def map_file(path: Path) -> memoryview:
    """A file's bytes, without reading them all into memory.

    Raises:
        InputError: it can't be read.
    """
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                return memoryview(b"")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise InputError(f"{path}: can't be read: {error.strerror}") from error


def read_tail(path: Path, tail_ns: int) -> Tail:
    """What the next file of a session must know of the one before; of its messages, those of the last `tail_ns`.

    Raises:
        InputError: it can't be read.
    """
    end = ""
    last: dict[int, tuple[int, int]] = {}
    chunks: list[Chunk] = []
    keys: set[tuple[int, int, int]] = set()
    for _, item in scan(map_file(path)):
        if isinstance(item, Metadata) and item.name == "hilrig.summary":
            end = item.metadata.get("ended", "")
        elif isinstance(item, Chunk):
            chunks.append(item)
    last_ns = max((chunk.last_ns for chunk in chunks), default=0)
    for chunk in chunks:
        if chunk.last_ns >= last_ns - tail_ns:
            with contextlib.suppress(DamagedError):
                for key in message_keys(chunk):
                    keys.add(key)
                    last[key[0]] = key[1:]
    return Tail(end, keys, last, last_ns)


def session_of(path: Path) -> dict[str, str]:
    """What `hilrig.session` at a file's beginning says; empty: nothing.

    Raises:
        InputError: it can't be read.
    """
    for _, item in scan(map_file(path)[:_HEAD_BYTES]):
        if isinstance(item, Metadata) and item.name == "hilrig.session":
            return dict(item.metadata)
    return {}


def recover(source: Path, path: Path, *, go_on: Callable[[], bool] = lambda: True) -> Recovery:
    """Make a whole file at `path` of `source`, which stays as it is.

    Args:
        source: any MCAP file, also one that hilrig did not write; a whole one is left alone.
        path: the new file; it must not exist.
        go_on: asked between chunks; when it says no, what was made so far is removed.

    Raises:
        InputError: `source` can't be read, holds nothing of an MCAP file, or is being written just now.
        OperationError: the new file can't be written, or `go_on` said no.
    """
    with _held(source):
        return _recover(source, path, go_on)


def _recover(source: Path, path: Path, go_on: Callable[[], bool]) -> Recovery:
    recovery = Recovery(source)
    view = map_file(source)
    finished = is_whole(view)
    if finished and _is_intact(view, source, go_on):
        return recovery
    if path.exists():
        raise OperationError(f"{path}: exists; choose another name for what is recovered from {source.name}")
    part = path.with_name(path.name + RECOVERING_SUFFIX)
    try:
        part.unlink(missing_ok=True)
        _Copy(view, recovery, finished).write(path, part, go_on)
    except OSError as error:
        raise OperationError(f"{path}: can't be written: {error.strerror}") from error
    recovery.path = path
    return recovery


def _is_intact(view: memoryview, source: Path, go_on: Callable[[], bool]) -> bool:
    """Whether everything before a good end holds too: what was damaged on a disk or a stick still ends as it did."""
    for _, item in scan(view):
        if isinstance(item, Damage):
            return False
        if isinstance(item, Chunk):
            _ask(go_on, source)
            try:
                open_chunk(item)
            except DamagedError:
                return False
    return True


def _ask(go_on: Callable[[], bool], source: Path) -> None:
    if not go_on():
        raise OperationError(f"{source}: recovering was interrupted; the file is as it was")


@contextlib.contextmanager
def _held(source: Path) -> Iterator[None]:
    """Nobody else writes or recovers a file meanwhile."""
    try:
        file = source.open("r+b")
    except PermissionError:
        # What can't be written can be read all the same, and nobody writes it.
        yield
        return
    except OSError as error:
        if error.errno != errno.EROFS:
            raise InputError(f"{source}: can't be read: {error.strerror}") from error
        yield
        return
    with file:
        if not lock_file(file.fileno()):
            raise InputError(f"{source}: a recorder is writing it just now, or it is being recovered already")
        yield


class _Copy:
    def __init__(self, view: memoryview, recovery: Recovery, finished: bool) -> None:
        self._view = view
        self._recovery = recovery
        self._finished = finished
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._declared: set[int] = set()
        self._notes = {"lost_transport": 0, "lost_recorder": 0}
        self._has_summary = False
        self._last_ns = 0

    def write(self, path: Path, part: Path, go_on: Callable[[], bool]) -> None:
        header = next((item for _, item in scan(self._view[:_HEAD_BYTES]) if isinstance(item, Header)), None)
        if header is None and not any(isinstance(item, Chunk) for _, item in scan(self._view)):
            raise InputError(f"{self._recovery.source}: holds nothing of an MCAP file")
        ours = header is not None and header.library == LIBRARY
        writer = RunWriter(
            path,
            part=part,
            schemas=(),
            channels=(),
            profile=header.profile if header else "",
            library=header.library if header else LIBRARY,
        )
        try:
            self._copy(writer, ours, go_on)
            writer.finish(lambda: self._last_words(ours))
            if writer.given_up:
                raise OperationError(f"{path}: can't be written: no space is left for it")
            writer.publish()
        except BaseException:
            writer.discard()
            raise

    def _copy(self, writer: RunWriter, ours: bool, go_on: Callable[[], bool]) -> None:
        recovery = self._recovery
        for _, item in scan(self._view):
            if isinstance(item, Chunk):
                _ask(go_on, recovery.source)
                self._copy_chunk(writer, item)
            elif isinstance(item, Message):
                # A file of chunks has no messages beside them: that is a damaged record which looks like one.
                if ours or recovery.chunks:
                    recovery.damaged_bytes += len(item.record)
                else:
                    self._copy_message(writer, item)
            elif isinstance(item, Damage):
                recovery.damaged_bytes += item.length
                if item.offset + item.length == len(self._view):
                    recovery.torn_bytes = item.length
                recovery.reasons.append(f"{item.length} bytes at {item.offset}: {item.reason}")
            elif isinstance(item, Schema | Channel):
                self._declare(writer, item)
            elif isinstance(item, Metadata):
                self._copy_metadata(writer, item)
            elif isinstance(item, Attachment):
                recovery.attachments += 1
                writer.add_attachment(
                    item.name, item.media_type, item.data, log_time=item.log_time, create_time=item.create_time
                )

    def _copy_chunk(self, writer: RunWriter, chunk: Chunk) -> None:
        try:
            for item in open_chunk(chunk):
                if isinstance(item, Message):
                    self._copy_message(writer, item)
                else:
                    self._declare(writer, item)
        except DamagedError as damage:
            self._recovery.damaged_chunks += 1
            self._recovery.damaged_bytes += len(chunk.data)
            self._recovery.reasons.append(f"chunk at {chunk.offset}: {damage}")
            return
        self._recovery.chunks += 1

    def _copy_message(self, writer: RunWriter, message: Message) -> None:
        if message.channel_id not in self._declared:
            self._recovery.orphans += 1
            return
        writer.add(message.record)
        self._recovery.messages += 1
        self._last_ns = max(self._last_ns, message.log_time)

    def _declare(self, writer: RunWriter, item: Schema | Channel) -> None:
        if isinstance(item, Schema):
            if item.id not in self._schemas:
                self._schemas[item.id] = item
                writer.add_schema(item)
            return
        if item.id in self._declared or (item.schema_id and item.schema_id not in self._schemas):
            return
        self._declared.add(item.id)
        writer.add_channel(item)

    def _copy_metadata(self, writer: RunWriter, item: Metadata) -> None:
        self._recovery.metadata += 1
        self._has_summary |= item.name == "hilrig.summary"
        if item.name.startswith("hilrig.loss"):
            for name in self._notes:
                # Metadata has no checksum: a figure may be none.
                figure = item.metadata.get(name.removeprefix("lost_"), "")
                self._notes[name] += int(figure) if figure.isdecimal() else 0
        writer.add_metadata(item.name, item.metadata)

    def _last_words(self, ours: bool) -> dict[str, dict[str, str]]:
        recovery = self._recovery
        words = {
            "hilrig.recovered": {
                "from": recovery.source.name,
                "messages": str(recovery.messages),
                "chunks": str(recovery.chunks),
                "damaged_chunks": str(recovery.damaged_chunks),
                "damaged_bytes": str(recovery.damaged_bytes),
                "torn_bytes": str(recovery.torn_bytes),
                "orphans": str(recovery.orphans),
                "software_version": version("hilrig"),
            }
        }
        if ours and not self._has_summary:
            words["hilrig.summary"] = {
                "ended": "recovered",
                "reason": _DAMAGED if self._finished else _UNFINISHED,
                "end_wall_ns": str(self._last_ns),
                "messages": str(recovery.messages),
                **{name: str(count) for name, count in self._notes.items()},
            }
        return words


def recovered_path(source: Path) -> Path:
    """Where what is recovered from a file goes: a `.part` gets its name, any other keeps its own beside it.

    Raises:
        InputError: it is a folder.
    """
    if source.is_dir():
        raise InputError(f"{source}: is a folder; name the MCAP files in it")
    if source.name.endswith(PART_SUFFIX):
        return source.with_name(source.name.removesuffix(PART_SUFFIX))
    return source.with_name(f"{source.stem}.recovered{source.suffix or MCAP_SUFFIX}")
