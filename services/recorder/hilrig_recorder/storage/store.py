"""The store of recordings, `<folder>/<lab>/<rig>/<session>.mcap`: opens, rotates and finishes the files."""

import errno
import platform
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Final

from mcap.records import Metadata

from hilrig_recorder.ingest.recording import SECOND_NS, LossCounters, Recording
from hilrig_recorder.mcap_format.channels import SCHEMA_VERSION
from hilrig_recorder.mcap_format.chunk import compressor
from hilrig_recorder.mcap_format.ending import Ending
from hilrig_recorder.mcap_format.writer import FileReplacedError, RecordingWriter
from hilrig_recorder.storage.disk_reserve import MIB, DiskReserve
from hilrig_recorder.storage.segment_file import SegmentFile
from hilrig_recorder.storage.segments import NextSegment, horizon_by_channel, next_segment, read_session_tail
from hilrig_recorder.storage.sync_worker import SyncWorker, describe_failure
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, RigConfig

MAX_ALERTS_IN_REPORT: Final = 3
"""Maximum number of alerts named in a health report; each alert is also an event and a log line."""
SLOW_SYNC_S: Final = 5.0
"""An alert is raised when written data is not synced within this time."""
MAX_SESSIONS: Final = 4096
"""Maximum number of sessions whose newest segment is remembered."""
_SPEED_ALERT: Final = " speed"
"""Key of the alert about a slow disk; not a valid rig name."""
_SPACE_ALERT: Final = ""
"""Key of the alert about disk space; not a valid rig name."""
_SPACE_CHECK_PERIOD_NS: Final = SECOND_NS
_NO_SPACE_ERRORS: Final = (errno.ENOSPC, errno.EDQUOT)


