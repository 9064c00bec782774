"""What a recorder does beside recording, in no hurry: recovering what was left unfinished, keeping the disk tidy."""

import contextlib
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from hilrig_recorder.mcap_format.file_names import RECOVERING_SUFFIX, UNFINISHED_SUFFIX
from hilrig_recorder.mcap_format.recover import recover, recovered_path
from hilrig_recorder.storage.retention import finished_recordings, to_delete
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.errors import HilrigError
from hilrig_runtime.timing.clock import Clock

KEEP_PERIOD_S: Final = 60.0
HEAD_START_S: Final = 2.0
PAUSES: Final = 3.0
"""Recovering pauses so many times as long as it works."""
MIN_PAUSE_S: Final = 0.002

logger = logging.getLogger(__name__)


def unfinished(folder: Path) -> list[Path]:
    """What recorders before this one left unfinished in a lab's folder."""
    return sorted(folder.glob(f"*/*{UNFINISHED_SUFFIX}"))


class Housekeeping:
    """A thread that recovers `parts` and then applies the rules of keeping once a minute."""

    def __init__(
        self, folder: Path, parts: list[Path], config: RecorderConfig, clock: Clock, on_trouble: Callable[[str], None]
    ) -> None:
        self._folder = folder
        self._parts = parts
        self._config = config
        self._clock = clock
        self._on_trouble = on_trouble
        self._ended = threading.Event()
        self._resumed_ns = clock.monotonic_ns()
        self._thread = threading.Thread(target=self._run, name="housekeeping", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End; what is being recovered stays as it was, for the next start."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        for draft in self._folder.glob(f"*/*{RECOVERING_SUFFIX}"):
            with contextlib.suppress(OSError):
                draft.unlink()
        # First the sessions that go on get their next files.
        if self._parts:
            self._ended.wait(HEAD_START_S)
        self._resumed_ns = self._clock.monotonic_ns()
        for part in self._parts:
            if not self._pause():
                return
            self._recover(part)
        while not self._ended.is_set():
            self._tidy()
            self._ended.wait(KEEP_PERIOD_S)

    def _pause(self) -> bool:
        """Leave the processor to the recording, most of the time; whether to go on."""
        worked_s = (self._clock.monotonic_ns() - self._resumed_ns) * 1e-9
        ended = self._ended.wait(max(MIN_PAUSE_S, PAUSES * worked_s))
        self._resumed_ns = self._clock.monotonic_ns()
        return not ended

    def _recover(self, part: Path) -> None:
        try:
            if part.stat().st_size == 0:
                part.unlink()
                return
            path = recovered_path(part)
            if path.exists():
                path = path.with_name(f"{path.stem}.recovered{path.suffix}")
            recovery = recover(part, path, go_on=self._pause)
            if recovery.path is None:
                # It was finished, and only its name was missing.
                part.replace(path)
            else:
                part.unlink()
            logger.info("recovered %s: %d messages", path, recovery.messages)
        except (HilrigError, OSError) as error:
            if not self._ended.is_set():
                self._on_trouble(str(error))

    def _tidy(self) -> None:
        days, gib = self._config.keep_days, self._config.keep_gib
        if not days and not gib:
            return
        now_s = self._clock.wall_ns() / 1e9
        for stored in to_delete(finished_recordings(self._folder), keep_days=days, keep_gib=gib, now_s=now_s):
            try:
                stored.path.unlink(missing_ok=True)
                for beside in stored.path.parent.glob(f"{stored.path.name}.*"):
                    beside.unlink(missing_ok=True)
                logger.info("deleted %s: recorder.keep_days or recorder.keep_gib no longer keeps it", stored.path)
            except OSError as error:
                self._on_trouble(f"{stored.path}: can't be deleted: {error.strerror}")
