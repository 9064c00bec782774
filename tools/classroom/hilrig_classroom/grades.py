"""Grades of a class: evaluates every attempt, chooses the one that counts, and applies penalties and overrides.

The result depends on the files only: the same files give the same bytes.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any, Final

from hilrig_classroom.assignment import Assignment, AssignmentConfig
from hilrig_classroom.attempts import owner_of
from hilrig_classroom.evaluation import Attempt, evaluate, identify, with_points
from hilrig_replay.analysis.similarity import find_similar
from hilrig_replay.grading.overlap import overlapping
from hilrig_replay.io.isolation import isolated
from hilrig_replay.io.paths import find_runs
from hilrig_replay.io.run import open_run
from hilrig_replay.io.segments import RunFiles
from hilrig_runtime.config.roster import Roster, Student, read_table
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import HilrigError, InputError
from hilrig_runtime.process.process_pool import process_pool

FORMAT: Final = "hilrig-grades-2"
"""Version of `grades.json`."""


@dataclass(frozen=True, slots=True)
class Override:
    """Points that a teacher has set."""

    points: float
    reason: str


@dataclass(frozen=True, slots=True)
class SimilarRun:
    """A run of another student with the same torques as one of this student."""

    file: str
    student: str
    """Id of the other student."""
    other_file: str
    share: float
    """Share of identical torques, 0 to 1."""
    same_recording: bool
    """Whether both files are recordings of the same session."""


@dataclass(frozen=True, slots=True)
class StudentGrade:
    """Grade of one student."""

    student: Student
    attempts: tuple[Attempt, ...]
    """In the order of their start."""
    used: Attempt | None
    """The attempt that counts; None: no attempt counts."""
    similar: tuple[SimilarRun, ...] = ()
    """Other students' runs with the same torques, at most one of each student: to be compared by a person."""
    override: Override | None = None

    @property
    def points(self) -> float | None:
        """Final points; None: no attempt and no override."""
        if self.override is not None:
            return self.override.points
        return None if self.used is None else round(self.used.points, 2)


@dataclass(frozen=True, slots=True)
class ClassGrades:
    """Grades of a class for one assignment."""

    assignment: Assignment
    grades: tuple[StudentGrade, ...]
    """In the order of the roster."""
    unassigned: tuple[tuple[str, str], ...]
    """Recordings without a student, each with the reason."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, without names."""
        config = self.assignment.config
        return {
            "format": FORMAT,
            "assignment": config.title,
            "points": config.rubric.points,
            "students": [
                {
                    "id": grade.student.id,
                    "points": grade.points,
                    "raw": None if grade.used is None else round(grade.used.raw, 4),
                    "penalty": None if grade.used is None else grade.used.penalty,
                    "override": None
                    if grade.override is None
                    else {"points": grade.override.points, "reason": grade.override.reason},
                    "used": None if grade.used is None else grade.used.file,
                    "similar": [asdict(run) for run in grade.similar],
                    "attempts": [attempt.as_dict() for attempt in grade.attempts],
                }
                for grade in self.grades
            ],
            "unassigned": [{"file": file, "reason": reason} for file, reason in self.unassigned],
        }


