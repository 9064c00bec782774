"""The recorder as a service: the wiring of intake, sessions, files and disk, and the loop that drives them."""

import contextlib
import logging
import random
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_recorder.ingest.manual_sessions import HandSessions
from hilrig_recorder.ingest.queue import Intake
from hilrig_recorder.ingest.recording import SECOND_NS, Recording
from hilrig_recorder.ingest.rig_partition import Share
from hilrig_recorder.ingest.sessions import SessionBook
from hilrig_recorder.mcap_format.recover import session_of
from hilrig_recorder.mcap_format.writer import RunWriter
from hilrig_recorder.storage.folder_lock import FolderLock
from hilrig_recorder.storage.maintenance import Housekeeping, unfinished
from hilrig_recorder.storage.store import Files
from hilrig_recorder.storage.sync_worker import Disk
from hilrig_runtime.errors import HilrigError, OperationError
from hilrig_runtime.messaging.recording_stream import FLUSH_PERIOD_NS
from hilrig_runtime.process.service import Service
from hilrig_schemas import Event, OpenSession, RigConfig, RigReport
from hilrig_schemas.topics import CONFIG, CONTROL, LOG

TICK_NS: Final = SECOND_NS // 10
_CONFIG_TIMEOUT_S: Final = 0.8
_CONFIG_RETRY_NS: Final = 2 * SECOND_NS
_ANSWER_TIMEOUT_S: Final = 1.0
_LAST_BATCHES_NS: Final = 3 * SECOND_NS // 10
"""When it is told to stop, the recorder waits so long for what the others still have to say."""
_DRAIN_NS: Final = SECOND_NS // 2
_REPEATED_LATE_NS: Final = 5 * SECOND_NS
"""What a sender repeats may have arrived at an earlier recorder so much later than it was sent."""
_FINISH_TIMEOUT_S: Final = 0.3

logger = logging.getLogger(__name__)


def run(service: Service) -> None:
    """Record every session of the lab until the service is told to stop.

    Raises:
        OperationError: the folder for recordings can't be written, or another recorder records one of the rigs.
    """
    service.claim()
    with ExitStack() as closing:
        closing.enter_context(_own_folder(service))
        recorder = Recorder(service)
        closing.callback(recorder.close)
        recorder.run()


def _own_folder(service: Service) -> FolderLock:
    folder = service.lab.recorder.folder / service.lab.name
    probe = folder / f".probe-{service.incarnation}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
        return FolderLock(folder, service.instance, [rig.name for rig in service.rigs])
    except OSError as error:
        raise OperationError(
            f"{folder}: recordings can't be written there: {error.strerror}; choose another recorder.folder"
        ) from error


@dataclass(slots=True)
class _Request:
    """What a person asked for, on its way to the recorder's thread and back."""

    event: Event
    answer: Event = field(default_factory=Event)
    refusal: str = ""
    done: threading.Event = field(default_factory=threading.Event)


