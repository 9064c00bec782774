"""The shelf of recordings: where each session's file stands, what is written into it besides messages, and how it ends.

`<folder>/<lab>/<rig>/<session>.mcap`; when a session needs another file (the recorder was restarted, the file grew
too large, the disk was full for a while) the next is `<session>.2.mcap`, and its metadata names the one before.
"""

import contextlib
import errno
import platform
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Final

from mcap.records import Metadata

from hilrig_recorder.channels import SCHEMA_VERSION
from hilrig_recorder.disk import Disk
from hilrig_recorder.recover import TAIL_NS, Tail, read_tail
from hilrig_recorder.reserve import Reserve
from hilrig_recorder.sessions import SECOND_NS, Recording, Sink
from hilrig_recorder.writer import RunWriter, compressor, part_path
from hilrig_runtime.clock import Clock
from hilrig_runtime.config import RecorderConfig
from hilrig_runtime.errors import InputError
from hilrig_schemas import Event, RigConfig

CHUNK_NS: Final = SECOND_NS
"""A chunk is written at the latest when its first message is so old."""
LOSS_NOTES: Final = 1000
"""Places of losses noted in a file; all are counted in its summary."""
_FREE_SPACE_PERIOD_NS: Final = SECOND_NS
_MIB: Final = 1024 * 1024
_NO_SPACE: Final = (errno.ENOSPC, errno.EDQUOT)


@dataclass(slots=True, eq=False)
class _File:
    recording: Recording
    writer: RunWriter
    number: int
    opened_ns: int
    configurations: set[int] = field(default_factory=set)
    sources: set[tuple[str, int]] = field(default_factory=set)
    notes: int = 0
    failure: OSError | None = None


def machine() -> str:
    """This machine, for people: system, processor, Python."""
    return f"{platform.system()} {platform.release()} {platform.machine()}, Python {platform.python_version()}"


