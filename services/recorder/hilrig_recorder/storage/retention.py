"""Which recordings may go, when there are rules about how long or how much is kept."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX

DAY_S = 86_400


@dataclass(frozen=True, slots=True)
class Stored:
    """A finished recording on the disk."""

    path: Path
    rig: str
    size: int
    """Bytes."""
    finished_s: float
    """When it was finished, s since 1970-01-01 UTC."""


def finished_recordings(folder: Path) -> list[Stored]:
    """The finished recordings of a lab's folder: `<folder>/<rig>/<session>.mcap`."""
    found = []
    for path in folder.glob(f"*/*{MCAP_SUFFIX}"):
        try:
            info = path.stat()
        except OSError:
            # Gone since it was listed.
            continue
        found.append(Stored(path, path.parent.name, info.st_size, info.st_mtime))
    return found


def to_delete(recordings: Iterable[Stored], *, keep_days: float, keep_gib: float, now_s: float) -> list[Stored]:
    """What the rules let go, oldest first; 0 turns a rule off. A rig's newest recording always stays."""
    oldest_first = sorted(recordings, key=lambda stored: (stored.finished_s, stored.path))
    newest = {stored.rig: stored for stored in oldest_first}
    going: list[Stored] = []
    total = sum(stored.size for stored in oldest_first)
    for stored in oldest_first:
        if newest[stored.rig] is stored:
            continue
        too_old = keep_days > 0 and now_s - stored.finished_s > keep_days * DAY_S
        too_much = keep_gib > 0 and total > keep_gib * 2**30
        if too_old or too_much:
            going.append(stored)
            total -= stored.size
    return going
