"""Examples: controllers, lab files and exercises, in a checkout or installed with the package."""

import importlib.util
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from hilrig_runtime.errors import OperationError

FOLDERS: Final = {"": "examples", "compose": "compose", "exercises": "exercises"}
"""Folder of the examples of each prefix of a name, relative to a checkout."""
_PACKAGE: Final = "hilrig_examples"
PROJECTS: Final = {
    "4diac": "Joint controller for 4diac FORTE: docs/controllers/forte.md",
    "beremiz": "Project of Beremiz: docs/controllers/beremiz.md",
    "node-red": "Flows of Node-RED: docs/controllers/node-red.md",
    "openplc": "Program of OpenPLC with its settings and build script: docs/controllers/openplc.md",
}
"""Folders of files that are used together, with their content."""
_OF_FILES: Final = {"package.json": "Library of hold_position.js, for `npm install`"}
"""Content of files that can't have a comment."""
_COMMENT_MARKS: Final = ("#", "//", "/*", "(*", '"""', "%")
_NOT_EXAMPLES: Final = ("__pycache__", "node_modules")


def roots() -> dict[str, Path]:
    """Return the existing folder of each prefix of a name.

    Raises:
        OperationError: the installation contains no examples.
    """
    checkout = Path(__file__).parents[3]
    if (checkout / "examples").is_dir():
        folders = {prefix: checkout / folder for prefix, folder in FOLDERS.items()}
    else:
        spec = importlib.util.find_spec(_PACKAGE)
        installed = Path(next(iter(spec.submodule_search_locations or ()), "")) if spec is not None else None
        if installed is None:
            raise OperationError("the examples are not part of this installation")
        folders = {prefix: installed / prefix for prefix in FOLDERS}
    return {prefix: folder for prefix, folder in folders.items() if folder.is_dir()}


def example_names() -> list[str]:
    """Return the names of all files, sorted."""
    return sorted(name for name, _ in _files())


def listed_names() -> list[str]:
    """Return the names of a listing: of a project or an exercise only its folder."""
    parts = (name.split("/") for name in example_names())
    return list(dict.fromkeys("/".join(path[: 1 if path[0] in PROJECTS else 2]) for path in parts))


def example_path(name: str) -> Path:
    """Return the path of a file or folder of examples by its name, for example `hold_position.py`.

    Raises:
        OperationError: the installation contains no examples.
        LookupError: there is no example of this name.
    """
    folders = roots()
    wanted = name.strip("/")
    files = example_names()
    if wanted in files or any(file.startswith(f"{wanted}/") for file in files):
        prefix, _, rest = wanted.partition("/")
        return folders[prefix] / rest if prefix in folders else folders[""] / wanted
    raise LookupError(f"no example {name!r}: `hilrig example` lists all")


def summary(name: str) -> str:
    """Return the content in a line: the beginning of a file's comment or docstring, or the title of an exercise."""
    if known := PROJECTS.get(name) or _OF_FILES.get(name):
        return known
    path = example_path(name)
    if path.is_dir():
        assignment = path / "assignment.toml"
        return str(tomllib.loads(assignment.read_text(encoding="utf-8"))["title"]) if assignment.exists() else ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines()[:3]:
        for mark in _COMMENT_MARKS:
            if line.startswith(mark) and not line.startswith("#!"):
                return line.removeprefix(mark).strip().removesuffix("*/").removesuffix("*)").strip('" ')
    return ""


def _files() -> Iterator[tuple[str, Path]]:
    for prefix, folder in roots().items():
        for path in folder.rglob("*"):
            name = path.relative_to(folder)
            if path.is_file() and not set(name.parts) & {*_NOT_EXAMPLES, *FOLDERS.keys() - {prefix}}:
                yield (Path(prefix) / name).as_posix(), path
