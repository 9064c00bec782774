"""Grades of a class: evaluates every attempt, chooses the one that counts, and applies penalties and overrides.

The result depends on the files only: the same files give the same bytes.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import repeat
from pathlib import Path
from typing import Any, Final

from hilrig_classroom.assignment import Assignment
from hilrig_classroom.attempts import owner_of
from hilrig_replay.analysis.similarity import TorqueSketch, find_similar
from hilrig_replay.analysis.summary import summarize
from hilrig_replay.grading.overlap import Span, overlapping
from hilrig_replay.io.isolation import isolated
from hilrig_replay.io.paths import find_runs
from hilrig_replay.io.run import open_run
from hilrig_replay.io.segments import RunFiles
from hilrig_runtime.config.roster import Roster, Student, read_table
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import HilrigError, InputError
from hilrig_runtime.process.process_pool import process_pool

FORMAT: Final = "hilrig-grades-1"
"""Version of `grades.json`."""


@dataclass(frozen=True, slots=True)
class Goal:
    """One goal of the task in an attempt."""

    name: str
    reached: bool
    text: str


@dataclass(frozen=True, slots=True)
class Attempt:
    """One evaluated run."""

    files: tuple[str, ...]
    """Its files, relative to the graded folder: one, or the segments of a session."""
    session: str
    rig: str
    started: str
    """Start of the recording, UTC; empty: not recorded."""
    recorded: tuple[str, ...] = ()
    """Ids of the students who owned the rig; empty: the lab had no roster."""
    goals: tuple[Goal, ...] = ()
    score: float = 0.0
    """Share of the goals that were reached, 0 to 1."""
    latency_ms: float | None = None
    """Age of the acting torque, 95th percentile, ms; None: no valid figure."""
    work_j: float = 0.0
    problem: str = ""
    """Reason why the file can't be graded; empty: it is graded."""
    data_quality: str = ""
    """Reasons why its latency is not valid; empty: it is valid."""
    raw: float = 0.0
    """Points without a penalty."""
    penalty: float | None = 0.0
    """Share of the points that is lost because it is late; None: too late."""
    span: Span | None = None
    """Time of the run; None: it can't be read."""
    torques: TorqueSketch = field(default_factory=TorqueSketch, repr=False, compare=False)

    @property
    def file(self) -> str:
        """The first of its files."""
        return self.files[0]

    @property
    def points(self) -> float:
        """Points with the penalty; 0 for an attempt that is too late."""
        return 0.0 if self.penalty is None else self.raw * (1.0 - self.penalty)


@dataclass(frozen=True, slots=True)
class Override:
    """Points that a teacher has set."""

    points: float
    reason: str


@dataclass(frozen=True, slots=True)
class StudentGrade:
    """Grade of one student."""

    student: Student
    attempts: tuple[Attempt, ...]
    """In the order of their start."""
    used: Attempt | None
    """The attempt that counts; None: no attempt counts."""
    similar: tuple[str, ...] = ()
    """Other students' runs with the same torques: to be compared by a person."""
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
                    "similar": list(grade.similar),
                    "attempts": [_attempt_as_dict(attempt) for attempt in grade.attempts],
                }
                for grade in self.grades
            ],
            "unassigned": [{"file": file, "reason": reason} for file, reason in self.unassigned],
        }


