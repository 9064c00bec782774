"""File system helpers: advisory file locks and durable renames."""

import os
import sys
from pathlib import Path

if sys.platform != "win32":
    import fcntl


def sync_folder(folder: Path) -> None:
    """Make a renaming in `folder` survive a power cut; where a system can't, its file system does it by itself."""
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
    """Show that a file is being written, as long as it is open; False: another process shows that.

    Where a system has no advisory locks, an open file can't be renamed or removed by others anyway.
    """
    if sys.platform == "win32":
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        # A file system without locks.
        return True
    return True
