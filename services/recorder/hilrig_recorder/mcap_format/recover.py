"""Recovers a truncated or damaged file: copies its complete chunks into a new indexed file and reports the losses.

The original file is not changed before the new file is synced and renamed.
"""

import contextlib
import errno
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import count, takewhile
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Header, Metadata, MetadataIndex, Schema

from hilrig_recorder.mcap_format.ending import Ending
from hilrig_recorder.mcap_format.file_names import MAGIC
from hilrig_recorder.mcap_format.fsutil import lock_file, map_file, open_file
from hilrig_recorder.mcap_format.metadata_checks import add_metadata
from hilrig_recorder.mcap_format.new_file import new_file
from hilrig_recorder.mcap_format.reader import buffer_reader
from hilrig_recorder.mcap_format.records import (
    COPY_SUFFIX,
    Chunk,
    DamagedError,
    Message,
    check_attachment,
    encode_message,
    encode_records,
)
from hilrig_recorder.mcap_format.scan import (
    MAX_BEGIN_BYTES,
    Damage,
    is_complete,
    read_chunk,
    scan,
    session_metadata,
)
from hilrig_recorder.mcap_format.writer import LIBRARY, RecordingWriter
from hilrig_runtime.errors import InputError, OperationError

_REPEATED: Final = ("hilrig.session", "hilrig.config")
"""Names of the metadata records that are in a file twice."""
MAX_TAIL_SEARCHES: Final = 64
"""Maximum number of `scan.SEARCH_BYTES` of damaged ranges that are searched for the end of a file."""
_REASON_UNFINISHED: Final = (
    "the file was not finished: the recorder was killed, or the file was truncated; the last messages may be missing"
)
_REASON_DAMAGED: Final = "the summary of the file was damaged"


@dataclass(slots=True)
class Recovery:
    """Result of a recovery."""

    source: Path
    path: Path | None = None
    """The new file; None: the source is complete and intact, no file was written."""
    messages: int = 0
    chunks: int = 0
    attachments: int = 0
    metadata: int = 0
    damaged_chunks: int = 0
    """Chunks with a wrong checksum or content."""
    damaged_bytes: int = 0
    """Bytes of the source without a complete record: the truncated end and damaged ranges."""
    torn_bytes: int = 0
    """The part of `damaged_bytes` that belongs to a record truncated by the end of the file."""
    orphans: int = 0
    """Messages that were not copied because their channel is unknown."""
    reasons: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class SegmentTail:
    """The last messages of a recording, finished or not."""

    end: str
    """The value `ended` of its summary; empty: it has no summary."""
    keys: set[tuple[int, int, int]]
    """(channel id, sequence, publish time) of the last messages."""
    last: dict[int, tuple[int, int]]
    """(sequence, publish time) of the last message, by channel id."""
    last_ns: int
    """Arrival of the last message, wall clock, ns; 0: no message."""


def read_tail(path: Path, tail_ns: int) -> SegmentTail:
    """Read how a file ended and the keys of its messages of the last `tail_ns`, in bounded time.

    Raises:
        InputError: the file can't be read.
    """
    end = ""
    last: dict[int, tuple[int, int]] = {}
    chunks: list[Chunk] = []
    keys: set[tuple[int, int, int]] = set()
    searched = count(1)

    def on_search() -> None:
        if next(searched) > MAX_TAIL_SEARCHES:
            raise DamagedError("a large range is damaged")

    # What follows a large damaged range is not read here: the recorder waits. It is recovered later.
    with contextlib.suppress(DamagedError):
        for _, item in scan(map_file(path), on_search):
            if isinstance(item, Metadata) and item.name == "hilrig.summary":
                end = item.metadata.get("ended", "")
            elif isinstance(item, Chunk):
                chunks.append(item)
    last_ns = chunks[-1].last_ns if chunks else 0
    # Only the chunks after the last step of the wall clock: those before it have times of another clock.
    newest = list(takewhile(lambda chunk: abs(last_ns - chunk.last_ns) <= tail_ns, reversed(chunks)))
    for chunk in reversed(newest):
        with contextlib.suppress(DamagedError):
            for item in read_chunk(chunk):
                if isinstance(item, Message):
                    keys.add((item.channel_id, item.sequence, item.publish_time))
                    last[item.channel_id] = (item.sequence, item.publish_time)
    return SegmentTail(end, keys, last, last_ns)


def read_session_metadata(path: Path) -> dict[str, str]:
    """Read the metadata record `hilrig.session` at the beginning of a file; empty if it is missing.

    Raises:
        InputError: the file can't be read.
    """
    return session_metadata(map_file(path)[:MAX_BEGIN_BYTES])


