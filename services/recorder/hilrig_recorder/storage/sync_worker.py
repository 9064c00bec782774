"""The sync worker: a thread that syncs open files, and finishes and renames closed ones.

The recorder's thread only appends, so neither a slow disk nor the index of a long recording delays it.
"""

import logging
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Final

from hilrig_recorder.mcap_format.writer import FileReplacedError, RecordingWriter
from hilrig_runtime.timing.clock import Clock

SYNC_PERIOD_NS: Final = 100_000_000
"""Period of syncing; each file is written about once a second."""
FINISH_WITHOUT_SYNC_S: Final = 0.9
"""Maximum time at shutdown for finishing and renaming files without syncing them."""

logger = logging.getLogger(__name__)


class SyncWorker:
    """Syncs, finishes and renames files. The callbacks run on the worker's thread.

    Args:
        clock: the clock.
        on_sync_error: called with a writer and the error when a file could not be synced.
        on_finished: called for each finished file; with an error if it keeps its `.part` name.
    """

    def __init__(
        self,
        clock: Clock,
        on_sync_error: Callable[[RecordingWriter, OSError], None],
        on_finished: Callable[[RecordingWriter, OSError | None], None],
    ) -> None:
        self._clock = clock
        self._on_sync_error = on_sync_error
        self._on_finished = on_finished
        self._jobs: SimpleQueue[tuple[RecordingWriter, Callable[[], None] | None] | None] = SimpleQueue()
        """A file and the function that finishes it; without a function: a file to sync from now on; None: stop."""
        self._synced: dict[RecordingWriter, int] = {}
        """Synced bytes of each open file."""
        self._closing = threading.Event()
        self._skip_sync = threading.Event()
        self._stopped = False
        self._round_start_ns: int | None = None
        """When the current sync of all open files started, monotonic clock; None: no sync is running."""
        self._round_ns = 0
        """Duration of the last sync of all open files."""
        self._thread = threading.Thread(target=self._run, name="sync", daemon=True)
        self._thread.start()

    def follow(self, writer: RecordingWriter) -> None:
        """Sync this file periodically from now on."""
        self._jobs.put((writer, None))

    def finish(self, writer: RecordingWriter, finish: Callable[[], None]) -> None:
        """Call `finish`, which writes the end of the file, then sync, close and rename the file.

        The caller must not use the writer any more.
        """
        self._jobs.put((writer, finish))

    @property
    def sync_delay_s(self) -> float:
        """Time until written data is synced, s."""
        start_ns = self._round_start_ns
        running_ns = 0 if start_ns is None else self._clock.monotonic_ns() - start_ns
        return max(self._round_ns, running_ns) * 1e-9

    def close(self, timeout_s: float) -> bool:
        """Finish the queued files; after `timeout_s` without syncing, so that every file is renamed.

        Returns:
            Whether all files are finished.
        """
        self._closing.set()
        self._jobs.put(None)
        self._thread.join(timeout_s)
        self._skip_sync.set()
        self._thread.join(FINISH_WITHOUT_SYNC_S)
        return not self._thread.is_alive()

    def _run(self) -> None:
        due_ns = self._clock.monotonic_ns() + SYNC_PERIOD_NS
        while not self._stopped:
            wait_ns = due_ns - self._clock.monotonic_ns()
            if wait_ns > 0:
                self._run_job(wait_ns * 1e-9)
                continue
            self._round_start_ns = self._clock.monotonic_ns()
            for writer in list(self._synced):
                if self._sync(writer):
                    # Jobs run between syncs, so that a file to finish does not wait for the sync of all open files.
                    self._run_job(0)
            now_ns = self._clock.monotonic_ns()
            self._round_ns, self._round_start_ns = now_ns - self._round_start_ns, None
            due_ns = now_ns + SYNC_PERIOD_NS

    def _run_job(self, timeout_s: float) -> None:
        try:
            job = self._jobs.get(timeout=timeout_s) if timeout_s > 0 else self._jobs.get_nowait()
        except Empty:
            return
        if job is None:
            self._stopped = True
            return
        writer, finish = job
        if finish is None:
            self._synced[writer] = 0
        else:
            self._synced.pop(writer, None)
            self._finish(writer, finish)

    def _sync(self, writer: RecordingWriter) -> bool:
        """Sync a file with new data; False: nothing to sync."""
        size = writer.size
        # A job may have closed the file meanwhile. At shutdown every file is finished soon.
        if self._closing.is_set() or self._synced.get(writer, size) == size:
            return False
        try:
            writer.sync()
        except OSError as error:
            self._on_sync_error(writer, error)
        self._synced[writer] = size
        return True

    def _finish(self, writer: RecordingWriter, finish: Callable[[], None]) -> None:
        try:
            finish()
            writer.publish(durably=not self._skip_sync.is_set())
        except OSError as error:
            writer.close()
            logger.error("%s", describe_failure(writer, error))
            self._on_finished(writer, error)
        else:
            logger.info("recorded %s", writer.path)
            self._on_finished(writer, None)


def describe_failure(writer: RecordingWriter, error: OSError) -> str:
    """A human-readable text for a file that could not be finished."""
    if isinstance(error, FileReplacedError):
        return f"{writer.path}: {error.strerror}; the session continues in another file"
    return f"{writer.temporary_path}: can't be finished: {error.strerror}; it will be recovered at the next start"
