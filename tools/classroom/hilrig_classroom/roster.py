"""Roster of a class: the students, and the rig of each.

A CSV file with the columns id, name, group, rig; the last two may be missing. Recordings, events and the bus contain
ids only. Names are joined where grades and pages are made.
"""

import csv
import io
import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hilrig_runtime.config.validation import read_text
from hilrig_runtime.errors import InputError
from hilrig_schemas.topics import NAME_PATTERN

_ID: Final = re.compile(NAME_PATTERN)
MAX_STUDENTS: Final = 10_000
COLUMNS: Final = ("id", "name", "group", "rig")
DELIMITERS: Final = ",;\t"
_MAX_ERRORS: Final = 10


@dataclass(frozen=True, slots=True)
class Student:
    """One student of a roster."""

    id: str
    name: str
    group: str = ""
    rig: str = ""
    """Name of the student's rig; empty: none is assigned."""


@dataclass(frozen=True, slots=True)
class Roster:
    """The students of a class, in the order of the file."""

    students: tuple[Student, ...]

    def by_id(self) -> dict[str, Student]:
        """Students by their id."""
        return {student.id: student for student in self.students}

    def of_rig(self, rig: str) -> tuple[Student, ...]:
        """Students to whom a rig is assigned."""
        return tuple(student for student in self.students if student.rig == rig)


def read_roster(path: Path) -> Roster:
    """Read a roster: UTF-8 with or without byte order mark, separated by comma, semicolon or tab.

    Raises:
        InputError: the file can't be read, or rows are invalid; names the first errors with their lines.
    """
    header, rows = read_table(path)
    columns = {name.strip().lower(): at for at, name in enumerate(header)}
    missing = [name for name in ("id", "name") if name not in columns]
    if missing:
        raise InputError(
            f"{path}: line 1: column {missing[0]!r} is missing; found {', '.join(header) or 'nothing'}; "
            f"expected {', '.join(COLUMNS)}"
        )
    errors: list[str] = []
    students: dict[str, Student] = {}
    for line, row in rows:
        values = {name: _clean(row[at]) if at < len(row) else "" for name, at in columns.items()}
        student = Student(*(values.get(name, "") for name in COLUMNS))
        if problem := _problem(student, students):
            errors.append(f"{path}: line {line}: {problem}")
        else:
            students[student.id] = student
    if len(students) > MAX_STUDENTS:
        errors.append(f"{path}: {len(students)} students, at most {MAX_STUDENTS} are accepted")
    if not students and not errors:
        errors.append(f"{path}: no students below the header")
    if errors:
        more = len(errors) - _MAX_ERRORS
        raise InputError("\n".join(errors[:_MAX_ERRORS] + ([f"{path}: {more} more errors"] if more > 0 else [])))
    return Roster(tuple(students.values()))


def read_table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Read a CSV file: its header, and its other rows with their line numbers; empty rows are left out.

    Raises:
        InputError: the file can't be read, or is no table.
    """
    text = read_text(path).removeprefix("\ufeff")
    reader = csv.reader(io.StringIO(text), delimiter=delimiter_of(text), strict=True)
    try:
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num}: no CSV table: {error}") from error
    if not rows:
        raise InputError(f"{path}: empty file; expected a header line {','.join(COLUMNS)}")
    return rows[0][1], rows[1:]


def delimiter_of(text: str) -> str:
    """Delimiter of a CSV text: the one that occurs most often in its first line."""
    first = text.split("\n", 1)[0]
    return max(DELIMITERS, key=first.count)


def _clean(cell: str) -> str:
    # One form of each letter, so that names compare equal whatever program wrote them.
    return unicodedata.normalize("NFC", cell.strip())


def _problem(student: Student, known: dict[str, Student]) -> str:
    if not student.id:
        return "the id is missing"
    for name, value in (("id", student.id), ("rig", student.rig)):
        if not _ID.fullmatch(value) and (value or name == "id"):
            return f"{name} {value!r}: expected 1 to 63 letters a-z, digits, - and _, beginning with a letter or digit"
    if student.id.lower() in {each.lower() for each in known}:
        return f"id {student.id!r} occurs twice (upper and lower case are equal in file names)"
    if not student.name:
        return f"the name of {student.id} is missing"
    return ""
