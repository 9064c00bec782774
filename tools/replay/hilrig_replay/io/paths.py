"""Which recordings are meant: files, and folders with all in them; and what each is called beside the others."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from hilrig_recorder.mcap_format.file_names import MCAP_SUFFIX
from hilrig_runtime.errors import InputError


def recordings(given: Iterable[Path]) -> list[Path]:
    """The recordings that files and folders stand for, in the order given, a folder's by name.

    Raises:
        InputError: a folder has none.
    """
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            inside = sorted(path.rglob(f"*{MCAP_SUFFIX}"))
            if not inside:
                raise InputError(f"{path}: there is no recording ({MCAP_SUFFIX}) in this folder")
            found.extend(inside)
        else:
            found.append(path)
    return list(dict.fromkeys(found))


def names_of(paths: Sequence[Path]) -> dict[Path, str]:
    """A name for each of several recordings: its file's, with its folder where two files are called the same."""
    stems = Counter(path.stem for path in paths)
    return {path: path.stem if stems[path.stem] == 1 else str(path.with_suffix("")) for path in paths}
