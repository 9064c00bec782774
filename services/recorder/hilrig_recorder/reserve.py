"""Space set aside on the disk, given back when the disk is full: so that there is room to end every file properly."""

import contextlib
import shutil
from pathlib import Path
from typing import Final

RESERVE_NAME: Final = ".recorder.reserve"
RESERVE_BYTES: Final = 8 << 20
"""Room for the index of some hundred files."""
_SHARE: Final = 16
"""No more than this part of a small disk."""
_BLOCK: Final = bytes(1 << 16)


class Reserve:
    """A file of nothing, of real blocks."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / RESERVE_NAME
        self._folder = folder

    def hold(self) -> bool:
        """Set the space aside, if it is not; whether it is. Where there is too little, nothing is held."""
        try:
            usage = shutil.disk_usage(self._folder)
            wanted = min(RESERVE_BYTES, usage.total // _SHARE)
            if self._path.exists() and self._path.stat().st_size >= wanted:
                return True
            if usage.free < wanted:
                return False
            with self._path.open("wb", buffering=0) as file:
                for _ in range(max(1, -(-wanted // len(_BLOCK)))):
                    file.write(_BLOCK[:wanted])
        except OSError:
            self.release()
            return False
        return True

    def release(self) -> None:
        """Give the space back."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
