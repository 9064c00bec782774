"""The errors of a command, each with its exit code.

An error is raised where it is found and states the defect, its place and the accepted value. It is caught once, at the
top of the process (`process.shutdown.run_main`).
"""

import shlex
import sys
from collections.abc import Callable, Sequence
from typing import Any, Final

MAX_ERROR_LINES: Final = 20
"""Number of mistakes of one kind that a message lists; the others are counted."""


class HilrigError(Exception):
    """An error that is reported as one line, without a traceback."""

    exit_code = 3


class InputError(HilrigError):
    """Invalid input: an option, a configuration, a file. Exit code 2."""

    exit_code = 2


class OperationError(HilrigError):
    """A valid request that failed: a port in use, a full disk. Exit code 3."""


def list_names(names: Sequence[str], limit: int = 3) -> str:
    """Join names for a message; those beyond `limit` are only counted."""
    more = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {more} more" if more > 0 else "")


def first_errors(
    errors: Sequence[Any], describe: Callable[[Any], str] = str, limit: int = MAX_ERROR_LINES
) -> list[str]:
    """Return the texts of the first `limit` errors, and one with the number of the others."""
    more = len(errors) - limit
    return [*map(describe, errors[:limit]), *([f"{more} more errors"] if more > 0 else [])]


def install_command(extra: str) -> str:
    """Return the command that installs hilrig with an extra for the running Python; it is run in hilrig's folder."""
    return f"{shlex.quote(sys.executable)} -m pip install '.[{extra}]'"
