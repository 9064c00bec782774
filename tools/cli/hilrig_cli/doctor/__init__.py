"""What `hilrig doctor` looks at: each check gives findings, and says what to mend."""

from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    """How a finding is to be taken."""

    GOOD = "good"
    NOTICE = "notice"
    """Works, but somebody should know."""
    WRONG = "wrong"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    check: str
    """What was looked at, in a word or two."""
    level: Level
    text: str
    mend: str = ""
    """What to do about it; empty: nothing."""


def good(check: str, text: str) -> Finding:
    """It is as it should be."""
    return Finding(check, Level.GOOD, text)


def notice(check: str, text: str, mend: str = "") -> Finding:
    """It works, but somebody should know."""
    return Finding(check, Level.NOTICE, text, mend)


def wrong(check: str, text: str, mend: str) -> Finding:
    """It is to be mended."""
    return Finding(check, Level.WRONG, text, mend)
