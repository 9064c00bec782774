"""Path arguments: expands folders to recordings, and gives each recording a display name."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from hilrig_recorder.mcap_format.file_names import MCAP_PATTERN, MCAP_SUFFIX
from hilrig_runtime.errors import InputError


def find_recordings(given: Iterable[Path]) -> list[Path]:
    """The given files, and the recordings in the given folders (sorted by name), in the given order.

    Raises:
        InputError: a folder contains no recording.
    """
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            in_folder = sorted(path.rglob(MCAP_PATTERN))
            if not in_folder:
                raise InputError(f"{path}: this folder contains no recording ({MCAP_SUFFIX})")
            found.extend(in_folder)
        else:
            found.append(path)
    return list(dict.fromkeys(found))


def display_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Display name of each recording: the file name without suffix; the path if several files have this name."""
    stems = Counter(path.stem for path in paths)
    return {path: path.stem if stems[path.stem] == 1 else str(path.with_suffix("")) for path in paths}
