"""File system helpers: mapped files, advisory file locks and durable renames."""

import errno
import mmap
import os
import stat
import sys
from pathlib import Path
from typing import BinaryIO

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


def open_file(path: Path, *, is_writable: bool = False) -> BinaryIO:
    """Open a regular file for reading, or for reading and writing.

    Opening a FIFO or a device could wait forever.

    Raises:
        OSError: the file can't be opened, or is not a regular file.
    """
    descriptor = os.open(path, (os.O_RDWR if is_writable else os.O_RDONLY) | getattr(os, "O_NONBLOCK", 0))
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "expected a regular file, found a FIFO, device or socket", str(path))
        return os.fdopen(descriptor, "r+b" if is_writable else "rb")
    except BaseException:
        os.close(descriptor)
        raise


def map_file(path: Path) -> memoryview:
    """Map a file into memory.

    Raises:
        InputError: the file can't be read.
    """
    try:
        with open_file(path) as file:
            if os.fstat(file.fileno()).st_size == 0:
                return memoryview(b"")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: can't be read: {error.strerror}") from error