def _attempt_as_dict(attempt: Attempt) -> dict[str, Any]:
    return {
        "file": attempt.file,
        "files": list(attempt.files),
        "session": attempt.session,
        "rig": attempt.rig,
        "started": attempt.started,
        "goals": [{"name": goal.name, "reached": goal.reached, "text": goal.text} for goal in attempt.goals],
        "score": round(attempt.score, 6),
        "latency_ms": None if attempt.latency_ms is None else round(attempt.latency_ms, 4),
        "work_j": round(attempt.work_j, 4),
        "raw": round(attempt.raw, 4),
        "penalty": attempt.penalty,
        "data_quality": attempt.data_quality,
        "problem": attempt.problem,
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
                found[owner.student.id].append(_with_points(attempt, assignment))
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
    names = tuple(each.relative_to(folder).as_posix() for each in files)
    rig = session = started = ""
    recorded: tuple[str, ...] = ()
    try:
        with isolated(path):
            run = open_run(files)
            rig, session, started = run.rig, run.session, run.started
            recorded = run.students
            owner = owner_of(Path(names[0]), rig, roster, recorded).student
            if owner is None or (only and owner.id != only):
                return Attempt(names, session, rig, started, recorded) if owner is None else None
            summary = summarize(run, task)
    except HilrigError as error:
        text = str(error).removeprefix(f"{path}: ")
        return Attempt(names, session, rig, started, recorded, problem=text, data_quality=text)
    grade, latency = summary.grade, summary.latency
    return Attempt(
        files=names,
        session=session,
        rig=rig,
        started=started,
        recorded=recorded,
        goals=() if grade is None else tuple(Goal(*line) for line in grade.lines()),
        score=0.0 if grade is None else grade.score,
        latency_ms=latency.age_ms.p95 if latency.fit and latency.age_ms is not None else None,
        work_j=summary.motion.work_j,
        data_quality=latency.reason_text(),
        span=summary.span,
        torques=summary.torques,
    )


def _with_points(attempt: Attempt, assignment: Assignment) -> Attempt:
    rubric = assignment.config.rubric
    share = rubric.goals_weight * attempt.score
    if rubric.latency_ms is not None:
        share += rubric.latency_ms.weight * rubric.latency_ms.share(attempt.latency_ms)
    if rubric.energy_j is not None:
        # An arm that does not move uses no energy: the points are earned with the goals only.
        share += rubric.energy_j.weight * rubric.energy_j.share(attempt.work_j) * attempt.score
    raw = 0.0 if attempt.problem else rubric.points * share
    return replace(attempt, raw=raw, penalty=assignment.penalty(_start(attempt.started)))


def _start(text: str) -> datetime | None:
    try:
        start = datetime.fromisoformat(text)
    except ValueError:
        return None
    return start if start.tzinfo is not None else None


def _grade(
    student: Student, attempts: list[Attempt], assignment: Assignment, override: Override | None
) -> StudentGrade:
    config = assignment.config
    ordered = tuple(sorted(attempts, key=lambda attempt: (attempt.started, attempt.file)))
    counted = ordered[: config.max_attempts] if config.max_attempts else ordered
    gradable = [attempt for attempt in counted if not attempt.problem]
    used: Attempt | None = None
    if gradable:
        # Of equal attempts, the first one.
        used = gradable[-1] if config.attempts == "last" else max(gradable, key=lambda attempt: attempt.points)
    return StudentGrade(student, ordered, used, override=override)


def _with_similar(grades: Sequence[StudentGrade]) -> list[StudentGrade]:
    """Mark runs of different students with the same torques; members of a group hand in the same run."""
    owned = [(number, attempt) for number, grade in enumerate(grades) for attempt in grade.attempts]
    similar: dict[int, list[str]] = {}
    for one, other, share in find_similar([attempt.torques for _, attempt in owned]):
        (first, mine), (second, theirs) = owned[one], owned[other]
        groups = {grades[first].student.group, grades[second].student.group}
        if first == second or (len(groups) == 1 and "" not in groups):
            continue
        for number, own, friend, foreign in ((first, mine, second, theirs), (second, theirs, first, mine)):
            same = "the same recording" if own.session == foreign.session else f"{int(100 * share)} % same torques"
            similar.setdefault(number, []).append(f"{own.file}: {same} as {grades[friend].student.id}/{foreign.file}")
    return [replace(grade, similar=tuple(sorted(similar.get(number, ())))) for number, grade in enumerate(grades)]