def iso(wall_ns: int) -> str:
    """A wall clock time for people, UTC."""
    return datetime.fromtimestamp(wall_ns // SECOND_NS, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


class Files:
    """The recordings' files; used from the recorder's thread alone. Implements `sessions.Shelf`."""

    def __init__(
        self,
        lab: str,
        config: RecorderConfig,
        clock: Clock,
        disk: Disk,
        *,
        source: str,
        tell: Callable[[Event], None],
        ask_config: Callable[[str], None],
        give_up: Callable[[Recording], None],
    ) -> None:
        self.folder = config.folder / lab
        self._lab = lab
        self._config = config
        self._clock = clock
        self._disk = disk
        self._identity = source
        self._tell = tell
        self._ask_config = ask_config
        self._give_up = give_up
        self._files: dict[Recording, _File] = {}
        self._trouble: dict[str, str] = {}
        self._space_due_ns = 0
        self._full = False
        self._bytes_closed = 0
        self._compress = compressor()
        self._reserve = Reserve(self.folder)
        self._reserve.hold()

    @property
    def trouble(self) -> str:
        """What the operator should know now; empty: nothing."""
        return "; ".join(self._trouble.values())

    @property
    def bytes_written(self) -> int:
        """Bytes in files since the start."""
        return self._bytes_closed + sum(file.writer.size for file in self._files.values())

    # -- Shelf ------------------------------------------------------------------------------------------------------

    def open(self, recording: Recording) -> Sink | None:
        """See `Shelf.open`."""
        folder = self.folder / recording.rig
        number, previous = self._next_number(folder, recording.session)
        if previous is not None:
            tail = self._tail_of_session(folder, recording.session, number - 1)
            if tail.end == "ended":
                return None
            recording.seen, recording.last = tail.keys, tail.last
        if self._full:
            return None
        return self._open_file(recording, folder, number, previous)

    def close(self, recording: Recording, end: str, reason: str) -> None:
        """See `Shelf.close`."""
        file = self._files.pop(recording, None)
        if file is not None:
            self._finish(file, end, reason)

    def lost(self, recording: Recording, source: str, key: str, transport: int, recorder: int) -> None:
        """See `Shelf.lost`."""
        file = self._files.get(recording)
        if file is None or file.notes >= LOSS_NOTES:
            return
        file.notes += 1
        note = {
            "source": source,
            "key": key,
            "transport": str(transport),
            "recorder": str(recorder),
            "log_time": str(self._clock.wall_ns()),
        }
        self._note(file, numbered("hilrig.loss", file.notes), note)

    def source(self, recording: Recording, source: str, incarnation: int) -> None:
        """See `Shelf.source`."""
        file = self._files.get(recording)
        if file is None or (source, incarnation) in file.sources:
            return
        file.sources.add((source, incarnation))
        values = {"source": source, "incarnation": str(incarnation)}
        self._note(file, numbered("hilrig.source", len(file.sources)), values)
        self._ask_config(recording.rig)

    def refuse(self, what: str) -> None:
        """See `Shelf.refuse`."""
        self._tell(Event(severity=Event.WARNING, text=f"not recorded: {what}"))

    # -- from the shell ---------------------------------------------------------------------------------------------

    def configure(self, config: RigConfig) -> None:
        """Put a rig's configuration into its open files; the same one only once."""
        for file in self._files.values():
            if file.recording.rig == config.rig and config.incarnation not in file.configurations:
                file.configurations.add(config.incarnation)
                self._write_config(file, config)

    def unconfigured(self) -> set[str]:
        """Rigs with an open file that has no configuration yet."""
        return {file.recording.rig for file in self._files.values() if not file.configurations}

    def fail(self, writer: RunWriter, error: OSError) -> None:
        """End the file of `writer`, which the disk let down."""
        for file in self._files.values():
            if file.writer is writer:
                self._on_failure(file, error)

    def tick(self, now_ns: int) -> None:
        """Write chunks that are old enough, begin next files, and end those that failed; some times a second."""
        wall_ns = self._clock.wall_ns()
        self._watch_space(now_ns)
        for file in list(self._files.values()):
            since_ns = file.writer.pending_since_ns
            if file.failure is None and since_ns and not 0 <= wall_ns - since_ns < CHUNK_NS:
                try:
                    file.writer.close_chunk()
                except OSError as error:
                    self._on_failure(file, error)
            if file.failure is not None:
                self._end_failed(file, file.failure)
            elif self._full:
                self._end_failed(file, OSError(errno.ENOSPC, "the disk is nearly full"))
            elif self._is_due(file, now_ns):
                self._rotate(file)

    def release(self) -> None:
        """Give back what was set aside: the recorder ends."""
        self._reserve.release()

    def forget_trouble(self, about: str) -> None:
        """A trouble is over."""
        self._trouble.pop(about, None)

    # -- files ------------------------------------------------------------------------------------------------------

    def _tail_of_session(self, folder: Path, session: str, number: int) -> Tail:
        """The last seconds of a session's files up to a number: a recorder may have been restarted often."""
        tail = self._tail(folder / file_name(session, number))
        last_ns = tail.last_ns
        while number > 1 and (not last_ns or last_ns - tail.last_ns < TAIL_NS):
            number -= 1
            before = self._tail(folder / file_name(session, number))
            last_ns = last_ns or before.last_ns
            reached_ns = before.last_ns or tail.last_ns
            tail = Tail(tail.end, tail.keys | before.keys, {**before.last, **tail.last}, reached_ns)
        return tail

    @staticmethod
    def _tail(previous: Path) -> Tail:
        # It may get its name just now, from the disk's thread or because it is recovered.
        for path in (previous, part_path(previous), previous):
            with contextlib.suppress(InputError):
                return read_tail(path)
        return Tail("", set(), {}, 0)

    def _next_number(self, folder: Path, session: str) -> tuple[int, Path | None]:
        number, previous = 1, None
        while True:
            path = folder / file_name(session, number)
            if not path.exists() and not part_path(path).exists():
                return number, previous
            number, previous = number + 1, path

    def _open_file(self, recording: Recording, folder: Path, number: int, previous: Path | None) -> RunWriter | None:
        file: _File | None = None

        def on_failure(error: OSError) -> None:
            if file is not None:
                self._on_failure(file, error)

        path = folder / file_name(recording.session, number)
        about = Metadata("hilrig.session", self._session_values(recording, number, previous))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            writer = RunWriter(path, metadata=(about,), on_failure=on_failure, compress=self._compress)
        except OSError as error:
            self._report(recording, f"{path}: can't be recorded: {error.strerror}")
            return None
        file = _File(recording, writer, number, self._clock.monotonic_ns())
        self._files[recording] = file
        self._disk.follow(writer)
        self._ask_config(recording.rig)
        self.forget_trouble(recording.rig)
        return writer

    def _session_values(self, recording: Recording, number: int, previous: Path | None) -> dict[str, str]:
        return {
            "session": recording.session,
            "rig": recording.rig,
            "lab": self._lab,
            "controller": recording.controller,
            "keeper": recording.keeper,
            "start": iso(recording.start_wall_ns),
            "start_wall_ns": str(recording.start_wall_ns),
            "software_version": version("hilrig"),
            "schema_version": SCHEMA_VERSION,
            "machine": machine(),
            "recorder": self._identity,
            "part": str(number),
            "previous": previous.name if previous is not None else "",
        }

    def _write_config(self, file: _File, config: RigConfig) -> None:
        values = {
            "rig": config.rig,
            "incarnation": str(config.incarnation),
            "step_ns": str(config.step_ns),
            "parameters_json": config.parameters_json,
            "software_version": config.software_version,
            "machine": config.machine,
        }
        self._note(file, numbered("hilrig.config", len(file.configurations)), values)
        wall_ns = self._clock.wall_ns()
        lab_toml = config.lab_toml or "# There was no lab.toml: the defaults were in force.\n"
        attachments = (
            ("lab.toml", "application/toml", lab_toml),
            (f"{config.rig}.urdf", "application/xml", config.urdf),
        )
        try:
            for name, media_type, text in attachments:
                file.writer.add_attachment(name, media_type, text.encode(), log_time=wall_ns)
        except OSError as error:
            self._on_failure(file, error)

    def _note(self, file: _File, name: str, values: Mapping[str, str]) -> None:
        try:
            file.writer.add_metadata(name, values)
        except OSError as error:
            self._on_failure(file, error)

    def _is_due(self, file: _File, now_ns: int) -> bool:
        config = self._config
        too_large = config.rotate_mib and file.writer.size >= config.rotate_mib * _MIB
        too_long = config.rotate_min and now_ns - file.opened_ns >= config.rotate_min * 60 * SECOND_NS
        return bool(too_large or too_long) and file.recording.end_wall_ns is None

    def _rotate(self, file: _File) -> None:
        recording = file.recording
        folder = self.folder / recording.rig
        number, previous = self._next_number(folder, recording.session)
        writer = self._open_file(recording, folder, number, previous)
        if writer is None:
            # The old file goes on; the trouble was told.
            self._files[recording] = file
            file.opened_ns = self._clock.monotonic_ns()
            return
        recording.add = writer.add
        self._finish(file, "continued", f"the session goes on in {writer.path.name}")
        recording.tally = type(recording.tally)()
        for source, incarnation in file.sources:
            self.source(recording, source, incarnation)

    def _finish(self, file: _File, end: str, reason: str) -> None:
        writer, recording = file.writer, file.recording

        def last_words() -> dict[str, dict[str, str]]:
            tally = {name: str(value) for name, value in asdict(recording.tally).items()}
            tally["lost_recorder"] = str(recording.tally.lost_recorder + writer.given_up)
            return {
                "hilrig.summary": {
                    "ended": end,
                    "reason": reason,
                    "end_wall_ns": str(recording.end_wall_ns or self._clock.wall_ns()),
                    **tally,
                    "messages": str(writer.message_count),
                }
            }

        self._bytes_closed += writer.size
        try:
            writer.finish(last_words)
        except OSError as error:
            self._report(recording, f"{writer.part}: can't be finished, and waits to be recovered: {error.strerror}")
            self._disk.abandon(writer)
        else:
            self._disk.publish(writer)

    # -- trouble ----------------------------------------------------------------------------------------------------

    def _on_failure(self, file: _File, error: OSError) -> None:
        if file.failure is not None:
            return
        file.failure = error
        if error.errno in _NO_SPACE:
            # Every file on this disk ends now, while the space set aside is enough for all of them.
            self._reserve.release()
            self._full = True
        recording = file.recording

        def lose(channel_id: int, log_time: int, record: bytes) -> None:  # noqa: ARG001
            recording.tally.lost_recorder += 1

        recording.add = lose

    def _end_failed(self, file: _File, error: OSError) -> None:
        recording = file.recording
        del self._files[recording]
        end = "disk full" if error.errno in _NO_SPACE else "write failed"
        reason = f"{file.writer.path}: {error.strerror}; the recording ends here"
        self._finish(file, end, reason)
        self._report(recording, reason)
        self._give_up(recording)

    def _report(self, recording: Recording, text: str) -> None:
        if self._trouble.get(recording.rig) != text:
            self._trouble[recording.rig] = text
            event = Event(rig=recording.rig, session=recording.session, severity=Event.ERROR, text=text)
            self._tell(event)

    def _watch_space(self, now_ns: int) -> None:
        if now_ns < self._space_due_ns:
            return
        # A file that just failed for want of space ends before space is looked at again.
        if any(file.failure is not None for file in self._files.values()):
            return
        self._space_due_ns = now_ns + _FREE_SPACE_PERIOD_NS
        try:
            free = shutil.disk_usage(self.folder).free
        except OSError:
            return
        # A disk that was full is so until there is room to end the next files properly too.
        was_full, self._full = self._full, free < self._config.min_free_mib * _MIB or self._no_room(self._full)
        if self._full and not was_full:
            text = (
                f"{self.folder}: only {free // _MIB} MiB are free, {self._config.min_free_mib} are kept: no recording"
            )
            self._trouble[""] = text
            self._tell(Event(severity=Event.ERROR, text=text))
        elif was_full and not self._full:
            self.forget_trouble("")

    def _no_room(self, was_full: bool) -> bool:
        return not self._reserve.hold() and was_full


def numbered(name: str, number: int) -> str:
    """Name of the first, second, … metadata record of a kind: names are unique in a file."""
    return name if number == 1 else f"{name}.{number}"


def file_name(session: str, number: int) -> str:
    """Name of a session's file; `number` counts from 1."""
    return f"{session}.mcap" if number == 1 else f"{session}.{number}.mcap"
