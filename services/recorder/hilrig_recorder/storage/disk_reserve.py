"""Space on the disk: a little is set aside, and given back when the disk is full to end every file properly.

With less left than the lab wants to keep free, or a disk that was full and has not room for what is set aside again,
nothing is recorded.
"""

import contextlib
import errno
import os
import shutil
import sys
from pathlib import Path
from typing import Final

RESERVE_BYTES: Final = 8 << 20
"""Room for the last second and the index of some hundred files."""
MIB: Final = 1 << 20
_SHARE: Final = 16
"""No more than this part of a small disk is set aside."""
_BLOCK: Final = bytes(1 << 16)


class Space:
    """The space below a folder; the one of the recorder `instance`."""

    def __init__(self, folder: Path, instance: str, min_free_mib: int) -> None:
        self._folder = folder
        self._reserve = folder / f".recorder-{instance}.reserve"
        self._min_free_mib = min_free_mib
        self.full = False
        """Whether nothing is recorded for want of space."""
        self._hold()

    def run_out(self) -> None:
        """The disk is full: what was set aside is free now, for the files to end."""
        self.release()
        self.full = True

    def look(self) -> str:
        """Look how much is free. What is wrong, for people, if that is new; empty: nothing that was not before."""
        try:
            free = shutil.disk_usage(self._folder).free
        except OSError:
            return ""
        was_full = self.full
        self.full = free < self._min_free_mib * MIB or (not self._hold() and was_full)
        if self.full and not was_full:
            return f"{self._folder}: only {free // MIB} MiB are free, {self._min_free_mib} are kept: no recording"
        return ""

    def why(self, error: OSError) -> str:
        """What the disk said, for people: a disk may be full of files while it has space."""
        if error.errno == errno.ENOSPC and sys.platform != "win32":
            with contextlib.suppress(OSError):
                disk = os.statvfs(self._folder)
                if disk.f_files and not disk.f_favail:
                    return "the disk takes no more files (it has no inodes left)"
        return error.strerror or str(error)

    def release(self) -> None:
        """Give back what was set aside."""
        with contextlib.suppress(OSError):
            self._reserve.unlink(missing_ok=True)

    def _hold(self) -> bool:
        """Set the space aside, if it is not; whether it is. Where there is too little, nothing is held."""
        try:
            usage = shutil.disk_usage(self._folder)
            wanted = min(RESERVE_BYTES, usage.total // _SHARE)
            if self._reserve.exists() and self._reserve.stat().st_size >= wanted:
                return True
            if usage.free < wanted:
                return False
            # Of real blocks: a file of holes would hold nothing.
            with self._reserve.open("wb", buffering=0) as file:
                for _ in range(-(-wanted // len(_BLOCK))):
                    file.write(_BLOCK)
        except OSError:
            self.release()
            return False
        return True