class FileStore:
    """The files of the recordings; only the recorder's thread uses it. Implements `ingest.recording.RecordingStore`.

    Args:
        lab: name of the lab.
        config: the recorder's configuration.
        clock: the clock.
        sync_worker: syncs and finishes the files.
        instance: instance name of the recorder.
        repeated_ns: maximum age of the messages that publishers send again after a restart of the recorder, ns.
        emit: publishes events for the operator, of several rigs about the same; logs them as one message.
        request_config: requests the configuration of a rig.
        on_failed: called with a recording whose file failed.
    """

    def __init__(
        self,
        lab: str,
        config: RecorderConfig,
        clock: Clock,
        sync_worker: SyncWorker,
        *,
        instance: str,
        repeated_ns: int,
        emit: Callable[..., None],
        request_config: Callable[[str], None],
        on_failed: Callable[[Recording], None],
    ) -> None:
        self.folder = config.folder / lab
        self._lab = lab
        self._config = config
        self._clock = clock
        self._sync_worker = sync_worker
        self._instance = instance
        self._repeated_ns = repeated_ns
        self._emit = emit
        self._request_config = request_config
        self._on_failed = on_failed
        self._files: dict[Recording, SegmentFile] = {}
        self._finishing: dict[RecordingWriter, Recording] = {}
        self._last_tick_ns = clock.monotonic_ns()
        self._speed_valid_ns = 0
        self._newest: dict[str, str] = {}
        """Name of the newest segment of each session: its folder may be replaced, and restored later."""
        self._alerts: dict[str, str] = {}
        self._reserve = DiskReserve(self.folder, instance, config.min_free_mib)
        self._space_due_ns = 0
        self._bytes_finished = 0
        self._compress = compressor()

    @property
    def alert(self) -> str:
        """The current alerts for the operator; empty: none."""
        alerts = list(self._alerts.values())
        more = len(alerts) - MAX_ALERTS_IN_REPORT
        return "; ".join(alerts[:MAX_ALERTS_IN_REPORT]) + (f"; and {more} more" if more > 0 else "")

    @property
    def bytes_written(self) -> int:
        """Bytes written to files since the start."""
        writers = [*self._finishing, *(file.writer for file in self._files.values())]
        return self._bytes_finished + sum(writer.size for writer in writers)

    # -- RecordingStore ---------------------------------------------------------------------------------------------

    def open(self, recording: Recording) -> bool:
        """Open the next segment of a recording; False: the session has ended, or the file can't be opened."""
        folder = self.folder / recording.rig
        segment = self._next_segment(recording)
        if segment is None:
            return False
        if segment.previous is not None:
            tail = read_session_tail(folder, recording.session, segment.number - 1, self._repeated_ns)
            if tail.end == Ending.ENDED:
                return False
            recording.seen, recording.last = tail.keys, tail.last
            recording.horizon_ns = horizon_by_channel(tail)
        return not self._reserve.is_exhausted and self._open(recording, segment) is not None

    def close(self, recording: Recording, end: Ending, reason: str) -> None:
        """Finish the file of a recording in the background."""
        recording.file = None
        file = self._files.pop(recording, None)
        if file is not None:
            self._finish(file, end, reason)

    def record_loss(self, recording: Recording, source: str, key: str, transport: int, recorder: int) -> None:
        """Record a loss in the file of a recording."""
        file = self._files.get(recording)
        if file is not None:
            file.record_loss(source, key, transport, recorder)

    def record_source(self, recording: Recording, source: str, incarnation: int) -> None:
        """Record in the file that an instance of a service contributes; request the configuration if it is new."""
        file = self._files.get(recording)
        if file is not None and file.record_source(source, incarnation):
            self._request_config(recording.rig)

    def report_outage(self, recordings: Sequence[Recording], text: str, *, has_ended: bool) -> None:
        """Emit an event of each recording's rig, and log one message."""
        severity = Event.INFO if has_ended else Event.WARNING
        self._emit(
            *(
                Event(kind=Event.RECORDING, severity=severity, text=text, rig=recording.rig, session=recording.session)
                for recording in recordings
            )
        )

    def report_rejected(self, message: str) -> None:
        """Emit a warning about input that is not recorded."""
        self._emit(Event(kind=Event.RECORDING, severity=Event.WARNING, text=f"not recorded: {message}"))

    # -- calls of the service ---------------------------------------------------------------------------------------

    def configure(self, config: RigConfig) -> None:
        """Add the configuration of a rig to its open files, unless they contain it."""
        for file in self._files.values():
            if file.recording.rig == config.rig:
                file.record_config(config)

    def unconfigured(self) -> set[str]:
        """Rigs with an open file that has no configuration yet."""
        return {file.recording.rig for file in self._files.values() if not file.configurations}

    def fail(self, writer: RecordingWriter, error: OSError) -> None:
        """Handle an error of syncing an open file."""
        for file in self._files.values():
            if file.writer is not writer:
                continue
            if isinstance(error, FileReplacedError):
                file.is_replaced = True
            else:
                file.fail(error)

    def finished(self, writer: RecordingWriter, error: OSError | None) -> None:
        """Handle the end of a file: it is renamed, or failed with an error."""
        recording = self._finishing.pop(writer)
        self._bytes_finished += writer.size
        if error is not None:
            self._report(recording, describe_failure(writer, error))

    def tick(self, now_ns: int) -> None:
        """Rotate files and finish failed ones; called several times per second."""
        failed = any(file.failure is not None for file in self._files.values())
        # Files that failed for lack of space are finished before the space is checked and reserved again.
        if now_ns >= self._space_due_ns and not failed and not (self._reserve.is_exhausted and self._finishing):
            self._space_due_ns = now_ns + _SPACE_CHECK_PERIOD_NS
            self._check_space()
        self._check_speed(now_ns)
        for file in list(self._files.values()):
            if file.failure is not None:
                self._finish_failed(file, file.failure)
            elif self._reserve.is_exhausted:
                self._finish_failed(file, OSError(errno.ENOSPC, "the disk is nearly full"))
            elif file.is_replaced or self._is_due(file, now_ns):
                self._rotate(file)

    def release(self) -> None:
        """Release the reserved disk space, because the recorder stops."""
        self._reserve.release()

    # -- files ------------------------------------------------------------------------------------------------------

    def _next_segment(self, recording: Recording, after: str = "") -> NextSegment | None:
        folder = self.folder / recording.rig
        try:
            return next_segment(folder, recording.session, after or self._newest.get(recording.session, ""))
        except OSError as error:
            self._report(recording, f"{folder}: can't be recorded: {self._reserve.describe_error(error)}")
            return None

    def _open(self, recording: Recording, segment: NextSegment) -> SegmentFile | None:
        session = Metadata("hilrig.session", self._session_metadata(recording, segment))
        try:
            segment.path.parent.mkdir(parents=True, exist_ok=True)
            writer = RecordingWriter(segment.path, metadata=(session,), compress=self._compress)
        except OSError as error:
            self._report(recording, f"{segment.path}: can't be recorded: {self._reserve.describe_error(error)}")
            return None
        self._newest[recording.session] = segment.path.name
        if len(self._newest) > MAX_SESSIONS:
            del self._newest[next(iter(self._newest))]
        file = self._files[recording] = SegmentFile(recording, writer, self._clock, self._on_failure)
        recording.file = file
        self._sync_worker.follow(writer)
        self._request_config(recording.rig)
        self._alerts.pop(recording.rig, None)
        return file

    def _session_metadata(self, recording: Recording, segment: NextSegment) -> dict[str, str]:
        start = datetime.fromtimestamp(recording.start_wall_ns // SECOND_NS, UTC)
        return {
            "session": recording.session,
            "rig": recording.rig,
            "lab": self._lab,
            "controller": recording.controller,
            "certificate": recording.certificate,
            **({"student": recording.student} if recording.student else {}),
            "keeper": recording.owner,
            "start": start.strftime("%Y-%m-%dT%H:%M:%SZ"),
            "start_wall_ns": str(recording.start_wall_ns),
            "software_version": version("hilrig"),
            "schema_version": SCHEMA_VERSION,
            "machine": machine(),
            "recorder": f"recorder/{self._instance}",
            "part": str(segment.number),
            "previous": segment.previous.name if segment.previous is not None else "",
        }

    def _is_due(self, file: SegmentFile, now_ns: int) -> bool:
        config = self._config
        too_large = config.rotate_mib and file.writer.size >= config.rotate_mib * MIB
        too_long = config.rotate_min and now_ns - file.opened_ns >= config.rotate_min * 60 * SECOND_NS
        return bool(too_large or too_long) and file.recording.end_wall_ns is None

    def _rotate(self, file: SegmentFile) -> None:
        recording = file.recording
        before = file.writer.path.name
        segment = self._next_segment(recording, before)
        following = None if segment is None else self._open(recording, segment)
        if following is None:
            # The error was reported. Recording continues in the old file.
            file.opened_ns = self._clock.monotonic_ns()
            file.is_replaced = False
            return
        self._finish(file, Ending.CONTINUED, f"the session continues in {following.writer.path.name}")
        recording.counters = LossCounters()
        for source, incarnation in file.sources:
            following.record_source(source, incarnation)

    def _finish(self, file: SegmentFile, end: Ending, reason: str) -> None:
        self._finishing[file.writer] = file.recording
        self._sync_worker.finish(file.writer, file.finisher(end, reason))

    # -- errors -----------------------------------------------------------------------------------------------------

    def _on_failure(self, error: OSError) -> None:
        if error.errno in _NO_SPACE_ERRORS:
            # Every file on this disk is finished now, while the reserved space suffices for all of them.
            self._reserve.mark_exhausted()

    def _finish_failed(self, file: SegmentFile, error: OSError) -> None:
        recording = file.recording
        recording.file = None
        del self._files[recording]
        end = Ending.DISK_FULL if error.errno in _NO_SPACE_ERRORS else Ending.WRITE_FAILED
        reason = f"{error.strerror}; the recording ends here"
        # The file contains its name only: the path could reveal the name of a user.
        self._finish(file, end, f"{file.writer.path.name}: {reason}")
        self._report(recording, f"{file.writer.path}: {reason}")
        self._on_failed(recording)

    def _report(self, recording: Recording, text: str) -> None:
        self._raise_alert(recording.rig, text, Event.ERROR, rig=recording.rig, session=recording.session)

    def _raise_alert(self, key: str, text: str, severity: Event.Severity, *, rig: str = "", session: str = "") -> None:
        """Set the alert `key`, and emit an event if it changed."""
        if self._alerts.get(key) != text:
            self._alerts[key] = text
            self._emit(Event(kind=Event.RECORDING, severity=severity, text=text, rig=rig, session=session))

    def _check_speed(self, now_ns: int) -> None:
        if now_ns - self._last_tick_ns > SECOND_NS:
            # This process was stopped or starved: the syncs of that time say nothing about the disk.
            self._speed_valid_ns = now_ns + round(SLOW_SYNC_S * SECOND_NS)
        self._last_tick_ns = now_ns
        if now_ns < self._speed_valid_ns:
            return
        if self._sync_worker.sync_delay_s < SLOW_SYNC_S:
            self._alerts.pop(_SPEED_ALERT, None)
        else:
            text = f"{self.folder}: slow disk: a power failure may lose the last {SLOW_SYNC_S:g} s or more"
            self._raise_alert(_SPEED_ALERT, text, Event.WARNING)

    def _check_space(self) -> None:
        text = self._reserve.refresh()
        if text:
            self._raise_alert(_SPACE_ALERT, text, Event.ERROR)
        elif not self._reserve.is_exhausted:
            self._alerts.pop(_SPACE_ALERT, None)


def machine() -> str:
    """Human-readable description of this machine: system, processor, Python."""
    return f"{platform.system()} {platform.release()} {platform.machine()}, Python {platform.python_version()}"
