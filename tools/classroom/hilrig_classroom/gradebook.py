"""Gradebook files: `grades.csv`, and the exports of learning management systems filled with points and feedback.

Grades are the values of `grades.json`; names come from the roster. Text cells that a spreadsheet would execute as a
formula get an apostrophe. Points are numbers with a decimal point.
"""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hilrig_runtime.config.roster import Roster, delimiter_of
from hilrig_runtime.config.validation import read_text
from hilrig_runtime.errors import InputError
from hilrig_runtime.escaping import csv_text

NO_GRADE: Final = "-"
"""Moodle and Canvas: no grade. An empty cell or 0 would be a grade in one of them."""
_CANVAS_FIRST: Final = "Student"
_SIS_KEYS: Final = frozenset({"SIS User ID", "SIS Login ID"})
_CANVAS_KEYS: Final = (*sorted(_SIS_KEYS, reverse=True), "ID")
_CANVAS_RESERVED: Final = re.compile(r"\b(Current|Final|Override) (Score|Grade|Points)\b")
"""Canvas drops columns with such headers."""
MAX_SIMILAR: Final = 5
"""Number of similar students that a cell of `grades.csv` names."""
_MOODLE_KEYS: Final = ("ID number", "Username", "Email address", "Identifier")


@dataclass(frozen=True, slots=True)
class FilledExport:
    """A gradebook export with the grades of a class."""

    text: str
    system: str
    """"Canvas" or "Moodle"."""
    filled: int
    """Rows that got points."""
    unknown: tuple[str, ...]
    """Keys of rows that are not in the roster."""
    absent: tuple[str, ...]
    """Ids of the roster that have no row."""


def grades_csv(document: dict[str, Any], roster: Roster) -> str:
    """Content of `grades.csv`: one row a student of the roster, one column a goal."""
    by_id = {row["id"]: row for row in document["students"]}
    goals = _goal_names(document)
    header = ["id", "name", "group", "points", "max", "raw", "penalty", "override", "override_reason"]
    header += ["attempt", "attempts", *(f"goal: {goal}" for goal in goals), "data_quality", "similar"]
    rows = [header]
    for student in roster.students:
        row = by_id.get(student.id)
        if row is None:
            continue
        attempt = used_attempt(row) or {}
        reached = {goal["name"]: goal["reached"] for goal in attempt.get("goals", ())}
        override = row["override"] or {"points": None, "reason": ""}
        rows.append(
            [
                student.id,
                student.name,
                student.group,
                _number(row["points"]),
                _number(document["points"]),
                _number(row["raw"]),
                "too late" if attempt and row["penalty"] is None else _number(row["penalty"]),
                _number(override["points"]),
                override["reason"],
                row["used"] or "",
                str(len(row["attempts"])),
                *("" if goal not in reached else "yes" if reached[goal] else "no" for goal in goals),
                attempt.get("data_quality", ""),
                similar_text(row),
            ]
        )
    return _as_csv(rows, ",")


def fill_export(path: Path, document: dict[str, Any], roster: Roster) -> FilledExport:
    """Fill the gradebook export of Moodle or Canvas; its columns, delimiter and rows are kept.

    Raises:
        InputError: the file is neither, or has no column with the ids of the roster.
    """
    raw = read_text(path)
    text = raw.removeprefix("\ufeff")
    delimiter = delimiter_of(text)
    try:
        table = [row for row in csv.reader(io.StringIO(text), delimiter=delimiter) if row]
    except csv.Error as error:
        raise InputError(f"{path}: no CSV table: {error}") from error
    if not table:
        raise InputError(f"{path}: empty file; expected the gradebook export of Moodle or Canvas")
    for number, row in enumerate(table[1:], start=2):
        if any(row[len(table[0]) :]):
            raise InputError(
                f"{path}: row {number} has {len(row)} cells, the header {len(table[0])}: export the gradebook again"
            )
        del row[len(table[0]) :]
    header, title = table[0], str(document["assignment"])
    is_canvas = _is_canvas(header, title)
    keys = _CANVAS_KEYS if is_canvas else _MOODLE_KEYS
    key = _key_column(path, header, table[1:], keys, roster)
    if is_canvas:
        grade_at, feedback_at = _column(header, _canvas_title(title, header)), None
    else:
        grade_at, feedback_at = _column(header, title), _column(header, f"{title} (feedback)")
    students = {row["id"].lower(): row for row in document["students"]}
    filled = 0
    seen: set[str] = set()
    unknown: list[str] = []
    for row in table[1:]:
        row.extend([""] * (len(header) - len(row)))
        if is_canvas and row[0].strip().startswith("Points Possible"):
            row[grade_at] = _number(document["points"])
            continue
        name = _id_of(row[key])
        if name not in students:
            if name:
                unknown.append(row[key].strip())
            continue
        seen.add(name)
        points = students[name]["points"]
        filled += points is not None
        row[grade_at] = NO_GRADE if points is None else _number(points)
        if feedback_at is not None:
            row[feedback_at] = feedback(students[name], document)
    absent = tuple(student.id for student in roster.students if student.id.lower() not in seen)
    mark = "\ufeff" if raw.startswith("\ufeff") else ""
    changed = {at for at in (grade_at, feedback_at) if at is not None}
    return FilledExport(
        mark + _as_csv(table, delimiter, escaped=changed),
        "Canvas" if is_canvas else "Moodle",
        filled,
        tuple(unknown),
        absent,
    )


