"""File system helpers: mapped files, advisory file locks and durable renames."""

import mmap
import os
import sys
from pathlib import Path

from hilrig_runtime.errors import InputError

if sys.platform != "win32":
    import fcntl


def sync_folder(folder: Path) -> None:
    """Make a rename in `folder` survive a power failure. On systems that can't sync folders, do nothing."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        pass
    finally:
        os.close(descriptor)


def lock_file(descriptor: int) -> bool:
    """Take the advisory lock of an open file, until it is closed; False: another process holds it.

    On systems without advisory locks, other processes can't rename or remove an open file anyway.
    """
    if sys.platform == "win32":
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        # The file system does not support locks.
        return True
    return True


def map_file(path: Path) -> memoryview:
    """Map a file into memory.

    Raises:
        InputError: the file can't be read.
    """
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                return memoryview(b"")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise InputError(f"{path}: can't be read: {error.strerror}") from error
