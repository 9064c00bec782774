"""Reserves disk space, and releases it when the disk is full so that every open file can be finished.

Nothing is recorded while the free space is below the configured minimum, or while the reserve can't be made again after
the disk was full.
"""

import contextlib
import errno
import os
import shutil
import sys
from pathlib import Path
from typing import Final

RESERVE_BYTES: Final = 8 << 20
"""Space for the last second and the index of some hundred files."""
MIB: Final = 1 << 20
_MAX_DISK_FRACTION: Final = 16
"""At most 1/16 of a small disk is reserved."""
_ZEROS: Final = bytes(1 << 16)


class DiskReserve:
    """The reserved space in a folder of recordings.

    Args:
        folder: the folder of the lab's recordings.
        instance: instance name of the recorder.
        min_free_mib: recording stops below this free space, MiB.
    """

    def __init__(self, folder: Path, instance: str, min_free_mib: int) -> None:
        self._folder = folder
        self._path = folder / f".recorder-{instance}.reserve"
        self._min_free_mib = min_free_mib
        self.is_exhausted = False
        """Whether recording is stopped because of too little space."""
        self._reserve()

    def mark_exhausted(self) -> None:
        """Release the reserve, because a write failed for lack of space: open files can then be finished."""
        self.release()
        self.is_exhausted = True

    def refresh(self) -> str:
        """Check the free space; returns an alert if recording stops now, else an empty text."""
        try:
            free = shutil.disk_usage(self._folder).free
        except OSError:
            return ""
        was_exhausted = self.is_exhausted
        self.is_exhausted = free < self._min_free_mib * MIB or (not self._reserve() and was_exhausted)
        if self.is_exhausted and not was_exhausted:
            return (
                f"{self._folder}: recording stopped: {free // MIB} MiB free, "
                f"minimum {self._min_free_mib} MiB (recorder.min_free_mib)"
            )
        return ""

    def describe_error(self, error: OSError) -> str:
        """A text for an error; it distinguishes a disk without free inodes from a disk without free space."""
        if error.errno == errno.ENOSPC and sys.platform != "win32":
            with contextlib.suppress(OSError):
                disk = os.statvfs(self._folder)
                if disk.f_files and not disk.f_favail:
                    return "the disk has no free inodes, so it can't store more files"
        return error.strerror or str(error)

    def release(self) -> None:
        """Release the reserved space."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _reserve(self) -> bool:
        """Reserve the space if it is not reserved yet; False: there is too little space."""
        try:
            usage = shutil.disk_usage(self._folder)
            wanted = min(RESERVE_BYTES, usage.total // _MAX_DISK_FRACTION)
            if self._path.exists() and self._path.stat().st_size >= wanted:
                return True
            if usage.free < wanted:
                return False
            # Real blocks are written: a sparse file would reserve nothing.
            with self._path.open("wb", buffering=0) as file:
                for _ in range(-(-wanted // len(_ZEROS))):
                    file.write(_ZEROS)
        except OSError:
            self.release()
            return False
        return True
