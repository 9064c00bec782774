"""Evaluation of one run by an assignment: goals, figures and points."""

from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

from hilrig_classroom.assignment import Assignment
from hilrig_replay.analysis.similarity import TorqueSketch
from hilrig_replay.analysis.summary import summarize
from hilrig_replay.grading.overlap import Span
from hilrig_replay.io.run import Run
from hilrig_runtime.config.task import TaskConfig


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
    """Ids of the students who owned the rig, as recorded; empty: the lab had no roster."""
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

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "file": self.file,
            "files": list(self.files),
            "session": self.session,
            "rig": self.rig,
            "started": self.started,
            "goals": [{"name": goal.name, "reached": goal.reached, "text": goal.text} for goal in self.goals],
            "score": round(self.score, 6),
            "latency_ms": None if self.latency_ms is None else round(self.latency_ms, 4),
            "work_j": round(self.work_j, 4),
            "raw": round(self.raw, 4),
            "penalty": self.penalty,
            "data_quality": self.data_quality,
            "problem": self.problem,
        }


def identify(names: tuple[str, ...], run: Run) -> Attempt:
    """Attempt of a run that is not evaluated: its files, as given, and the metadata of the run."""
    return Attempt(names, run.session, run.rig, run.started, run.students)


def evaluate(attempt: Attempt, run: Run, task: TaskConfig) -> Attempt:
    """Evaluate the run of an attempt: goals and figures, without points.

    Raises:
        HilrigError: the run can't be evaluated.
    """
    summary = summarize(run, task)
    grade, latency = summary.grade, summary.latency
    return replace(
        attempt,
        goals=() if grade is None else tuple(Goal(*line) for line in grade.lines()),
        score=0.0 if grade is None else grade.score,
        latency_ms=latency.age_ms.p95 if latency.fit and latency.age_ms is not None else None,
        work_j=summary.motion.work_j,
        data_quality=latency.reason_text(),
        span=summary.span,
        torques=summary.torques,
    )


def with_points(attempt: Attempt, assignment: Assignment) -> Attempt:
    """Add points and penalty to an evaluated attempt."""
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
