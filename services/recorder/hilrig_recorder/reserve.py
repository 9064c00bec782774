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

    def hold(self) -> None:
        """Set the space aside, if it is not; where there is none, nothing is held."""
        try:
            wanted = min(RESERVE_BYTES, shutil.disk_usage(self._folder).total // _SHARE)
            if self._path.exists() and self._path.stat().st_size >= wanted:
                return
            with self._path.open("wb", buffering=0) as file:
                for _ in range(max(1, wanted // len(_BLOCK))):
                    file.write(_BLOCK[:wanted])
        except OSError:
            self.release()

    def release(self) -> None:
        """Give the space back."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
