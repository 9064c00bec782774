"""Codes with which students claim rigs: one for each student of a lab slot, in a file of the folder `classroom.claims`.

The file has the hashes of the codes only. A code has 49.5 random bits: it can't be found by trying, neither at an edge
(`GuessThrottle`) nor, within a lab slot, from its hash.
"""

import csv
import io
import os
import re
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from pathlib import Path
from typing import Final

from hilrig_runtime.config.roster import read_table
from hilrig_runtime.errors import InputError, OperationError
from hilrig_schemas.topics import is_name

CODES_FILE: Final = "codes.csv"
CODE_LETTERS: Final = 10
"""Letters of a code, without the hyphen."""
CLAIM_ADDRESS: Final = 400
"""Address of the first holding register that takes a code (number 401); they exist only if rigs are claimed."""
CLAIM_REGISTERS: Final = CODE_LETTERS // 2
"""Their number: two letters each, the first one in the more significant byte."""
_ALPHABET: Final = "23456789ABCDEFGHJKMNPQRSTUVWXYZ"
"""Without the letters and digits that look alike."""
_COLUMNS: Final = ("student", "rig", "ends", "sha256")
_SHA256: Final = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class ClaimCode:
    """A code as the edge knows it."""

    student: str
    """Id of the student."""
    rig: str
    """The only rig that it is for; empty: any rig that is free."""
    ends: datetime
    """End of the lab slot, with time zone."""
    digest: str
    """SHA-256 of the code, hexadecimal."""


def new_code() -> str:
    """Return a random code, in two groups of letters."""
    letters = "".join(secrets.choice(_ALPHABET) for _ in range(CODE_LETTERS))
    return f"{letters[: CODE_LETTERS // 2]}-{letters[CODE_LETTERS // 2 :]}"


def letters_of(code: str) -> str:
    """Return the letters of a typed code: upper case, without hyphens and blanks."""
    return "".join(code.upper().replace("-", "").split())


def digest_of(code: str) -> str:
    """Return the hash under which a code is stored."""
    return sha256(letters_of(code).encode(errors="replace")).hexdigest()


def read_codes(folder: Path) -> list[ClaimCode]:
    """Read the codes of a folder.

    Raises:
        InputError: the file can't be read, or a row is invalid.
    """
    path = folder / CODES_FILE
    header, rows = read_table(path)
    if tuple(header) != _COLUMNS:
        raise InputError(f"{path}: line 1: expected {','.join(_COLUMNS)}; make the codes again with hilrig rig codes")
    codes = []
    for line, row in rows:
        try:
            student, rig, ends_text, digest = row
            ends = datetime.fromisoformat(ends_text)
            if not (is_name(student) and (not rig or is_name(rig)) and ends.tzinfo and _SHA256.fullmatch(digest)):
                raise ValueError
        except ValueError:
            raise InputError(f"{path}: line {line}: not a code; make the codes again with hilrig rig codes") from None
        codes.append(ClaimCode(student, rig, ends, digest))
    return codes


def write_codes(folder: Path, codes: Iterable[ClaimCode]) -> None:
    """Replace the codes of a folder, which is created; only their owner may read them.

    Raises:
        OperationError: the file can't be written.
    """
    rows = [(code.student, code.rig, code.ends.isoformat(), code.digest) for code in codes]
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        replace_private_file(folder / CODES_FILE, as_csv([_COLUMNS, *rows]))
    except OSError as error:
        raise OperationError(f"{folder / CODES_FILE}: can't be written: {error.strerror}") from error


def as_csv(rows: Iterable[Sequence[str]]) -> str:
    """Return a CSV text."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def replace_private_file(path: Path, text: str) -> None:
    """Replace a file that only its owner may read, as a whole: a reader sees the old or the new content."""
    temporary = path.with_name(f".{path.name}.new")
    temporary.unlink(missing_ok=True)
    with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
        file.write(text)
    temporary.replace(path)
