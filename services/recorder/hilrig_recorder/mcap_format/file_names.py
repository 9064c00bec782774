"""Names of recording files: builds and parses them, and defines their suffixes. Pure."""

from pathlib import Path
from typing import Final

MCAP_SUFFIX: Final = ".mcap"
MAGIC: Final[bytes] = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file."""
RECOVERED_SUFFIX: Final = ".recovered"
PART_SUFFIX: Final = ".part"
"""Appended to the name of a recording while it is being written."""
UNFINISHED_SUFFIX: Final = f"{MCAP_SUFFIX}{PART_SUFFIX}"
"""End of the name of a recording that is being written, or whose recorder was killed."""
RECOVERING_SUFFIX: Final = ".recovering"
"""Appended to the name of a file while it is written by `hilrig recover`, `join` or `export`."""
MCAP_PATTERN: Final = f"*{MCAP_SUFFIX}"
"""Glob pattern of the finished recordings in a folder."""

NAME_TEMPLATE: Final = f"<session>[.<segment>][{RECOVERED_SUFFIX}]{MCAP_SUFFIX}[{PART_SUFFIX}][{RECOVERING_SUFFIX}]"
NAME_PARTS: Final = {
    "<session>": "id of the session, `<UTC start time>-<rig>-<4 letters>`",
    ".<segment>": "number of the segment within the session; the first segment has none, the next is `.2`",
    RECOVERED_SUFFIX: "written by `hilrig recover` beside the damaged file",
    MCAP_SUFFIX: "suffix of every recording",
    PART_SUFFIX: "the file is being written, or its recorder was killed",
    RECOVERING_SUFFIX: "the file is being written by `hilrig recover`, `join` or `export`",
}
"""Parts of a file name in their order, as in docs/recordings.md."""


def recording_name(session: str, segment: int = 1) -> str:
    """Name of a finished recording; `segment` counts from 1. `segment_number` parses it."""
    number = "" if segment == 1 else f".{segment}"
    return f"{session}{number}{MCAP_SUFFIX}"


def segment_number(name: str, session: str) -> int:
    """Number of the segment in the name of a recording, finished or not; 0: not a segment of this session."""
    stem = recording_stem(name)
    if stem == session:
        return 1
    number = stem.removeprefix(f"{session}.")
    return int(number) if number.isdecimal() and number != stem else 0


def recording_stem(name: str) -> str:
    """The name of a recording, finished or not, without its suffixes."""
    return name.removesuffix(PART_SUFFIX).removesuffix(MCAP_SUFFIX)


def part_path(path: Path) -> Path:
    """The path of a recording while it is being written."""
    return path.with_name(path.name + PART_SUFFIX)


def recovering_path(path: Path) -> Path:
    """The path of a recovered, joined or exported file while it is being written."""
    return path.with_name(path.name + RECOVERING_SUFFIX)


def recovered_path(source: Path) -> Path:
    """The default path of a recovered file: without `.part`, or with `.recovered` before the suffix."""
    if source.name.endswith(PART_SUFFIX):
        return source.with_name(source.name.removesuffix(PART_SUFFIX))
    return source.with_name(f"{source.stem}{RECOVERED_SUFFIX}{source.suffix or MCAP_SUFFIX}")
