"""Roster of a class: the students, and the rig of each.

A CSV file with the columns id, name, group, rig; the last two may be missing. Recordings, events and the bus contain
ids only. Names are joined where grades and pages are made.
"""

import csv
import io
import re
import unicodedata
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from hilrig_runtime.config.validation import read_text
from hilrig_runtime.errors import InputError, first_errors, list_names
from hilrig_schemas.topics import NAME_PATTERN

_ID: Final = re.compile(NAME_PATTERN)
MAX_STUDENTS: Final = 10_000
COLUMNS: Final = ("id", "name", "group", "rig")
DELIMITERS: Final = ",;\t"
MAX_TEAM: Final = 16
"""Largest number of students that share a rig without claims."""
_MAX_ERRORS: Final = 100


@dataclass(frozen=True, slots=True)
class Student:
    """One student of a roster."""

    id: str
    name: str
    group: str = ""
    rig: str = ""
    """Name of the student's rig; empty: none is assigned."""
    line: int = field(default=0, compare=False)
    """Line of the file; 0: not from a file."""


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

    def by_rig(self) -> dict[str, list[Student]]:
        """Students to whom a rig is assigned, by its name."""
        found: dict[str, list[Student]] = {}
        for student in self.students:
            if student.rig:
                found.setdefault(student.rig, []).append(student)
        return found


def read_roster(path: Path) -> Roster:
    """Read a roster: UTF-8 with or without byte order mark, separated by comma, semicolon or tab.

    Raises:
        InputError: the file can't be read, or rows are invalid; names each mistake with its line.
    """
    header, rows = read_table(path)
    names = [name.strip().lower() for name in header]
    columns = {name: at for at, name in enumerate(names)}
    errors = [f"line 1: column {name!r} occurs twice" for name in COLUMNS if names.count(name) > 1]
    missing = [name for name in ("id", "name") if name not in columns]
    if missing:
        errors.append(
            f"line 1: column {missing[0]!r} is missing; found {list_names(header, 20) or 'nothing'}; "
            f"expected {', '.join(COLUMNS)}"
        )
    _raise(path, errors)
    students: dict[str, Student] = {}
    for line, row in rows:
        values = {name: _clean(row[at]) if at < len(row) else "" for name, at in columns.items()}
        student = Student(values["id"], values["name"], values.get("group", ""), values.get("rig", ""), line)
        surplus = [cell for cell in row[len(header) :] if cell.strip()]
        if surplus:
            errors.append(
                f"line {line}: {len(row)} cells, the header has {len(header)}: put quotation marks around a "
                "cell that contains the separator"
            )
        elif problem := _problem(student, students):
            errors.append(f"line {line}: {problem}")
        else:
            students[student.id.lower()] = student
    if len(students) > MAX_STUDENTS:
        errors.append(f"{len(students)} students, at most {MAX_STUDENTS} are accepted")
    if not students and not errors:
        errors.append("no students below the header")
    _raise(path, errors)
    return Roster(tuple(students.values()))


def check_rigs(path: Path, roster: Roster, rigs: Collection[str], *, claimed: bool) -> None:
    """Check the rigs of a roster against those of its lab.

    Args:
        path: the roster, for messages.
        roster: its content.
        rigs: names of the rigs of the lab.
        claimed: whether students claim rigs with codes, so that several of them may have the same rig.

    Raises:
        InputError: a rig is unknown, or belongs to students of different groups; names each mistake with its line.
    """
    mistakes = list(_unknown_rigs(roster, rigs))
    if not claimed:
        mistakes += _shared_rigs(roster.by_rig())
    _raise(path, [f"line {line}: {text}" for line, text in sorted(mistakes)])


def _unknown_rigs(roster: Roster, rigs: Collection[str]) -> Iterator[tuple[int, str]]:
    known = list_names(list(rigs), 8)
    for student in roster.students:
        if student.rig and student.rig not in rigs:
            yield student.line, f"unknown rig {student.rig!r} of {student.id}; the lab has {known}"


def _shared_rigs(students: Mapping[str, list[Student]]) -> Iterator[tuple[int, str]]:
    for rig, (first, *others) in students.items():
        if len(others) >= MAX_TEAM:
            yield others[MAX_TEAM - 1].line, f"{rig} has {len(others) + 1} students, at most {MAX_TEAM} share a rig"
        for other in others:
            if not other.group or other.group != first.group:
                yield (
                    other.line,
                    f"{rig} of {other.id} is also the rig of {first.id} (line {first.line}): put both into one group, "
                    "give them different rigs, or let students claim rigs (classroom.claims in lab.toml)",
                )


def read_table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Read a CSV file: its header, and its other rows with their line numbers; empty rows are left out.

    Raises:
        InputError: the file can't be read, or is no table.
    """
    text = read_text(path).removeprefix("\ufeff")
    reader = csv.reader(io.StringIO(text), delimiter=delimiter_of(text), strict=True)
    rows: list[tuple[int, list[str]]] = []
    # A cell may contain line breaks: a row begins after the last line of the one before.
    end = 0
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append((end + 1, row))
            end = reader.line_num
    except csv.Error as error:
        raise InputError(f"{path}: line {end + 1}: no CSV table: {error}") from error
    if not rows:
        raise InputError(f"{path}: empty file; expected a header line {','.join(COLUMNS)}")
    return rows[0][1], rows[1:]


def delimiter_of(text: str) -> str:
    """Delimiter of a CSV text: the one that occurs most often in its first line outside quotation marks."""
    first = text.lstrip().split("\n", 1)[0]
    return max(DELIMITERS, key=re.sub('"[^"]*"', "", first).count)


def _clean(cell: str) -> str:
    # One form of each letter, so that names compare equal whatever program wrote them. A name is one line.
    return unicodedata.normalize("NFC", " ".join(cell.split()))


def _problem(student: Student, known: Mapping[str, Student]) -> str:
    """Mistake in a row; empty: none. `known`: the students above, by their id in lower case."""
    if not student.id:
        return "the id is missing"
    for name, value in (("id", student.id), ("rig", student.rig)):
        if not _ID.fullmatch(value) and (value or name == "id"):
            return f"{name} {value!r}: expected 1 to 63 letters a-z, digits, - and _, beginning with a letter or digit"
    if other := known.get(student.id.lower()):
        return (
            f"id {student.id!r} occurs twice, first in line {other.line} (upper and lower case are equal in file names)"
        )
    if not student.name:
        return f"the name of {student.id} is missing"
    if any(unicodedata.category(letter) == "Cc" for letter in student.name + student.group):
        return f"name or group of {student.id} contains a control character: type it again"
    return ""


def _raise(path: Path, errors: list[str]) -> None:
    """Raise an error with the mistakes, if there are any."""
    if errors:
        raise InputError("\n".join(f"{path}: {line}" for line in first_errors(errors, limit=_MAX_ERRORS)))
