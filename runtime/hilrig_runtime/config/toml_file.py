"""Reads text and TOML files of limited size and nesting."""

import tomllib
from pathlib import Path
from typing import Any, Final

from hilrig_runtime.errors import InputError

MAX_TEXT_BYTES: Final = 8 << 20
"""Largest text file that is read. A lab of 500 rigs has 0.1 MB, with a recorded delay trace in it 1 MB."""


def read_text(path: Path) -> str:
    """Read a UTF-8 text.

    Raises:
        InputError: the file can't be read, is too large, or is not UTF-8 text.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_TEXT_BYTES + 1)
        if len(content) > MAX_TEXT_BYTES:
            raise InputError(f"{path}: can't be read: larger than {MAX_TEXT_BYTES >> 20} MiB")
        return content.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise InputError(f"{path}: can't be read: {reason}") from error


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Parse a TOML text; `where` is its name in messages.

    Raises:
        InputError: the text is not valid TOML, too long or nested too deeply.
    """
    if len(text) > MAX_TEXT_BYTES:
        raise InputError(f"{where}: invalid TOML: longer than {MAX_TEXT_BYTES >> 20} MiB")
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{where}: invalid TOML: nested too deeply; expected at most some hundred levels") from error
    except ValueError as error:
        # Also an integer with thousands of digits.
        raise InputError(f"{where}: invalid TOML: {error}") from error
