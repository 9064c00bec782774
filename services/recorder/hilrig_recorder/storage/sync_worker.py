"""What the disk is slow at, on a thread of its own: syncing what was written, ending files and giving them their name.

The recorder's thread only appends: neither a disk that takes its time nor the index of a long recording holds it up.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Final

from hilrig_recorder.mcap_format.writer import MovedError, RunWriter
from hilrig_runtime.timing.clock import Clock

LOOK_PERIOD_NS: Final = 100_000_000
"""So soon what was written is synced; a file is written to about once a second."""
ENDING_S: Final = 0.9
"""When all ends: the longest that files are given to get their index and name, without syncing."""

logger = logging.getLogger(__name__)


@dataclass(slots=True)
class _Open:
    writer: RunWriter
    synced: int = 0
    """Bytes that are safe."""


@dataclass(frozen=True, slots=True)
class _Job:
    """A file that is followed from now on, or one that ends."""

    writer: RunWriter
    finish: Callable[[], None] | None = None


class Disk:
    """Syncs, ends and publishes. What came of it is handed back on this thread: `on_trouble` hears of a file that could
    not be synced, `on_ended` of each that has ended, with what was wrong, and keeps its `.part` name then."""

    def __init__(
        self,
        clock: Clock,
        on_trouble: Callable[[RunWriter, OSError], None],
        on_ended: Callable[[RunWriter, OSError | None], None],
    ) -> None:
        self._clock = clock
        self._on_trouble = on_trouble
        self._on_ended = on_ended
        self._jobs: SimpleQueue[_Job | None] = SimpleQueue()
        self._open: dict[int, _Open] = {}
        self._closing = threading.Event()
        self._hurry = threading.Event()
        self._ended = False
        self._round_from_ns: int | None = None
        """When all open files began to be synced, monotonic clock; None: they are."""
        self._round_ns = 0
        """How long that took the last time."""
        self._thread = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    def follow(self, writer: RunWriter) -> None:
        """Sync what is written to this file, from now on."""
        self._jobs.put(_Job(writer))

    def end(self, writer: RunWriter, finish: Callable[[], None]) -> None:
        """Call `finish`, which writes what a file ends with, sync it, close it and give it its name.

        Nobody else may use the writer from now on.
        """
        self._jobs.put(_Job(writer, finish))

    @property
    def behind_s(self) -> float:
        """How long it takes until what was written is safe, s."""
        begun_ns = self._round_from_ns
        going_on_ns = 0 if begun_ns is None else self._clock.monotonic_ns() - begun_ns
        return max(self._round_ns, going_on_ns) * 1e-9

    def close(self, timeout_s: float) -> bool:
        """End what is waiting; after `timeout_s` without syncing, so that every file gets its name.

        Returns:
            Whether all is done.
        """
        self._closing.set()
        self._jobs.put(None)
        self._thread.join(timeout_s)
        self._hurry.set()
        self._thread.join(ENDING_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        due_ns = self._clock.monotonic_ns() + LOOK_PERIOD_NS
        while not self._ended:
            wait_ns = due_ns - self._clock.monotonic_ns()
            if wait_ns > 0:
                self._next_job(wait_ns * 1e-9)
                continue
            self._round_from_ns = self._clock.monotonic_ns()
            for item in list(self._open.values()):
                if self._sync(item):
                    # In turns: many files that end, and many that are open, do not wait for all of the others.
                    self._next_job(0)
            now_ns = self._clock.monotonic_ns()
            self._round_ns, self._round_from_ns = now_ns - self._round_from_ns, None
            due_ns = now_ns + LOOK_PERIOD_NS

    def _next_job(self, timeout_s: float) -> None:
        try:
            job = self._jobs.get(timeout=timeout_s) if timeout_s > 0 else self._jobs.get_nowait()
        except Empty:
            return
        if job is None:
            self._ended = True
        elif job.finish is None:
            self._open[id(job.writer)] = _Open(job.writer)
        else:
            self._open.pop(id(job.writer), None)
            self._end(job.writer, job.finish)

    def _sync(self, item: _Open) -> bool:
        """Sync a file that was written to; whether it was."""
        # A job between may have closed it; and at the end every file is about to be.
        if self._closing.is_set() or id(item.writer) not in self._open or item.writer.size == item.synced:
            return False
        size = item.writer.size
        try:
            item.writer.sync()
        except OSError as error:
            self._on_trouble(item.writer, error)
        item.synced = size
        return True

    def _end(self, writer: RunWriter, finish: Callable[[], None]) -> None:
        try:
            finish()
            writer.publish(durably=not self._hurry.is_set())
        except OSError as error:
            writer.close()
            logger.error("%s", what_became_of(writer, error))
            self._on_ended(writer, error)
        else:
            logger.info("recorded %s", writer.path)
            self._on_ended(writer, None)


def what_became_of(writer: RunWriter, error: OSError) -> str:
    """Of a file that could not get its name, for people."""
    if isinstance(error, MovedError):
        return f"{writer.path}: {error.strerror}"
    return f"{writer.part}: can't be finished, and waits to be recovered: {error.strerror}"