def recover(source: Path, path: Path, *, should_continue: Callable[[], bool] = lambda: True) -> Recovery:
    """Write a complete file at `path` from `source`, which is not changed.

    Args:
        source: any MCAP file, also one that hilrig did not write. No file is written if it is complete and intact.
        path: the new file; it must not exist.
        should_continue: called between chunks; if it returns False, the new file is removed.

    Raises:
        InputError: `source` can't be read, is not an MCAP file, or is being written; or `path` exists.
        OperationError: the new file can't be written, or `should_continue` returned False.
    """
    if source.is_dir():
        raise InputError(f"{source}: is a folder; give the MCAP files in it")
    with _locked(source):
        return _recover(source, path, should_continue)


def _recover(source: Path, path: Path, should_continue: Callable[[], bool]) -> Recovery:
    recovery = Recovery(source)
    view = map_file(source)
    finished = is_complete(view)
    if finished and _is_intact(view, source, should_continue):
        return recovery
    _Copier(view, recovery, finished).write(path, should_continue)
    recovery.path = path
    return recovery


def _is_intact(view: memoryview, source: Path, should_continue: Callable[[], bool]) -> bool:
    """Whether a finished file has no damage: a defective disk may damage chunks and leave the end valid."""
    try:
        buffer_reader(view).check_indexes()
        metadata: dict[str, dict[str, str]] = {}
        for offset, item in scan(view, lambda: _check_interrupt(should_continue, source)):
            if isinstance(item, Metadata):
                add_metadata(metadata, item, offset)
            if isinstance(item, Damage):
                return False
            if isinstance(item, Chunk):
                _check_interrupt(should_continue, source)
                read_chunk(item)
    except DamagedError:
        return False
    return True


def _check_interrupt(should_continue: Callable[[], bool], source: Path) -> None:
    if not should_continue():
        raise OperationError(f"{source}: recovery was interrupted; the file is unchanged")


@contextlib.contextmanager
def _locked(source: Path) -> Iterator[None]:
    """Lock a file against other processes that write or recover it."""
    try:
        file = open_file(source, is_writable=True)
    except FileNotFoundError:
        raise InputError(f"{source}: no such file") from None
    except PermissionError:
        # Without write permission the file can still be read, and no recorder of this user writes it.
        yield
        return
    except OSError as error:
        if error.errno != errno.EROFS:
            raise InputError(f"{source}: can't be read: {error.strerror}") from error
        yield
        return
    with file:
        if not lock_file(file.fileno()):
            raise InputError(
                f"{source}: the file is locked: a recorder is writing it, or it is already being recovered"
            )
        yield


