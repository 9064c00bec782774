"""Checks of `hilrig doctor`: each returns results with a level, a text and a fix."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Self


class Level(StrEnum):
    """Severity of a check result."""

    OK = "ok"
    WARNING = "warning"
    """The lab works, but the operator should know."""
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one check."""

    check: str
    """Name of the check, one or two words."""
    level: Level
    text: str
    fix: str = ""
    """How to fix it; empty: nothing to do."""

    @classmethod
    def ok(cls, check: str, text: str) -> Self:
        """Result of a check that passed."""
        return cls(check, Level.OK, text)

    @classmethod
    def warning(cls, check: str, text: str, fix: str = "") -> Self:
        """Result for a condition that the operator should know."""
        return cls(check, Level.WARNING, text, fix)

    @classmethod
    def error(cls, check: str, text: str, fix: str) -> Self:
        """Result for a condition that must be fixed."""
        return cls(check, Level.ERROR, text, fix)
