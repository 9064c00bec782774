"""Background maintenance: recovers files that earlier recorders did not finish, and deletes expired recordings."""

import contextlib
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from hilrig_recorder.mcap_format.file_names import RECOVERING_SUFFIX, UNFINISHED_SUFFIX, recovered_path
from hilrig_recorder.mcap_format.recover import recover
from hilrig_recorder.storage.retention import finished_recordings, select_expired
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.errors import HilrigError
from hilrig_runtime.timing.clock import Clock

RETENTION_PERIOD_S: Final = 60.0
"""Period at which expired recordings are deleted."""
START_DELAY_S: Final = 2.0
"""Delay of the first recovery, so that open sessions get their next segments first."""
PAUSE_TO_WORK_RATIO: Final = 3.0
"""Duty cycle of recovery: pause = ratio * work time."""
MIN_PAUSE_S: Final = 0.002

logger = logging.getLogger(__name__)


def find_unfinished(folder: Path) -> list[Path]:
    """The unfinished recordings of earlier recorders in the folder of a lab, the newest first."""
    times: list[tuple[int, Path]] = []
    for path in folder.glob(f"*/*{UNFINISHED_SUFFIX}"):
        with contextlib.suppress(FileNotFoundError):
            if path.is_file():
                times.append((path.stat().st_mtime_ns, path))
    return [path for _, path in sorted(times, reverse=True)]


class MaintenanceWorker:
    """A thread that recovers unfinished files and then deletes expired recordings once a minute.

    Args:
        folder: the folder of the lab's recordings.
        unfinished: the files to recover.
        config: the retention rules.
        clock: the clock.
        on_error: called with a text when a file can't be recovered or deleted.
    """

    def __init__(
        self,
        folder: Path,
        unfinished: list[Path],
        config: RecorderConfig,
        clock: Clock,
        on_error: Callable[[str], None],
    ) -> None:
        self._folder = folder
        self._unfinished = unfinished
        self._config = config
        self._clock = clock
        self._on_error = on_error
        self._stopping = threading.Event()
        self._resumed_ns = clock.monotonic_ns()
        self._thread = threading.Thread(target=self._run, name="maintenance", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread. An interrupted recovery leaves the original file for the next start."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        for draft in self._folder.glob(f"*/*{RECOVERING_SUFFIX}"):
            with contextlib.suppress(OSError):
                draft.unlink()
        if self._unfinished:
            self._stopping.wait(START_DELAY_S)
        self._resumed_ns = self._clock.monotonic_ns()
        for path in self._unfinished:
            if not self._pause():
                return
            self._recover(path)
        while not self._stopping.is_set():
            self._delete_expired()
            self._stopping.wait(RETENTION_PERIOD_S)

    def _pause(self) -> bool:
        """Leave most of the CPU time to recording; False: the thread must stop."""
        worked_s = (self._clock.monotonic_ns() - self._resumed_ns) * 1e-9
        stopping = self._stopping.wait(max(MIN_PAUSE_S, PAUSE_TO_WORK_RATIO * worked_s))
        self._resumed_ns = self._clock.monotonic_ns()
        return not stopping

    def _recover(self, source: Path) -> None:
        try:
            if source.stat().st_size == 0:
                source.unlink()
                return
            path = recovered_path(source)
            if path.exists():
                path = recovered_path(path)
            recovery = recover(source, path, should_continue=self._pause)
            if recovery.path is None:
                # The file was finished, but not renamed.
                source.replace(path)
            else:
                source.unlink()
            logger.info("recovered %s: %d messages", path, recovery.messages)
        except (HilrigError, OSError) as error:
            if not self._stopping.is_set():
                self._on_error(str(error))
        except Exception as error:
            # One file must not prevent the recovery of the others and the deletion of expired recordings.
            logger.exception("%s", source)
            self._on_error(f"{source}: can't be recovered: {type(error).__name__}: {error}")

    def _delete_expired(self) -> None:
        days, gib = self._config.keep_days, self._config.keep_gib
        if not days and not gib:
            return
        now_s = self._clock.wall_ns() / 1e9
        for stored in select_expired(finished_recordings(self._folder), keep_days=days, keep_gib=gib, now_s=now_s):
            try:
                stored.path.unlink(missing_ok=True)
                for companion in stored.path.parent.glob(f"{stored.path.name}.*"):
                    companion.unlink(missing_ok=True)
                logger.info("deleted %s: expired by recorder.keep_days or recorder.keep_gib", stored.path)
            except OSError as error:
                self._on_error(f"{stored.path}: can't be deleted: {error.strerror}")
