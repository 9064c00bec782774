"""One recorder a rig: a lock in the lab's folder, which shows whose recordings a recorder writes there.

On one bus services tell each other for which rigs they run; this catches two recorders on one disk that do not hear
each other. A lock is gone with the process that held it, however that ended. Of two that begin at the same moment
both may see the other and refuse, but never neither.
"""

import json
import os
import platform
import sys
import time
from collections.abc import Collection
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

from hilrig_recorder.mcap_format.fsutil import lock_file
from hilrig_runtime.errors import OperationError

NAMED: Final = 3
"""Rigs that a refusal names."""
_LOCKED_BYTE: Final = 1 << 20
_ATTEMPTS: Final = 10
_PAUSE_S: Final = 0.02


class FolderLock:
    """Holds some rigs' recordings in a lab's folder for this process.

    Raises:
        OperationError: another recorder holds one of them, or has the same name; says which.
    """

    def __init__(self, folder: Path, instance: str, rigs: Collection[str]) -> None:
        path = folder / f".recorder-{instance}.lock"
        self._file = path.open("a+")
        try:
            if not _lock_soon(self._file):
                raise OperationError(f"{folder}: {_holder(path)} is called {instance!r} too; choose another --instance")
            self._file.truncate(0)
            self._file.write(json.dumps({"process": os.getpid(), "host": platform.node(), "rigs": sorted(rigs)}))
            self._file.flush()
            for other in sorted(folder.glob(".recorder-*.lock")):
                if other != path and not _is_free(other):
                    self._refuse_shared(folder, other, rigs)
        except BaseException:
            self._file.close()
            raise

    @staticmethod
    def _refuse_shared(folder: Path, other: Path, rigs: Collection[str]) -> None:
        shared = sorted(set(rigs) & set(_read(other).get("rigs", ())))
        if shared:
            names = ", ".join(shared[:NAMED]) + (f" and {len(shared) - NAMED} more" if len(shared) > NAMED else "")
            raise OperationError(f"{folder}: {_holder(other)} records {names} there; two would write the same files")

    def close(self) -> None:
        """Let go of the folder."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _lock_soon(file: IO[str]) -> bool:
    # Another recorder that begins may just be looking whether somebody holds it.
    for _ in range(_ATTEMPTS):
        if _lock(file):
            return True
        time.sleep(_PAUSE_S)
    return False


def _lock(file: IO[str]) -> bool:
    if sys.platform != "win32":
        return lock_file(file.fileno())
    import msvcrt

    # Far behind what is read: on Windows a locked byte can't be.
    file.seek(_LOCKED_BYTE)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    except OSError:
        return False
    return True


def _is_free(path: Path) -> bool:
    try:
        with path.open("r+") as file:
            return _lock(file)
    except OSError:
        return False


def _read(path: Path) -> dict[str, Any]:
    try:
        said = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return said if isinstance(said, dict) else {}


def _holder(path: Path) -> str:
    holder = _read(path)
    if "process" not in holder:
        return "another recorder"
    return f"another recorder (process {holder['process']} on {holder.get('host', '?')})"
