"""Retention policy: selects the recordings to delete by age and total size."""

import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hilrig_recorder.mcap_format.file_names import MCAP_PATTERN

DAY_S = 86_400


@dataclass(frozen=True, slots=True)
class StoredRecording:
    """A finished recording on the disk."""

    path: Path
    rig: str
    size: int
    """Bytes."""
    finished_s: float
    """When it was finished, s since 1970-01-01 UTC."""


def finished_recordings(folder: Path) -> list[StoredRecording]:
    """The finished recordings in the folder of a lab: `<folder>/<rig>/<session>.mcap`."""
    found = []
    for path in folder.glob(f"*/{MCAP_PATTERN}"):
        try:
            info = path.stat()
        except OSError:
            # Deleted since it was listed.
            continue
        if not stat.S_ISREG(info.st_mode):
            continue
        found.append(StoredRecording(path, path.parent.name, info.st_size, info.st_mtime))
    return found


def select_expired(
    recordings: Iterable[StoredRecording], *, keep_days: float, keep_gib: float, now_s: float
) -> list[StoredRecording]:
    """The recordings to delete, oldest first. The newest recording of each rig is never deleted.

    Args:
        recordings: all finished recordings.
        keep_days: maximum age, days; 0: no limit.
        keep_gib: maximum total size, GiB; 0: no limit.
        now_s: current time, s since 1970-01-01 UTC.
    """
    oldest_first = sorted(recordings, key=lambda stored: (stored.finished_s, stored.path))
    newest = {stored.rig: stored for stored in oldest_first}
    expired: list[StoredRecording] = []
    total = sum(stored.size for stored in oldest_first)
    for stored in oldest_first:
        if newest[stored.rig] is stored:
            continue
        too_old = keep_days > 0 and now_s - stored.finished_s > keep_days * DAY_S
        too_much = keep_gib > 0 and total > keep_gib * 2**30
        if too_old or too_much:
            expired.append(stored)
            total -= stored.size
    return expired