def feedback(row: dict[str, Any], document: dict[str, Any]) -> str:
    """One-line feedback for a student: points, goals and penalty."""
    attempt = used_attempt(row)
    if attempt is None:
        return "No run that can be graded." if row["override"] is None else row["override"]["reason"] or "Set manually."
    reached = sum(goal["reached"] for goal in attempt["goals"])
    parts = [
        f"{_number(row['points'])} of {_number(document['points'])} points",
        f"{reached} of {len(attempt['goals'])} goals",
    ]
    if row["penalty"]:
        parts.append(f"{row['penalty']:.0%} subtracted because it is late")
    if row["penalty"] is None:
        parts.append("after the last day for late attempts")
    parts += [f"missed: {goal['name']} ({goal['text']})" for goal in attempt["goals"] if not goal["reached"]]
    if row["override"] is not None:
        parts.append(f"set manually: {row['override']['reason'] or 'no reason given'}")
    return "; ".join(parts)


def similar_text(row: dict[str, Any]) -> str:
    """Other students with the same torques, the most similar ones first; empty: none."""
    runs = sorted(row["similar"], key=lambda run: (not run["same_recording"], -run["share"]))
    texts = [f"{run['student']} ({similarity(run)})" for run in runs[:MAX_SIMILAR]]
    return ", ".join(texts) + (f" and {len(runs) - MAX_SIMILAR} more" if len(runs) > MAX_SIMILAR else "")


def similarity(run: dict[str, Any]) -> str:
    """Similarity of two runs as text."""
    return "the same recording" if run["same_recording"] else f"{int(100 * run['share'])} % same torques"


def used_attempt(row: dict[str, Any]) -> dict[str, Any] | None:
    """The attempt of a student that counts; None: no attempt counts."""
    return next((attempt for attempt in row["attempts"] if attempt["file"] == row["used"]), None)


def _goal_names(document: dict[str, Any]) -> list[str]:
    names = (goal["name"] for row in document["students"] for attempt in row["attempts"] for goal in attempt["goals"])
    return list(dict.fromkeys(names))


def _key_column(
    path: Path, header: Sequence[str], rows: Sequence[list[str]], keys: Sequence[str], roster: Roster
) -> int:
    """Column whose cells are ids of the roster: of those with a known header, else of all, that with the most."""
    ids = {student.id.lower() for student in roster.students}
    found: dict[int, list[str]] = {at: [] for at in range(len(header))}
    for row in rows:
        for at, cell in enumerate(row):
            if (name := _id_of(cell)) in ids:
                found[at].append(name)
    known = [at for at, name in enumerate(header) if name.strip() in keys]
    # With headers in another language: a column with half of the ids, each of them once.
    enough = max(min(len(rows), len(ids)) / 2, 1)
    candidates = [at for at in known if found[at]]
    candidates = candidates or [at for at, names in found.items() if len(names) == len(set(names)) >= enough]
    if candidates:
        return max(candidates, key=lambda at: len(found[at]))
    if not known:
        raise InputError(
            f"{path}: no column with an id: found {', '.join(header[:6])}; expected the gradebook export of Moodle "
            f"({', '.join(_MOODLE_KEYS)}) or of Canvas (Student, {', '.join(_CANVAS_KEYS)})"
        )
    names = ", ".join(header[at] for at in known)
    raise InputError(f"{path}: no id of the roster in {names}: use the ids of this gradebook in the roster")


def _id_of(cell: str) -> str:
    """Id in a cell; of an e-mail address, the part before the @."""
    return cell.strip().lstrip("'").partition("@")[0].lower()


def _is_canvas(header: Sequence[str], title: str) -> bool:
    """Whether the header is one of Canvas, in any language: it has SIS columns, or the assignment with its number."""
    names = {name.strip() for name in header}
    return header[0].strip() == _CANVAS_FIRST or bool(names & _SIS_KEYS) or _numbered(title, header) is not None


def _canvas_title(title: str, header: Sequence[str]) -> str:
    """Header of the assignment's column: "Title (12345)" of the export, else the title."""
    name = _numbered(title, header)
    if name is None:
        check_title(title)
    return name or title


def _numbered(title: str, header: Sequence[str]) -> str | None:
    """The header "Title (12345)"; None: not found."""
    pattern = re.compile(re.escape(title) + r"\s*\(\d+\)")
    return next((name for name in header if pattern.fullmatch(name.strip())), None)


def check_title(title: str) -> None:
    """Check that a title can be a column of the gradebooks.

    Raises:
        InputError: Canvas drops columns with such a title.
    """
    if _CANVAS_RESERVED.search(title):
        raise InputError(f"title {title!r}: Canvas drops columns with such a name; choose another title")


def _column(header: list[str], name: str) -> int:
    """Index of a column, which is added if it is missing."""
    if name not in header:
        header.append(name)
    return header.index(name)


def _as_csv(rows: Sequence[Sequence[str]], delimiter: str, *, escaped: set[int] | None = None) -> str:
    """Rows as CSV text; only the columns `escaped` are changed, by default all: others are of another program."""
    text = io.StringIO()
    writer = csv.writer(text, delimiter=delimiter, lineterminator="\r\n")
    for row in rows:
        writer.writerow(
            cell if _is_number(cell) or (escaped is not None and at not in escaped) else csv_text(cell)
            for at, cell in enumerate(row)
        )
    return text.getvalue()


def _is_number(cell: str) -> bool:
    return cell == NO_GRADE or re.fullmatch(r"-?\d+(\.\d+)?", cell) is not None


def _number(value: float | None) -> str:
    return "" if value is None else f"{round(value, 3):g}"