class Recorder:
    """What a running recorder has."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._clock = service.clock
        lab, config = service.lab, service.lab.recorder
        # What other threads have to say; the recorder's thread listens.
        self._troubles: SimpleQueue[tuple[RunWriter, OSError] | str] = SimpleQueue()
        self._ended: SimpleQueue[tuple[RunWriter, OSError | None]] = SimpleQueue()
        self._configs: SimpleQueue[tuple[str, RigConfig | None]] = SimpleQueue()
        self._requests: SimpleQueue[_Request] = SimpleQueue()
        self._asked: dict[str, int] = {}
        self._asking = ThreadPoolExecutor(max_workers=2, thread_name_prefix="asking")
        self._intake = Intake(config.queue_entries, service.clock)
        self._disk = Disk(
            service.clock,
            on_trouble=lambda writer, error: self._troubles.put((writer, error)),
            on_ended=lambda writer, error: self._ended.put((writer, error)),
        )
        self._files = Files(
            lab.name,
            config,
            service.clock,
            self._disk,
            instance=service.instance,
            repeated_ns=service.batch_cache_depth * FLUSH_PERIOD_NS + _REPEATED_LATE_NS,
            tell=self._tell,
            ask_config=self._ask_config,
            give_up=self._give_up,
        )
        share = Share([rig.name for rig in lab.rigs], [rig.name for rig in service.rigs])
        self._book = SessionBook(lab.name, config.preroll_s, self._files, share.has)
        self._by_hand = HandSessions(
            lambda rig: share.lists(rig) or (share.has(rig) and self._book.has_heard_of(rig)),
            random.Random(service.incarnation),
        )
        parts = [part for part in unfinished(self._files.folder) if share.has(part.parent.name)]
        self._restore(parts)
        self._stream = service.bus.subscribe_recording(
            LOG.key(lab.name, "*", "*"), self._intake.offer, self._on_loss, service.batch_cache_depth
        )
        self._control = service.bus.declare_queryable(
            CONTROL.key(lab.name, service.name, service.instance), self._answer
        )
        service.health.rig_reports = self._rig_reports
        self._housekeeping = Housekeeping(self._files.folder, parts, config, service.clock, self._troubles.put)

    def _restore(self, parts: list[Path]) -> None:
        for part in parts:
            with contextlib.suppress(HilrigError, ValueError):
                session = session_of(part)
                if session.get("keeper") == self._service.source:
                    start_wall_ns = int(session["start_wall_ns"])
                    self._by_hand.restore(
                        OpenSession(rig=session["rig"], session=session["session"], start_wall_ns=start_wall_ns)
                    )

    # -- the loop ---------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Record until the service is told to stop, then what was sent before that."""
        service, clock = self._service, self._clock
        due_ns = clock.monotonic_ns()
        service.recording_stream.set_sessions(self._by_hand.sessions)
        service.ready()
        while not service.stopping.is_set():
            due_ns = self._turn(due_ns)
        # What may still arrive is waited for a little while, and what has arrived is written.
        deadline_ns = clock.monotonic_ns() + _LAST_BATCHES_NS
        while self._book.recordings and clock.monotonic_ns() < deadline_ns:
            due_ns = self._turn(due_ns)
        self._stream.close()
        deadline_ns = clock.monotonic_ns() + _DRAIN_NS
        while self._intake.depth > 0 and clock.monotonic_ns() < deadline_ns:
            due_ns = self._turn(due_ns)

    def _turn(self, due_ns: int) -> int:
        now_ns = self._clock.monotonic_ns()
        if now_ns >= due_ns:
            self._tick(now_ns)
            # Counted from here: after a long one what has come meanwhile is taken first.
            now_ns = self._clock.monotonic_ns()
            due_ns = now_ns + TICK_NS
        arrival = self._intake.take(max(0.0, (due_ns - now_ns) * 1e-9))
        if arrival is not None:
            self._book.accept(arrival, now_ns)
        return due_ns

    def _tick(self, now_ns: int) -> None:
        self._book.tick(now_ns, self._clock.wall_ns())
        self._hear()
        self._files.tick(now_ns)
        for rig in self._files.unconfigured():
            if now_ns >= self._asked.get(rig, 0):
                self._ask_config(rig)
        self._report(now_ns)

    def _hear(self) -> None:
        with contextlib.suppress(Empty):
            while True:
                trouble = self._troubles.get_nowait()
                if isinstance(trouble, str):
                    self._tell(Event(kind=Event.RECORDING, severity=Event.ERROR, text=trouble))
                else:
                    self._files.fail(*trouble)
        with contextlib.suppress(Empty):
            while True:
                self._files.ended(*self._ended.get_nowait())
        with contextlib.suppress(Empty):
            while True:
                self._take_config(*self._configs.get_nowait())
        with contextlib.suppress(Empty):
            while True:
                self._do(self._requests.get_nowait())

    def _report(self, now_ns: int) -> None:
        counters, intake, book = self._service.counters, self._intake, self._book
        counters.received = intake.received
        counters.queue_depth, counters.queue_capacity = intake.depth, intake.capacity
        counters.lost_transport, counters.lost_recorder = book.lost_transport, intake.dropped
        counters.malformed = intake.malformed
        counters.recordings = len(book.recordings)
        counters.rigs = len({recording.rig for recording in book.recordings})
        counters.bytes_written = self._files.bytes_written
        counters.alert = self._files.trouble
        self._service.beat(now_ns)

    def _rig_reports(self) -> list[RigReport]:
        return [RigReport(rig=rig, recording=True) for rig in {recording.rig for recording in self._book.recordings}]

    def _tell(self, event: Event) -> None:
        logger.warning("%s", event.text)
        self._service.emit(event)

    def _give_up(self, recording: Recording) -> None:
        self._book.drop(recording)

    @staticmethod
    def _on_loss(batches: int) -> None:
        # What was lost is counted from the sequence numbers, where it is known to whom it belonged.
        logger.warning("%d batches of a log stream were lost on the way", batches)

    # -- sessions by hand -------------------------------------------------------------------------------------------

    def _answer(self, payload: bytes) -> bytes:
        """Answer a question; on a thread of the bus, so the recorder's own thread does it."""
        try:
            request = _Request(Event.FromString(payload))
        except DecodeError as error:
            raise OperationError("a request that can't be decoded") from error
        self._requests.put(request)
        if not request.done.wait(_ANSWER_TIMEOUT_S):
            raise OperationError("the recorder is too busy to answer")
        if request.refusal:
            raise OperationError(request.refusal)
        return request.answer.SerializeToString()

    def _do(self, request: _Request) -> None:
        event = request.event
        try:
            if event.kind == Event.SESSION_START:
                request.answer = self._by_hand.begin(event.rig, self._clock.wall_ns())
            elif event.kind == Event.SESSION_END:
                request.answer = self._by_hand.end(event.rig)
            else:
                raise OperationError("a request that the recorder does not know")
            self._service.emit(request.answer)
            self._service.recording_stream.set_sessions(self._by_hand.sessions)
        except HilrigError as error:
            request.refusal = str(error)
        request.done.set()

    # -- questions to others ----------------------------------------------------------------------------------------

    def _ask_config(self, rig: str) -> None:
        # Not again while an answer is awaited.
        if self._asked.get(rig, 0) > self._clock.monotonic_ns():
            return
        self._asked[rig] = self._clock.monotonic_ns() + 3600 * SECOND_NS
        self._asking.submit(self._fetch_config, rig)

    def _fetch_config(self, rig: str) -> None:
        config = None
        try:
            key = CONFIG.key(self._service.lab.name, rig)
            for answer in self._service.bus.query(key, timeout_s=_CONFIG_TIMEOUT_S):
                if not answer.error:
                    config = CONFIG.decode(answer.payload)
        except (DecodeError, OperationError) as error:
            logger.warning("configuration of %s: %s", rig, error)
        finally:
            self._configs.put((rig, config))

    def _take_config(self, rig: str, config: RigConfig | None) -> None:
        if config is None:
            self._asked[rig] = self._clock.monotonic_ns() + _CONFIG_RETRY_NS
        else:
            self._asked.pop(rig, None)
            self._files.configure(config)

    # -- the end ----------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Finish every file."""
        self._stream.close()
        self._control.close()
        self._asking.shutdown(wait=False, cancel_futures=True)
        self._book.stop()
        if not self._disk.close(_FINISH_TIMEOUT_S):
            logger.error("the disk is too slow: some files keep their .part name, to be recovered")
        self._housekeeping.close()
        self._files.release()
