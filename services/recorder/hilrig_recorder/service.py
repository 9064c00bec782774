"""The recorder service: connects ingest queue, session tracker and file store, and runs the main loop."""

import contextlib
import logging
import os
import random
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_recorder.ingest.manual_sessions import ManualSessions
from hilrig_recorder.ingest.queue import IngestQueue
from hilrig_recorder.ingest.recording import SECOND_NS, Recording
from hilrig_recorder.ingest.rig_partition import RigPartition
from hilrig_recorder.ingest.sessions import SessionTracker
from hilrig_recorder.mcap_format.file_names import PART_SUFFIX
from hilrig_recorder.mcap_format.recover import read_session_metadata
from hilrig_recorder.storage.folder_lock import FolderLock
from hilrig_recorder.storage.maintenance import MaintenanceWorker, find_unfinished
from hilrig_recorder.storage.store import FileStore
from hilrig_recorder.storage.sync_worker import SyncWorker
from hilrig_runtime.errors import HilrigError, OperationError
from hilrig_runtime.messaging.recording_stream import FLUSH_PERIOD_NS
from hilrig_runtime.process.control import Handlers, handle_control_request
from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.rate import Rate
from hilrig_schemas import ControlReply, Event, OpenSession, RigConfig, RigReport, StartSession, StopSession
from hilrig_schemas.topics import CONFIG, CONTROL, LOG

TICK_PERIOD_NS: Final = SECOND_NS // 10
"""Period of the housekeeping between received batches."""
_CONFIG_TIMEOUT_S: Final = 0.8
_LOSS_LOG_PERIOD_NS: Final = 10 * SECOND_NS
"""Shortest time between two log messages about lost batches."""
_CONFIG_RETRY_NS: Final = 2 * SECOND_NS
_LAST_BATCHES_TIMEOUT_NS: Final = 3 * SECOND_NS // 10
"""Time after the stop request in which the recorder still receives the last batches of other services."""
_QUEUE_DRAIN_TIMEOUT_NS: Final = SECOND_NS // 2
"""Maximum time for writing the messages in the ingest queue at shutdown."""
_MAX_ARRIVAL_DELAY_NS: Final = 5 * SECOND_NS
"""Maximum delay with which an earlier recorder may have received messages that publishers now send again."""
_FINISH_TIMEOUT_S: Final = 0.3
"""Time for finishing and syncing files at shutdown; after it, files are finished without syncing."""

logger = logging.getLogger(__name__)


def run(service: Service) -> None:
    """Record every session of the lab until the service is stopped.

    Raises:
        OperationError: the folder of recordings can't be written, or another recorder records one of the rigs.
    """
    service.claim()
    with ExitStack() as closing:
        closing.callback(_lock_folder(service).close)
        recorder = Recorder(service)
        closing.callback(recorder.close)
        recorder.run()


def _lock_folder(service: Service) -> FolderLock:
    folder = service.lab.recorder.folder / service.lab.name
    probe = folder / f".probe-{service.incarnation}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
        return FolderLock(folder, service.instance, [rig.name for rig in service.rigs])
    except OSError as error:
        raise OperationError(
            f"{folder}: can't write recordings: {error.strerror}; choose another recorder.folder"
        ) from error


