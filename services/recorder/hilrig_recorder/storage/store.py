"""The shelf of recordings, `<folder>/<lab>/<rig>/<session>.mcap`: files are begun, rotated and ended here."""

import errno
import platform
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Final

from mcap.records import Metadata

from hilrig_recorder.ingest.recording import SECOND_NS, Recording, Sink, Tally
from hilrig_recorder.mcap_format.channels import SCHEMA_VERSION
from hilrig_recorder.mcap_format.chunk import compressor
from hilrig_recorder.mcap_format.writer import MovedError, RunWriter
from hilrig_recorder.storage.disk_reserve import MIB, Space
from hilrig_recorder.storage.segment_file import RunFile
from hilrig_recorder.storage.segments import NextPart, horizon_of, next_part, tail_of_session
from hilrig_recorder.storage.sync_worker import Disk, what_became_of
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, RigConfig

NAMED: Final = 3
"""Troubles that a health report names; events and the log name each."""
SLOW_S: Final = 5.0
"""A disk that takes longer to make safe what was written is told of."""
_SPEED: Final = " speed"
"""Among the troubles, where no rig is called so."""
_SPACE_PERIOD_NS: Final = SECOND_NS
_NO_SPACE: Final = (errno.ENOSPC, errno.EDQUOT)


class Files:
    """The recordings' files; used from the recorder's thread alone. Implements `recording.Shelf`.

    `repeated_ns` is how old what senders repeat after a restart may be. `tell` gets what the operator should know;
    `ask_config` the name of a rig whose configuration is wanted; `give_up` a recording whose file can't go on.
    """

    def __init__(
        self,
        lab: str,
        config: RecorderConfig,
        clock: Clock,
        disk: Disk,
        *,
        instance: str,
        repeated_ns: int,
        tell: Callable[[Event], None],
        ask_config: Callable[[str], None],
        give_up: Callable[[Recording], None],
    ) -> None:
        self.folder = config.folder / lab
        self._lab = lab
        self._config = config
        self._clock = clock
        self._disk = disk
        self._instance = instance
        self._repeated_ns = repeated_ns
        self._tell = tell
        self._ask_config = ask_config
        self._give_up = give_up
        self._files: dict[Recording, RunFile] = {}
        self._ending: dict[RunWriter, Recording] = {}
        self._trouble: dict[str, str] = {}
        self._space = Space(self.folder, instance, config.min_free_mib)
        self._space_due_ns = 0
        self._bytes_closed = 0
        self._compress = compressor()

    @property
    def trouble(self) -> str:
        """What the operator should know now; empty: nothing."""
        told = list(self._trouble.values())
        more = len(told) - NAMED
        return "; ".join(told[:NAMED]) + (f"; and {more} more" if more > 0 else "")

    @property
    def bytes_written(self) -> int:
        """Bytes in files since the start."""
        writers = [*self._ending, *(file.writer for file in self._files.values())]
        return self._bytes_closed + sum(writer.size for writer in writers)

    # -- Shelf ------------------------------------------------------------------------------------------------------

    def open(self, recording: Recording) -> Sink | None:
        """See `Shelf.open`."""
        folder = self.folder / recording.rig
        part = self._next_part(recording)
        if part is None:
            return None
        if part.previous is not None:
            tail = tail_of_session(folder, recording.session, part.number - 1, self._repeated_ns)
            if tail.end == "ended":
                return None
            recording.seen, recording.last = tail.keys, tail.last
            recording.horizon_ns = horizon_of(tail)
        return None if self._space.full else self._open(recording, part)

    def close(self, recording: Recording, end: str, reason: str) -> None:
        """See `Shelf.close`."""
        file = self._files.pop(recording, None)
        if file is not None:
            self._finish(file, end, reason)

    def lost(self, recording: Recording, source: str, key: str, transport: int, recorder: int) -> None:
        """See `Shelf.lost`."""
        file = self._files.get(recording)
        if file is not None:
            file.note_loss(source, key, transport, recorder)

    def source(self, recording: Recording, source: str, incarnation: int) -> None:
        """See `Shelf.source`."""
        file = self._files.get(recording)
        if file is not None and file.note_source(source, incarnation):
            self._ask_config(recording.rig)

    def refuse(self, what: str) -> None:
        """See `Shelf.refuse`."""
        self._tell(Event(kind=Event.RECORDING, severity=Event.WARNING, text=f"not recorded: {what}"))

    # -- from the shell ---------------------------------------------------------------------------------------------

    def configure(self, config: RigConfig) -> None:
        """Put a rig's configuration into its open files; the same one only once."""
        for file in self._files.values():
            if file.recording.rig == config.rig:
                file.note_config(config)

    def unconfigured(self) -> set[str]:
        """Rigs with an open file that has no configuration yet."""
        return {file.recording.rig for file in self._files.values() if not file.configurations}

    def fail(self, writer: RunWriter, error: OSError) -> None:
        """End the file of `writer`, which the disk let down, or which is not any more where it was."""
        for file in self._files.values():
            if file.writer is not writer:
                continue
            if isinstance(error, MovedError):
                file.moved = True
            else:
                file.fail(error)

    def ended(self, writer: RunWriter, error: OSError | None) -> None:
        """A file has ended: it has its name, or this is why not."""
        recording = self._ending.pop(writer)
        self._bytes_closed += writer.size
        if error is not None:
            self._report(recording, what_became_of(writer, error))

    def tick(self, now_ns: int) -> None:
        """Begin next files and end those that failed; some times a second."""
        failed = any(file.failure is not None for file in self._files.values())
        # Files that failed for want of space end before space is looked at, and set aside, again.
        if now_ns >= self._space_due_ns and not failed and not (self._space.full and self._ending):
            self._space_due_ns = now_ns + _SPACE_PERIOD_NS
            self._look_at_space()
        self._look_at_speed()
        for file in list(self._files.values()):
            if file.failure is not None:
                self._end_failed(file, file.failure)
            elif self._space.full:
                self._end_failed(file, OSError(errno.ENOSPC, "the disk is nearly full"))
            elif file.moved or self._is_due(file, now_ns):
                self._rotate(file)

    def release(self) -> None:
        """Give back what was set aside: the recorder ends."""
        self._space.release()

    # -- files ------------------------------------------------------------------------------------------------------

    def _next_part(self, recording: Recording, after: str = "") -> NextPart | None:
        folder = self.folder / recording.rig
        try:
            return next_part(folder, recording.session, after)
        except OSError as error:
            self._report(recording, f"{folder}: can't be recorded: {self._space.why(error)}")
            return None

    def _open(self, recording: Recording, part: NextPart) -> RunFile | None:
        about = Metadata("hilrig.session", self._session_values(recording, part))
        try:
            part.path.parent.mkdir(parents=True, exist_ok=True)
            writer = RunWriter(part.path, metadata=(about,), compress=self._compress)
        except OSError as error:
            self._report(recording, f"{part.path}: can't be recorded: {self._space.why(error)}")
            return None
        file = self._files[recording] = RunFile(recording, writer, self._clock, self._on_failure)
        self._disk.follow(writer)
        self._ask_config(recording.rig)
        self._trouble.pop(recording.rig, None)
        return file

    def _session_values(self, recording: Recording, part: NextPart) -> dict[str, str]:
        start = datetime.fromtimestamp(recording.start_wall_ns // SECOND_NS, UTC)
        return {
            "session": recording.session,
            "rig": recording.rig,
            "lab": self._lab,
            "controller": recording.controller,
            "keeper": recording.keeper,
            "start": start.strftime("%Y-%m-%dT%H:%M:%SZ"),
            "start_wall_ns": str(recording.start_wall_ns),
            "software_version": version("hilrig"),
            "schema_version": SCHEMA_VERSION,
            "machine": machine(),
            "recorder": f"recorder/{self._instance}",
            "part": str(part.number),
            "previous": part.previous.name if part.previous is not None else "",
        }

    def _is_due(self, file: RunFile, now_ns: int) -> bool:
        config = self._config
        too_large = config.rotate_mib and file.writer.size >= config.rotate_mib * MIB
        too_long = config.rotate_min and now_ns - file.opened_ns >= config.rotate_min * 60 * SECOND_NS
        return bool(too_large or too_long) and file.recording.end_wall_ns is None

    def _rotate(self, file: RunFile) -> None:
        recording = file.recording
        before = file.writer.path.name
        part = self._next_part(recording, before)
        following = None if part is None else self._open(recording, part)
        if following is None:
            # The old file goes on; the trouble was told.
            file.opened_ns = self._clock.monotonic_ns()
            file.moved = False
            return
        recording.sink = following
        self._finish(file, "continued", f"the session goes on in {following.writer.path.name}")
        recording.tally = Tally()
        for source, incarnation in file.sources:
            following.note_source(source, incarnation)

    def _finish(self, file: RunFile, end: str, reason: str) -> None:
        self._ending[file.writer] = file.recording
        self._disk.end(file.writer, file.ending(end, reason))

    # -- trouble ----------------------------------------------------------------------------------------------------

    def _on_failure(self, error: OSError) -> None:
        if error.errno in _NO_SPACE:
            # Every file on this disk ends now, while the space set aside is enough for all of them.
            self._space.run_out()

    def _end_failed(self, file: RunFile, error: OSError) -> None:
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
            self._tell(
                Event(
                    kind=Event.RECORDING,
                    rig=recording.rig,
                    session=recording.session,
                    severity=Event.ERROR,
                    text=text,
                )
            )

    def _look_at_speed(self) -> None:
        if self._disk.behind_s < SLOW_S:
            self._trouble.pop(_SPEED, None)
        elif _SPEED not in self._trouble:
            text = f"{self.folder}: the disk is slow: what comes is safe from a power cut after {SLOW_S:g} s and more"
            self._trouble[_SPEED] = text
            self._tell(Event(kind=Event.RECORDING, severity=Event.WARNING, text=text))

    def _look_at_space(self) -> None:
        text = self._space.look()
        if text:
            self._trouble[""] = text
            self._tell(Event(kind=Event.RECORDING, severity=Event.ERROR, text=text))
        elif not self._space.full:
            self._trouble.pop("", None)


def machine() -> str:
    """This machine, for people: system, processor, Python."""
    return f"{platform.system()} {platform.release()} {platform.machine()}, Python {platform.python_version()}"
