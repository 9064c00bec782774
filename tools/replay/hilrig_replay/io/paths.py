"""Path arguments: expands folders, finds the files of each run, and gives each run a display name."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from hilrig_recorder.mcap_format.file_names import MCAP_PATTERN, MCAP_SUFFIX
from hilrig_replay.io.segments import RunFiles, group_segments, read_segment
from hilrig_runtime.errors import InputError


def find_runs(given: Iterable[Path]) -> list[RunFiles]:
    """The runs of the given files and folders, in the given order; those of a folder are sorted by name.

    The other segments of the session of a given file are found in its folder. A file that can't be read is a run.

    Raises:
        InputError: a folder contains no recording.
    """
    files: dict[Path, Path] = {}
    for path in given:
        if path.is_dir():
            in_folder = sorted(path / relative for relative, _ in walk_recordings(path, (MCAP_SUFFIX,)))
            if not in_folder:
                raise InputError(f"{path}: this folder contains no recording ({MCAP_SUFFIX})")
        else:
            in_folder = [path]
        for one in in_folder:
            files.setdefault(one.absolute(), one)
    return _complete(files)


def find_run(path: Path) -> RunFiles:
    """The files of the run to which a recording belongs; a folder is a run that can't be read."""
    return _complete({path.absolute(): path})[0]


def find_each_run(given: Iterable[Path]) -> list[RunFiles]:
    """The run of each given recording, also of one that is given twice; several segments of a session are one run."""
    runs: list[RunFiles] = []
    for path in given:
        run = find_run(path)
        if len(run) == 1 or run not in runs:
            runs.append(run)
    return runs


def _complete(files: Mapping[Path, Path]) -> list[RunFiles]:
    """The runs of files, by their absolute paths, with the other segments of their sessions in the same folders."""
    segments = {path: read_segment(path) for path in files.values()}
    incomplete = {path.parent for path, segment in segments.items() if segment.session and not segment.is_whole}
    sessions = {segment.session for segment in segments.values()}
    for folder in incomplete:
        for path in sorted(folder.glob(MCAP_PATTERN)):
            if path.absolute() not in files and (segment := read_segment(path)).session in sessions:
                segments[path] = segment
    wanted = set(files.values())
    return [run for run in group_segments(segments) if not wanted.isdisjoint(run)]


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
