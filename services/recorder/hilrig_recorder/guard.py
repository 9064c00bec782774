"""One recorder a lab: a lock on its folder, and a question on the bus.

The lock catches two recorders on one disk and is gone with the process that held it, however that ended. The question
catches one that writes elsewhere, where every session would be recorded twice.
"""

import json
import os
import platform
import sys
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from google.protobuf.message import DecodeError

from hilrig_recorder.durable import lock_file
from hilrig_runtime.bus import Answer
from hilrig_runtime.errors import OperationError
from hilrig_schemas import Event

LOCK_NAME: Final = ".recorder.lock"
_LOCKED_BYTE: Final = 1 << 20


class FolderLock:
    """Holds a lab's folder of recordings for this process.

    Raises:
        OperationError: another recorder holds it; says which.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / LOCK_NAME
        self._file = path.open("a+")
        try:
            if not self._lock():
                raise OperationError(f"{folder}: {_holder(path)} records there; two would write the same files")
        except BaseException:
            self._file.close()
            raise
        self._file.truncate(0)
        self._file.write(json.dumps({"process": os.getpid(), "host": platform.node()}))
        self._file.flush()

    def _lock(self) -> bool:
        if sys.platform != "win32":
            return lock_file(self._file.fileno())
        import msvcrt

        self._file.seek(_LOCKED_BYTE)
        try:
            msvcrt.locking(self._file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Let go of the folder."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _holder(path: Path) -> str:
    try:
        holder: dict[str, Any] = json.loads(path.read_text())
        return f"another recorder (process {holder['process']} on {holder['host']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another recorder"


def introduction(source: str, incarnation: int) -> bytes:
    """What a recorder says of itself when it is asked."""
    return Event(source=source, wall_ns=incarnation).SerializeToString()


def elder(answers: Iterable[Answer], incarnation: int) -> str:
    """The recorder among those who answered that ran before this one, for people; empty: there is none.

    Of two that start together the younger gives way, so that exactly one goes on.
    """
    for answer in answers:
        try:
            other = Event.FromString(answer.payload)
        except DecodeError:
            continue
        if not answer.error and 0 < other.wall_ns < incarnation:
            return f"{other.source} ({answer.key})"
    return ""
