"""Path arguments: expands folders to recordings, and gives each recording a display name."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX
from hilrig_runtime.errors import InputError


def find_recordings(given: Iterable[Path]) -> list[Path]:
    """The given files, and the recordings in the given folders (sorted by name), in the given order.

    Raises:
        InputError: a folder contains no recording.
    """
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            in_folder = sorted(path / relative for relative, _ in walk_recordings(path, (MCAP_SUFFIX,)))
            if not in_folder:
                raise InputError(f"{path}: this folder contains no recording ({MCAP_SUFFIX})")
            found.extend(in_folder)
        else:
            found.append(path)
    return list(dict.fromkeys(found))


def walk_recordings(folder: Path, suffixes: tuple[str, ...]) -> Iterator[tuple[str, os.stat_result]]:
    """Relative path and status of each regular file below a folder whose name ends with one of the suffixes.

    Symbolic links are followed. A folder with several names is listed once, by its real name if it is below `folder`.
    """
    waiting, links = [""], list[str]()
    visited: set[tuple[int, int]] = set()
    while waiting or links:
        below = waiting.pop() if waiting else links.pop(0)
        try:
            info = (folder / below).stat()
            identity = info.st_dev, info.st_ino
            if identity in visited:
                continue
            visited.add(identity)
            found = sorted(os.scandir(folder / below), key=lambda item: item.name)
        except OSError:
            # Not readable, or removed meanwhile.
            continue
        for item in found:
            relative = f"{below}/{item.name}" if below else item.name
            try:
                if item.is_dir():
                    (links if item.is_symlink() else waiting).append(relative)
                elif item.name.endswith(suffixes) and item.is_file():
                    yield relative, item.stat()
            except OSError:
                # Renamed or deleted after the folder was listed.
                continue


def display_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Display name of each recording: the file name without suffix; the path if several files have this name."""
    stems = Counter(path.stem for path in paths)
    return {path: path.stem if stems[path.stem] == 1 else str(path.with_suffix("")) for path in paths}
