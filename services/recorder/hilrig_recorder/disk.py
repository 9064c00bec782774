"""What the disk is slow at, on a thread of its own: syncing open files once a second, giving finished ones their name.

The recorder's thread only appends; a disk that takes its time to sync holds nothing up.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from queue import Empty, SimpleQueue
from typing import Final

from hilrig_recorder.writer import RunWriter
from hilrig_runtime.clock import Clock

SYNC_PERIOD_NS: Final = 1_000_000_000

logger = logging.getLogger(__name__)


class _Job(Enum):
    FOLLOW = auto()
    PUBLISH = auto()
    ABANDON = auto()


@dataclass(slots=True)
class _Open:
    writer: RunWriter
    synced: int = 0
    """Bytes that are safe."""


class Disk:
    """Syncs and publishes; results are handed back through `on_trouble` and `on_published`, on this thread."""

    def __init__(
        self,
        clock: Clock,
        on_trouble: Callable[[RunWriter, OSError], None],
        on_published: Callable[[RunWriter], None],
    ) -> None:
        self._clock = clock
        self._on_trouble = on_trouble
        self._on_published = on_published
        self._jobs: SimpleQueue[tuple[RunWriter, _Job] | None] = SimpleQueue()
        self._open: dict[int, _Open] = {}
        self._hurry = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    def follow(self, writer: RunWriter) -> None:
        """Sync this file once a second from now on."""
        self._jobs.put((writer, _Job.FOLLOW))

    def publish(self, writer: RunWriter) -> None:
        """Sync this finished file, close it and give it its name."""
        self._jobs.put((writer, _Job.PUBLISH))

    def abandon(self, writer: RunWriter) -> None:
        """Close this file as it is, under its `.part` name."""
        self._jobs.put((writer, _Job.ABANDON))

    def close(self, timeout_s: float) -> bool:
        """Publish what is waiting and end; after `timeout_s` without syncing, so that every file gets its name.

        Returns:
            Whether all is done.
        """
        self._jobs.put(None)
        self._thread.join(timeout_s)
        self._hurry.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        due_ns = self._clock.monotonic_ns() + SYNC_PERIOD_NS
        while not self._ended:
            wait_ns = due_ns - self._clock.monotonic_ns()
            if wait_ns > 0:
                self._next_job(wait_ns * 1e-9)
                continue
            for item in list(self._open.values()):
                self._sync(item)
                # Names before syncs: a file that waits for its name is a session that has ended.
                self._waiting_jobs()
            due_ns = max(due_ns + SYNC_PERIOD_NS, self._clock.monotonic_ns())

    def _waiting_jobs(self) -> None:
        while not self._ended and self._next_job(0):
            pass

    def _next_job(self, timeout_s: float) -> bool:
        try:
            job = self._jobs.get(timeout=timeout_s) if timeout_s > 0 else self._jobs.get_nowait()
        except Empty:
            return False
        if job is None:
            self._ended = True
            return False
        writer, what = job
        if what is _Job.FOLLOW:
            self._open[id(writer)] = _Open(writer)
            return True
        self._open.pop(id(writer), None)
        if what is _Job.PUBLISH:
            self._publish(writer)
        else:
            writer.close()
        return True

    def _sync(self, item: _Open) -> None:
        # A job between may have closed it.
        if id(item.writer) not in self._open or item.writer.size == item.synced:
            return
        size = item.writer.size
        try:
            item.writer.sync()
        except OSError as error:
            self._on_trouble(item.writer, error)
        item.synced = size

    def _publish(self, writer: RunWriter) -> None:
        try:
            writer.publish(durably=not self._hurry.is_set())
        except OSError as error:
            logger.error("%s: can't be finished: %s", writer.part, error.strerror)
            self._on_trouble(writer, error)
        else:
            self._on_published(writer)