class Recorder:
    """A running recorder."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._clock = service.clock
        lab, config = service.lab, service.lab.recorder
        self._ticks = Rate(TICK_PERIOD_NS, service.clock)
        self._executor = OwnerThreadExecutor()
        """Processes control requests and the results of other threads on the recorder's thread."""
        self._config_due_ns: dict[str, int] = {}
        self._lost_batches_due_ns = 0
        self._config_executor = ThreadPoolExecutor(max_workers=2, thread_name_prefix="config")
        self._queue = IngestQueue(config.queue_entries, service.clock, service.counters)
        self._sync_worker = SyncWorker(
            service.clock,
            on_sync_error=lambda writer, error: self._executor.post(lambda: self._store.fail(writer, error)),
            on_finished=lambda writer, error: self._executor.post(lambda: self._store.finished(writer, error)),
        )
        self._store = FileStore(
            lab.name,
            config,
            service.clock,
            self._sync_worker,
            instance=service.instance,
            repeated_ns=service.batch_cache_depth * FLUSH_PERIOD_NS + _MAX_ARRIVAL_DELAY_NS,
            emit=self._emit,
            request_config=self._request_config,
            on_failed=self._on_failed,
        )
        partition = RigPartition([rig.name for rig in lab.rigs], [rig.name for rig in service.rigs])
        self._sessions = SessionTracker(
            lab.name, config.preroll_s, self._store, partition.contains, lab.bus.may_serve, service.counters
        )
        self._manual_sessions = ManualSessions(
            lambda rig: (
                partition.contains_configured(rig) or (partition.contains(rig) and self._sessions.has_received(rig))
            ),
            random.Random(service.incarnation),
        )
        unfinished = [path for path in find_unfinished(self._store.folder) if partition.contains(path.parent.name)]
        self._restore(unfinished)
        self._stream = service.bus.subscribe_recording(
            LOG.key(lab.name, "*", "*"), self._queue.put, service.batch_cache_depth
        )
        handlers: Handlers = {"start_session": self._start_session, "stop_session": self._stop_session}
        self._control = self._executor.serve(
            service.bus,
            CONTROL.key(lab.name, service.name, service.instance),
            partial(handle_control_request, handlers),
        )
        service.health.rig_reports = self._rig_reports
        service.last_received = self._sessions.last_received
        self._maintenance = MaintenanceWorker(
            self._store.folder,
            unfinished,
            config,
            service.clock,
            lambda text: self._executor.post(lambda: self._emit_error(text)),
        )

    def _restore(self, unfinished: list[Path]) -> None:
        for path in unfinished:
            with contextlib.suppress(HilrigError, ValueError, KeyError):
                session = read_session_metadata(path)
                if session.get("keeper") == self._service.source:
                    start_wall_ns = int(session["start_wall_ns"])
                    self._manual_sessions.restore(
                        OpenSession(rig=session["rig"], session=session["session"], start_wall_ns=start_wall_ns)
                    )

    # -- main loop --------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Record until the service is stopped, then record the messages published before."""
        service, clock = self._service, self._clock
        service.recording_stream.set_sessions(self._manual_sessions.sessions)
        service.ready()
        while not service.stopping.is_set():
            self._run_once()
        # Receive the last batches for a short time, then write the messages in the queue.
        deadline_ns = clock.monotonic_ns() + _LAST_BATCHES_TIMEOUT_NS
        while self._sessions.recordings and clock.monotonic_ns() < deadline_ns:
            self._run_once()
        self._stream.close()
        deadline_ns = clock.monotonic_ns() + _QUEUE_DRAIN_TIMEOUT_NS
        while self._queue.depth > 0 and clock.monotonic_ns() < deadline_ns:
            self._run_once()

    def _run_once(self) -> None:
        now_ns = self._clock.monotonic_ns()
        if now_ns >= self._ticks.next_ns:
            self._tick(now_ns)
            # The next tick is due one period after this one ends, so that a long tick does not delay received batches.
            self._ticks.restart()
            now_ns = self._clock.monotonic_ns()
        received = self._queue.get(self._ticks.remaining_s)
        if received is not None:
            self._sessions.accept(received, now_ns)

    def _tick(self, now_ns: int) -> None:
        self._sessions.tick(now_ns, self._clock.wall_ns())
        self._executor.run_pending()
        self._log_lost_batches(now_ns)
        self._store.tick(now_ns)
        for rig in self._store.unconfigured():
            if now_ns >= self._config_due_ns.get(rig, 0):
                self._request_config(rig)
        self._report(now_ns)

    def _report(self, now_ns: int) -> None:
        counters, queue, sessions = self._service.counters, self._queue, self._sessions
        counters.received = queue.received
        counters.queue_depth, counters.queue_capacity = queue.depth, queue.capacity
        counters.lost_transport, counters.lost_recorder = sessions.lost_transport, queue.dropped
        counters.recordings = len(sessions.recordings)
        counters.rigs = len({recording.rig for recording in sessions.recordings})
        counters.bytes_written = self._store.bytes_written
        counters.alert = self._store.alert
        self._service.beat(now_ns)

    def _rig_reports(self) -> list[RigReport]:
        return [
            RigReport(rig=rig, recording=True) for rig in {recording.rig for recording in self._sessions.recordings}
        ]

    def _emit(self, *events: Event) -> None:
        logger.log(logging.INFO if events[0].severity == Event.INFO else logging.WARNING, "%s", events[0].text)
        for event in events:
            # Events are recorded: they contain paths below the folder of recordings only.
            event.text = event.text.replace(f"{self._service.lab.recorder.folder}{os.sep}", "")
            self._service.emit(event)

    def _emit_error(self, text: str) -> None:
        self._emit(Event(kind=Event.RECORDING, severity=Event.ERROR, text=text))

    def _on_failed(self, recording: Recording) -> None:
        self._sessions.drop(recording)

    def _log_lost_batches(self, now_ns: int) -> None:
        lost = self._sessions.lost_batches
        if lost and now_ns >= self._lost_batches_due_ns:
            self._lost_batches_due_ns = now_ns + _LOSS_LOG_PERIOD_NS
            for source, batches in lost.items():
                logger.warning("%d batches of the recording stream of %s were lost in transport", batches, source)
            lost.clear()

    # -- manual sessions --------------------------------------------------------------------------------------------

    def _start_session(self, request: StartSession) -> ControlReply:
        return self._publish_session(self._manual_sessions.start(request.rig, self._clock.wall_ns()))

    def _stop_session(self, request: StopSession) -> ControlReply:
        return self._publish_session(self._manual_sessions.stop(request.rig))

    def _publish_session(self, event: Event) -> ControlReply:
        self._service.emit(event)
        self._service.recording_stream.set_sessions(self._manual_sessions.sessions)
        return ControlReply(text=event.text, session=event.session)

    # -- configuration of rigs --------------------------------------------------------------------------------------

    def _request_config(self, rig: str) -> None:
        # A request is pending, or is retried later.
        if self._config_due_ns.get(rig, 0) > self._clock.monotonic_ns():
            return
        self._config_due_ns[rig] = self._clock.monotonic_ns() + 3600 * SECOND_NS
        self._config_executor.submit(self._fetch_config, rig)

    def _fetch_config(self, rig: str) -> None:
        config = None
        key = CONFIG.key(self._service.lab.name, rig)
        try:
            for reply in self._service.bus.query(key, timeout_s=_CONFIG_TIMEOUT_S):
                if not reply.error:
                    config = CONFIG.decode_from(reply.key, reply.payload)
        except DecodeError as error:
            self._service.counters.reject(key, error)
        except OperationError as error:
            logger.warning("%s: configuration can't be read: %s", rig, error)
        finally:
            self._executor.post(lambda: self._accept_config(rig, config))

    def _accept_config(self, rig: str, config: RigConfig | None) -> None:
        if config is None:
            self._config_due_ns[rig] = self._clock.monotonic_ns() + _CONFIG_RETRY_NS
        else:
            self._config_due_ns.pop(rig, None)
            self._store.configure(config)

    # -- shutdown ---------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Stop all threads and finish every file."""
        self._stream.close()
        self._control.close()
        self._config_executor.shutdown(wait=False, cancel_futures=True)
        self._sessions.stop()
        if not self._sync_worker.close(_FINISH_TIMEOUT_S):
            logger.error(
                "the disk is too slow: some files keep the suffix %s; they will be recovered at the next start",
                PART_SUFFIX,
            )
        self._maintenance.close()
        self._store.release()