def grade_class(
    folder: Path,
    assignment: Assignment,
    roster: Roster,
    *,
    overrides: dict[str, Override] | None = None,
    only: str = "",
    workers: int | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> ClassGrades:
    """Grade the recordings of a folder.

    Args:
        folder: folder with the recordings, searched recursively.
        assignment: the assignment.
        roster: the class.
        overrides: points set by the teacher, by id.
        only: id of the only student to grade; empty: all.
        workers: number of processes; None: one per core.
        on_progress: called with the completed share, 0 to 1.

    Raises:
        InputError: the folder contains no recording, or `only` or an override names an unknown student.
    """
    overrides = overrides or {}
    students = roster.by_id()
    for wanted in (*overrides, *((only,) if only else ())):
        if wanted not in students:
            raise InputError(f"{wanted!r} is not in the roster; its ids are {', '.join(list(students)[:5])}, …")
    found: dict[str, list[Attempt]] = {student: [] for student in students}
    unassigned: list[tuple[str, str]] = []
    runs = find_runs([folder])
    attempts = []
    for done, attempt in enumerate(_attempts(runs, folder, assignment, roster, only, workers), start=1):
        attempts.append(attempt)
        if on_progress is not None:
            on_progress(done / len(runs))
    for attempt in _without_second_recordings(attempts):
        if attempt is not None:
            owner = owner_of(Path(attempt.file), attempt.rig, roster, attempt.recorded)
            if owner.student is None:
                unassigned.append((attempt.file, attempt.problem or owner.problem))
            elif not only or owner.student.id == only:
                found[owner.student.id].append(with_points(attempt, assignment))
    grades = [
        _grade(student, found[student.id], assignment, overrides.get(student.id))
        for student in roster.students
        if not only or student.id == only
    ]
    return ClassGrades(assignment, tuple(_with_similar(grades)), tuple(unassigned))


def read_overrides(path: Path) -> dict[str, Override]:
    """Read points set by a teacher: columns id, points, reason; a missing file has none.

    Raises:
        InputError: a row is invalid.
    """
    if not path.exists():
        return {}
    header, rows = read_table(path)
    if [name.strip().lower() for name in header[:2]] != ["id", "points"]:
        raise InputError(f"{path}: line 1: expected the columns id,points,reason, found {','.join(header)}")
    overrides = {}
    for line, row in rows:
        cells = [cell.strip() for cell in (*row, "", "")]
        try:
            points = float(cells[1].replace(",", "."))
            if not 0 <= points < float("inf"):
                raise ValueError
        except ValueError:
            raise InputError(f"{path}: line {line}: points {cells[1]!r}: expected a number of at least 0") from None
        overrides[cells[0]] = Override(points, cells[2])
    return overrides


def _attempts(
    runs: Sequence[RunFiles],
    folder: Path,
    assignment: Assignment,
    roster: Roster,
    only: str,
    workers: int | None,
) -> Iterable[Attempt | None]:
    with process_pool(len(runs), workers) as executor:
        yield from executor.map(_attempt, runs, repeat(folder), repeat(assignment.task), repeat(roster), repeat(only))


def _without_second_recordings(attempts: Sequence[Attempt | None]) -> list[Attempt | None]:
    """The attempts; a manual recording of a controller's session is not graded."""
    spans = [attempt.span for attempt in attempts if attempt is not None and attempt.span is not None]
    sessions = iter(overlapping(spans))
    checked: list[Attempt | None] = []
    for attempt in attempts:
        if attempt is not None and attempt.span is not None and (other := next(sessions)) and attempt.span.is_manual:
            checked.append(replace(attempt, problem=f"recorded manually at the time of {', '.join(other)}: not graded"))
        else:
            checked.append(attempt)
    return checked


def _attempt(files: RunFiles, folder: Path, task: TaskConfig, roster: Roster, only: str) -> Attempt | None:
    """Evaluate one run; None: it is not one of the student to be graded."""
    path = files[0]
    attempt = Attempt(tuple(each.relative_to(folder).as_posix() for each in files), "", "", "")
    try:
        with isolated(path):
            run = open_run(files)
            attempt = identify(attempt.files, run)
            owner = owner_of(Path(attempt.file), run.rig, roster, attempt.recorded).student
            if owner is None:
                return attempt
            return evaluate(attempt, run, task) if only in ("", owner.id) else None
    except HilrigError as error:
        text = str(error).removeprefix(f"{path}: ")
        return replace(attempt, problem=text, data_quality=text)


def _grade(
    student: Student, attempts: list[Attempt], assignment: Assignment, override: Override | None
) -> StudentGrade:
    ordered = tuple(sorted(attempts, key=lambda attempt: (attempt.started, attempt.file)))
    return StudentGrade(student, ordered, attempt_that_counts(ordered, assignment.config), override=override)


def attempt_that_counts(attempts: Sequence[Attempt], config: AssignmentConfig) -> Attempt | None:
    """The attempt whose points a student gets; None: no attempt can be graded.

    An attempt that is too late counts only if there is no other one.

    Args:
        attempts: attempts of the student in the order of their start.
        config: the assignment's settings.
    """
    counted = attempts[: config.max_attempts] if config.max_attempts else attempts
    gradable = [attempt for attempt in counted if not attempt.problem]
    accepted = [attempt for attempt in gradable if attempt.penalty is not None] or gradable
    if not accepted:
        return None
    # Of equal attempts, the first one.
    return accepted[-1] if config.attempts == "last" else max(accepted, key=lambda attempt: attempt.points)


def _with_similar(grades: Sequence[StudentGrade]) -> list[StudentGrade]:
    """Mark runs of different students with the same torques; members of a group hand in the same run.

    Of each pair of students, only the two runs that are most similar are stored.
    """
    owned = [(number, attempt) for number, grade in enumerate(grades) for attempt in grade.attempts]
    similar: dict[int, dict[int, SimilarRun]] = {}
    for one, other, share in find_similar([attempt.torques for _, attempt in owned]):
        (first, mine), (second, theirs) = owned[one], owned[other]
        groups = {grades[first].student.group, grades[second].student.group}
        if first == second or (len(groups) == 1 and "" not in groups):
            continue
        for number, own, friend, foreign in ((first, mine, second, theirs), (second, theirs, first, mine)):
            same = bool(own.session) and own.session == foreign.session
            run = SimilarRun(own.file, grades[friend].student.id, foreign.file, 1.0 if same else share, same)
            known = similar.setdefault(number, {})
            known[friend] = max(known.get(friend, run), run, key=lambda each: (each.same_recording, each.share))
    return [
        replace(grade, similar=tuple(runs for _, runs in sorted(similar.get(number, {}).items())))
        for number, grade in enumerate(grades)
    ]
