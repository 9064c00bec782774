"""Locks in the folder of a lab, so that only one recorder writes the recordings of a rig.

On one bus, services detect each other's rigs. The locks also detect two recorders that write to the same disk from
separate buses. A lock ends with the process that holds it. If two recorders start simultaneously, both may refuse, but
at least one always does.
"""

import json
import os
import platform
import sys
import time
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any, Final

from hilrig_recorder.mcap_format.fsutil import lock_file
from hilrig_runtime.errors import OperationError, list_names

_LOCKED_BYTE: Final = 1 << 20
_ATTEMPTS: Final = 10
_PAUSE_S: Final = 0.02


class FolderLock:
    """Locks the recordings of some rigs in the folder of a lab for this process.

    Raises:
        OperationError: another recorder has locked one of the rigs, or has the same instance name.
    """

    def __init__(self, folder: Path, instance: str, rigs: Collection[str]) -> None:
        path = folder / f".recorder-{instance}.lock"
        if path.exists() and not path.is_file():
            raise OperationError(f"{path}: can't be locked: expected a regular file; remove it")
        self._file = path.open("a+")
        try:
            if not _lock_with_retries(self._file):
                raise OperationError(
                    f"{folder}: {_holder(path)} has the same instance name {instance!r}; choose another --instance"
                )
            self._file.truncate(0)
            self._file.write(json.dumps({"process": os.getpid(), "host": platform.node(), "rigs": sorted(rigs)}))
            self._file.flush()
            for other in sorted(folder.glob(".recorder-*.lock")):
                # Reading a FIFO could wait forever.
                if other != path and other.is_file() and not _is_free(other):
                    self._refuse_shared(folder, other, rigs)
        except BaseException:
            self._file.close()
            raise

    @staticmethod
    def _refuse_shared(folder: Path, other: Path, rigs: Collection[str]) -> None:
        shared = sorted(set(rigs) & set(_read(other).get("rigs", ())))
        if shared:
            raise OperationError(
                f"{folder}: {_holder(other)} already records {list_names(shared)} in this folder; "
                "stop it, or assign other --rigs"
            )

    def close(self) -> None:
        """Release the lock."""
        self._file.close()


def _lock_with_retries(file: IO[str]) -> bool:
    # Another recorder that starts may hold the lock briefly while it checks it.
    for _ in range(_ATTEMPTS):
        if _lock(file):
            return True
        time.sleep(_PAUSE_S)
    return False


def _lock(file: IO[str]) -> bool:
    if sys.platform != "win32":
        return lock_file(file.fileno())
    import msvcrt

    # On Windows a locked byte can't be read, so a byte after the content is locked.
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
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _holder(path: Path) -> str:
    holder = _read(path)
    if "process" not in holder:
        return "another recorder"
    return f"another recorder (process {holder['process']} on {holder.get('host', '?')})"
