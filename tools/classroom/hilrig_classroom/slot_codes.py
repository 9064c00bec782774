"""Codes of a lab slot: made for the students of a roster, and printed with their names."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path

from hilrig_runtime.config.claim_codes import (
    CODES_FILE,
    ClaimCode,
    as_csv,
    digest_of,
    new_code,
    read_codes,
    write_codes,
)
from hilrig_runtime.config.roster import Roster, Student
from hilrig_runtime.errors import InputError
from hilrig_runtime.escaping import csv_text


def select_students(roster: Roster, group: str, ids: Iterable[str]) -> list[Student]:
    """Return the students of a group (empty: of all) or with these ids (none: all).

    Raises:
        InputError: there is no such group or student.
    """
    known, wanted = roster.by_id(), list(ids)
    for one in wanted:
        if one not in known:
            raise InputError(f"--student {one}: not in the roster; its ids are {', '.join(list(known)[:5])}, …")
    students = [known[one] for one in wanted] if wanted else list(roster.students)
    found = [student for student in students if group in ("", student.group)]
    if not found:
        groups = sorted({student.group for student in roster.students} - {""})
        raise InputError(f"--group {group}: no such students; the roster has the groups {', '.join(groups) or 'none'}")
    return found


def parse_end(text: str, now: datetime) -> datetime:
    """Return the end of a lab slot, "HH:MM" (its next occurrence) or a date and time; without zone it is that of `now`.

    Raises:
        InputError: it is no time, or has passed.
    """
    try:
        end = datetime.fromisoformat(f"{now:%Y-%m-%d}T{text}" if len(text) <= len("HH:MM") else text)
    except ValueError:
        raise InputError(f'--until {text}: expected "HH:MM" or a date and time as "2026-12-01 11:30"') from None
    end = end if end.tzinfo is not None else end.replace(tzinfo=now.tzinfo)
    if len(text) <= len("HH:MM") and end <= now:
        end += timedelta(days=1)
    if end <= now:
        raise InputError(f"--until {text}: this time has passed")
    return end


def issue_codes(folder: Path, students: Iterable[Student], ends: datetime, now: datetime) -> dict[str, str]:
    """Write new codes of students into a folder; codes of others that have not ended are kept.

    Returns the codes by id. They are stored nowhere: the file has their hashes.

    Raises:
        HilrigError: the codes of the others can't be read, or the file can't be written.
    """
    codes = {student.id: new_code() for student in students}
    kept = [] if not (folder / CODES_FILE).exists() else read_codes(folder)
    issued = [ClaimCode(student.id, student.rig, ends, digest_of(codes[student.id])) for student in students]
    write_codes(folder, [*(code for code in kept if code.student not in codes and code.ends > now), *issued])
    return codes


def codes_csv(students: Sequence[Student], codes: Mapping[str, str], ends: datetime) -> str:
    """Return a table of codes to be printed or mailed; a cell that a spreadsheet would execute gets an apostrophe."""
    header = ("id", "name", "group", "rig", "code", "until")
    until = f"{ends:%Y-%m-%d %H:%M}"
    rows = [(one.id, one.name, one.group, one.rig, codes[one.id], until) for one in students]
    return as_csv([header, *([csv_text(cell) for cell in row] for row in rows)])
