"""The recorder as a service: the wiring of intake, sessions, files and disk, and the loop that drives them."""

import contextlib
import logging
from concurrent.futures import ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_recorder.disk import Disk
from hilrig_recorder.files import Files
from hilrig_recorder.intake import Intake
from hilrig_recorder.sessions import SECOND_NS, Recording, SessionBook
from hilrig_recorder.writer import RunWriter
from hilrig_runtime.errors import OperationError
from hilrig_runtime.service import Service
from hilrig_schemas import Event, RigConfig
from hilrig_schemas.topics import CONFIG, LOG

TICK_NS: Final = SECOND_NS // 10
_CONFIG_TIMEOUT_S: Final = 0.8
_CONFIG_RETRY_NS: Final = 2 * SECOND_NS
_LAST_BATCHES_NS: Final = SECOND_NS // 2
"""When it is told to stop, the recorder waits so long for what the others still have to say."""
_FINISH_TIMEOUT_S: Final = 0.5

logger = logging.getLogger(__name__)


def run(service: Service) -> None:
    """Record every session of the lab until the service is told to stop.

    Raises:
        OperationError: the folder for recordings can't be written.
    """
    recorder = Recorder(service)
    try:
        recorder.run()
    finally:
        recorder.close()


class Recorder:
    """What a running recorder has."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._clock = service.clock
        config = service.lab.recorder
        self._check_folder(service)
        self._intake = Intake(config.queue_entries, service.clock)
        # What other threads have to say; the recorder's thread listens.
        self._troubles: SimpleQueue[tuple[RunWriter, OSError]] = SimpleQueue()
        self._configs: SimpleQueue[tuple[str, RigConfig | None]] = SimpleQueue()
        self._asked: dict[str, int] = {}
        self._asking = ThreadPoolExecutor(max_workers=2, thread_name_prefix="config")
        self._disk = Disk(
            service.clock,
            on_trouble=lambda writer, error: self._troubles.put((writer, error)),
            on_published=lambda writer: logger.info("recorded %s", writer.path),
        )
        self._files = Files(
            service.lab.name,
            config,
            service.clock,
            self._disk,
            source=service.source,
            tell=self._tell,
            ask_config=self._ask_config,
            give_up=self._give_up,
        )
        self._book = SessionBook(service.lab.name, config.preroll_s, self._files)
        self._stream = service.bus.subscribe_recording(
            LOG.key(service.lab.name, "*", "*"), self._intake.offer, self._on_loss
        )

    @staticmethod
    def _check_folder(service: Service) -> None:
        folder = service.lab.recorder.folder / service.lab.name
        probe = folder / f".probe-{service.incarnation}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise OperationError(
                f"{folder}: recordings can't be written there: {error.strerror}; choose another recorder.folder"
            ) from error

    def run(self) -> None:
        """Record until the service is told to stop, then what was sent before that."""
        service, clock = self._service, self._clock
        due_ns = clock.monotonic_ns()
        service.ready()
        while not service.stopping.is_set():
            due_ns = self._turn(due_ns)
        deadline_ns = clock.monotonic_ns() + _LAST_BATCHES_NS
        while self._goes_on(deadline_ns):
            due_ns = self._turn(due_ns)

    def _goes_on(self, deadline_ns: int) -> bool:
        # What has arrived is written in any case; what may still arrive is waited for a little while.
        return self._intake.depth > 0 or bool(self._book.recordings and self._clock.monotonic_ns() < deadline_ns)

    def _turn(self, due_ns: int) -> int:
        now_ns = self._clock.monotonic_ns()
        if now_ns >= due_ns:
            self._tick(now_ns)
            due_ns = max(due_ns + TICK_NS, now_ns)
        arrival = self._intake.take(max(0.0, (due_ns - now_ns) * 1e-9))
        if arrival is not None:
            self._book.accept(arrival, now_ns)
        return due_ns

    def _tick(self, now_ns: int) -> None:
        self._book.tick(now_ns, self._clock.wall_ns())
        with contextlib.suppress(Empty):
            while True:
                self._files.fail(*self._troubles.get_nowait())
        with contextlib.suppress(Empty):
            while True:
                rig, config = self._configs.get_nowait()
                if config is None:
                    self._asked[rig] = now_ns + _CONFIG_RETRY_NS
                else:
                    self._asked.pop(rig, None)
                    self._files.configure(config)
        self._files.tick(now_ns)
        for rig in self._files.unconfigured():
            if now_ns >= self._asked.get(rig, 0):
                self._ask_config(rig)
        self._report(now_ns)

    def _report(self, now_ns: int) -> None:
        counters, intake, book = self._service.counters, self._intake, self._book
        counters.received = intake.received
        counters.queue_depth, counters.queue_capacity = intake.depth, intake.capacity
        counters.lost_transport, counters.lost_recorder = book.lost_transport, intake.dropped
        counters.malformed = intake.malformed
        counters.recordings = len(book.recordings)
        counters.rigs = len({recording.rig for recording in book.recordings})
        counters.bytes_written = self._files.bytes_written
        counters.trouble = self._files.trouble
        self._service.beat(now_ns)

    @staticmethod
    def _on_loss(batches: int) -> None:
        # What was lost is counted from the sequence numbers, where it is known to whom it belonged.
        logger.warning("%d batches of a log stream were lost on the way", batches)

    def _give_up(self, recording: Recording) -> None:
        self._book.drop(recording)

    def _tell(self, event: Event) -> None:
        logger.warning("%s", event.text)
        self._service.emit(event)

    def _ask_config(self, rig: str) -> None:
        # Not again while an answer is awaited.
        if self._asked.get(rig, 0) > self._clock.monotonic_ns():
            return
        self._asked[rig] = self._clock.monotonic_ns() + 3600 * SECOND_NS
        self._asking.submit(self._fetch_config, rig)

    def _fetch_config(self, rig: str) -> None:
        config = None
        try:
            for answer in self._service.bus.ask(CONFIG.key(self._service.lab.name, rig), timeout_s=_CONFIG_TIMEOUT_S):
                if not answer.error:
                    config = CONFIG.decode(answer.payload)
        except (DecodeError, OperationError) as error:
            logger.warning("configuration of %s: %s", rig, error)
        finally:
            self._configs.put((rig, config))

    def close(self) -> None:
        """Finish every file; a second call does nothing."""
        self._stream.close()
        self._asking.shutdown(wait=False, cancel_futures=True)
        self._book.stop()
        if not self._disk.close(_FINISH_TIMEOUT_S):
            logger.error("the disk is too slow: some files keep their .part name, to be recovered")
