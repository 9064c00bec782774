"""Which recordings are meant: files, and folders with all that is in them."""

from collections.abc import Iterable
from pathlib import Path

from hilrig_runtime.errors import InputError


def recordings(given: Iterable[Path]) -> list[Path]:
    """The recordings that files and folders stand for, in the order given, a folder's by name.

    Raises:
        InputError: a folder has none.
    """
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            inside = sorted(path.rglob("*.mcap"))
            if not inside:
                raise InputError(f"{path}: there is no recording (.mcap) in this folder")
            found.extend(inside)
        else:
            found.append(path)
    return list(dict.fromkeys(found))