class _Copier:
    """Copies the complete records of a file into a new file."""

    def __init__(self, view: memoryview, recovery: Recovery, finished: bool) -> None:
        self._view = view
        self._recovery = recovery
        self._finished = finished
        self._schemas: dict[int, Schema] = {}
        self._declared: set[int] = set()
        self._declarations: list[Schema | Channel] = []
        self._losses = {"lost_transport": 0, "lost_recorder": 0}
        self._metadata: dict[str, dict[str, str]] = {}
        self._copied: set[int] = set()
        """Offsets of the metadata records and attachments that were found by reading the file in order."""
        self._last_ns = 0

    def write(self, path: Path, should_continue: Callable[[], bool]) -> None:

        def on_search() -> None:
            _check_interrupt(should_continue, self._recovery.source)

        header = next((item for _, item in scan(self._view[:MAX_BEGIN_BYTES]) if isinstance(item, Header)), None)
        if header is None and not any(isinstance(item, Chunk) for _, item in scan(self._view, on_search)):
            if self._view[: len(MAGIC)] != MAGIC:
                raise InputError(f"{self._recovery.source}: not an MCAP file (bad magic)")
            raise InputError(f"{self._recovery.source}: MCAP file without a complete record: nothing to recover")
        index = self._read_summary()
        # Without a header, the metadata tells who wrote the file.
        is_hilrig = header.library == LIBRARY if header else any(item.name.startswith("hilrig.") for item in index)
        profile, library = (header.profile, header.library) if header else ("", LIBRARY)
        with new_file(path, schemas=(), channels=(), profile=profile, library=library) as writer:
            for item in self._declarations:
                self._declare(writer, item)
            self._copy(writer, is_hilrig, should_continue)
            self._copy_indexed(writer, index)
            writer.finish(lambda: self._final_metadata(is_hilrig))

    def _read_summary(self) -> list[MetadataIndex | AttachmentIndex]:
        """The index of metadata and attachments; stores the schemas and channels. Empty without an intact summary."""
        reader = buffer_reader(self._view)
        try:
            items = list(reader.summary_items(reader.summary()))
        except DamagedError:
            return []
        self._declarations = [item for item in items if isinstance(item, Schema | Channel)]
        return [item for item in items if isinstance(item, MetadataIndex | AttachmentIndex)]

    def _copy_indexed(self, writer: RecordingWriter, index: list[MetadataIndex | AttachmentIndex]) -> None:
        """Copy the intact records in damaged ranges to which the index points."""
        reader = buffer_reader(self._view)
        for item in index:
            if item.offset in self._copied:
                continue
            with contextlib.suppress(DamagedError):
                record = reader.indexed_record(item)
                if isinstance(record, Attachment):
                    check_attachment(reader.indexed(Opcode.ATTACHMENT, item.offset, item.length), item.offset)
                    self._copy_attachment(writer, record)
                elif isinstance(record, Metadata):
                    self._copy_metadata(writer, record, item.offset)
                self._recovery.damaged_bytes -= item.length

    def _copy(self, writer: RecordingWriter, is_hilrig: bool, should_continue: Callable[[], bool]) -> None:
        recovery = self._recovery
        for offset, item in scan(self._view, lambda: _check_interrupt(should_continue, recovery.source)):
            if isinstance(item, Chunk):
                _check_interrupt(should_continue, recovery.source)
                self._copy_chunk(writer, item)
            elif isinstance(item, Message):
                # A file with chunks has no messages outside them: this is a damaged record that resembles a message.
                if is_hilrig or recovery.chunks:
                    recovery.damaged_bytes += len(encode_message(*item))
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
                self._copied.add(offset)
                self._copy_metadata(writer, item, offset)
            elif isinstance(item, Attachment):
                self._copied.add(offset)
                self._copy_attachment(writer, item)

    def _copy_chunk(self, writer: RecordingWriter, chunk: Chunk) -> None:
        try:
            for item in read_chunk(chunk):
                if isinstance(item, Message):
                    self._copy_message(writer, item)
                else:
                    self._declare(writer, item)
        except DamagedError as damage:
            self._recovery.damaged_chunks += 1
            self._recovery.damaged_bytes += len(chunk.data)
            self._recovery.reasons.append(f"chunk at {chunk.offset}: {damage.problem}")
            return
        self._recovery.chunks += 1

    def _copy_message(self, writer: RecordingWriter, message: Message) -> None:
        if message.channel_id not in self._declared:
            self._recovery.orphans += 1
            return
        writer.add(encode_message(*message))
        self._recovery.messages += 1
        self._last_ns = max(self._last_ns, message.log_time)

    def _declare(self, writer: RecordingWriter, item: Schema | Channel) -> None:
        if isinstance(item, Schema):
            if item.id not in self._schemas:
                self._schemas[item.id] = item
                writer.add_schema(item)
            return
        if item.id in self._declared or (item.schema_id and item.schema_id not in self._schemas):
            return
        self._declared.add(item.id)
        writer.add_channel(item)

    def _copy_attachment(self, writer: RecordingWriter, item: Attachment) -> None:
        self._recovery.attachments += 1
        writer.add_attachment(
            item.name, item.media_type, item.data, log_time=item.log_time, create_time=item.create_time
        )

    def _copy_metadata(self, writer: RecordingWriter, item: Metadata, offset: int) -> None:
        try:
            if not add_metadata(self._metadata, item, offset):
                return
        except DamagedError as damage:
            self._recovery.damaged_bytes += len(encode_records(item))
            self._recovery.reasons.append(str(damage))
            return
        name = item.name.removesuffix(COPY_SUFFIX)
        self._recovery.metadata += 1
        if item.name.startswith("hilrig.loss"):
            for name in self._losses:
                # Metadata has no checksum: a damaged count may not be a number.
                count = item.metadata.get(name.removeprefix("lost_"), "")
                self._losses[name] += int(count) if count.isdecimal() else 0
        writer.add_metadata(name, item.metadata, is_repeated=name.startswith(_REPEATED))

    def _final_metadata(self, is_hilrig: bool) -> dict[str, dict[str, str]]:
        recovery = self._recovery
        records = {
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
        if is_hilrig and "hilrig.summary" not in self._metadata:
            records["hilrig.summary"] = {
                "ended": Ending.RECOVERED,
                "reason": _REASON_DAMAGED if self._finished else _REASON_UNFINISHED,
                "end_wall_ns": str(self._last_ns),
                "messages": str(recovery.messages),
                **{name: str(count) for name, count in self._losses.items()},
            }
        return records
