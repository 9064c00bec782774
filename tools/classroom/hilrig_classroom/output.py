"""Output folder of `hilrig grade`: grades, filled exports, pages and the teacher's overrides."""

import json
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from hilrig_classroom.assignment import Assignment
from hilrig_classroom.gradebook import FilledExport, fill_export, grades_csv
from hilrig_classroom.grades import FORMAT, grade_class, read_overrides
from hilrig_classroom.pages import class_page, write_student_pages
from hilrig_replay.io.output_file import output_file
from hilrig_runtime.config.roster import Roster, Student
from hilrig_runtime.config.validation import read_text
from hilrig_runtime.errors import InputError, OperationError

GRADES_JSON: Final = "grades.json"
GRADES_CSV: Final = "grades.csv"
CLASS_PAGE: Final = "class.html"
OVERRIDES: Final = "overrides.csv"
PAGES: Final = "students"
SMALL_CLASS: Final = 8
"""Students from which on several processes are faster than one: the start of a process takes a second."""

Progress = Callable[[float], None]


class GradeFolder:
    """The results of one assignment in a folder, which is created if it is missing.

    `workers` is the number of processes; None: one per core, or one for a small class.
    """

    def __init__(
        self,
        out: Path,
        folder: Path,
        assignment: Assignment,
        roster: Roster,
        *,
        names: bool = False,
        workers: int | None = None,
    ) -> None:
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder; expected the folder with the recordings of the class")
        self._out = out
        self._folder = folder
        self._assignment = assignment
        self._roster = roster
        self._workers = 1 if workers is None and len(roster.students) < SMALL_CLASS else workers
        self._page_names = {student.id: f"{_file_name(student, names)}.html" for student in roster.students}
        try:
            (out / PAGES).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OperationError(f"{out}: can't be created: {error.strerror}") from error

    def grade(self, student: str = "", on_progress: Progress | None = None) -> dict[str, Any]:
        """Grade the class or one student; write grades.json, grades.csv and the class page; return the document.

        Raises:
            InputError: invalid overrides, or no earlier grades of the others.
            OperationError: a file can't be written.
        """
        previous = self._previous() if student else {}
        overrides = self._out / OVERRIDES
        if not overrides.exists():
            overrides.write_text("id,points,reason\n", encoding="utf-8")
        document = grade_class(
            self._folder,
            self._assignment,
            self._roster,
            overrides=read_overrides(overrides),
            only=student,
            workers=self._workers,
            on_progress=on_progress,
        ).as_dict()
        if student:
            (graded,) = [row for row in document["students"] if row["id"] == student]
            # Similar runs are those of the last grading of the whole class.
            graded["similar"] = next((row["similar"] for row in previous["students"] if row["id"] == student), [])
            rows = {row["id"]: row for row in previous["students"]} | {student: graded}
            order = [each.id for each in self._roster.students if each.id in rows]
            document["students"] = [rows[each] for each in order]
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        self._write(GRADES_JSON, text)
        self._write(GRADES_CSV, grades_csv(document, self._roster))
        pages = {name: f"{PAGES}/{file}" for name, file in self._page_names.items()}
        self._write(CLASS_PAGE, class_page(document, self._roster, pages))
        return document

    def fill(self, path: Path, document: dict[str, Any]) -> tuple[Path, FilledExport]:
        """Write a filled gradebook export, "<name>.filled.csv"; return its path and its content.

        Raises:
            InputError: the export is invalid.
            OperationError: the file can't be written.
        """
        export = fill_export(path, document, self._roster)
        name = f"{path.stem}.filled.csv"
        self._write(name, export.text)
        return self._out / name, export

    def write_pages(self, document: dict[str, Any], student: str = "", on_progress: Progress | None = None) -> None:
        """Write the pages of all students, or of one.

        Raises:
            OperationError: a page can't be written.
        """
        graded = {row["id"] for row in document["students"]}
        students = [each for each in self._roster.students if each.id in graded and student in ("", each.id)]
        write_student_pages(
            self._folder,
            self._out / PAGES,
            document,
            self._assignment,
            students,
            self._page_names,
            workers=self._workers,
            on_progress=on_progress,
        )

    def problems(self, document: dict[str, Any]) -> list[str]:
        """Sentences on recordings that have no student or can't be graded."""
        sentences = [f"{each['file']}: {each['reason']}" for each in document["unassigned"]]
        for row in document["students"]:
            sentences += [f"{each['file']}: {each['problem']}" for each in row["attempts"] if each["problem"]]
        return sentences

    def _previous(self) -> dict[str, Any]:
        path = self._out / GRADES_JSON
        if not path.exists():
            raise InputError(f"{path}: missing; grade the whole class first, without --student")
        try:
            document = json.loads(read_text(path))
        except ValueError as error:
            raise InputError(f"{path}: invalid JSON: {error}") from error
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise InputError(f"{path}: not a file of this version: grade the whole class again, without --student")
        return document

    def _write(self, name: str, text: str) -> None:
        with output_file(self._out / name) as temporary:
            temporary.write_bytes(text.encode("utf-8"))


def _file_name(student: Student, with_name: bool) -> str:
    if not with_name:
        return student.id
    letters = unicodedata.normalize("NFC", student.name)
    # Marks are the vowels of many scripts.
    kept = (letter.isalnum() or unicodedata.category(letter).startswith("M") for letter in letters)
    name = "".join(letter if keep else "_" for letter, keep in zip(letters, kept, strict=True)).strip("_")
    # At most 255 bytes in UTF-8, with the id in front and the suffix.
    return f"{student.id}-{name.encode()[:120].decode(errors='ignore')}" if name else student.id
