"""Names of recording files: the suffixes of finished, unfinished and recovering files. Pure."""

from pathlib import Path
from typing import Final

MCAP_SUFFIX: Final = ".mcap"
PART_SUFFIX: Final = ".part"
"""Appended to the name of a recording while it is being written."""
UNFINISHED_SUFFIX: Final = f"{MCAP_SUFFIX}{PART_SUFFIX}"
"""End of the name of a recording that is being written, or whose recorder was killed."""
RECOVERING_SUFFIX: Final = ".recovering"
"""Appended to the name of a file while it is being recovered."""


def part_path(path: Path) -> Path:
    """The path of a recording while it is being written."""
    return path.with_name(path.name + PART_SUFFIX)
