"""Outputs of the commands for a class."""

from typing import Literal

from pydantic import Field

from hilrig_classroom.evaluation import Goal
from hilrig_classroom.grades import SimilarRun
from hilrig_cli.json_output.model import JsonOutput, Values


class AttemptValues(Values):
    """An attempt of a student: one recording."""

    file: str
    """The first of its files, relative to the folder of the recordings."""
    files: list[str]
    session: str
    rig: str
    started: str
    """Start of the recording, UTC; empty: not recorded."""
    goals: list[Goal]
    score: float
    """Share of the goals that were reached, 0 to 1."""
    latency_ms: float | None
    """Age of the acting torque, 95th percentile; null: no valid figure."""
    work_j: float
    """Work of the drives."""
    raw: float
    """Points without a penalty."""
    penalty: float | None
    """Share of the points that is lost because it is late; null: too late."""
    data_quality: str
    """Reasons why its latency is not valid; empty: it is valid."""
    problem: str
    """Reason why it can't be graded; empty: it is graded."""


class OverrideValues(Values):
    """Points that a teacher has set."""

    points: float
    reason: str


class StudentValues(Values):
    """Grade of a student."""

    id: str
    points: float | None
    """Final points; null: no attempt and no override."""
    raw: float | None
    """Points of the attempt that counts, without a penalty; null: no attempt counts."""
    penalty: float | None
    """Its penalty, a share of the points, 0 to 1; null: no attempt counts."""
    override: OverrideValues | None
    used: str | None
    """File of the attempt that counts."""
    similar: list[SimilarRun]
    """Runs of other students with the same torques."""
    attempts: list[AttemptValues]


class UnassignedFile(Values):
    """A recording without a student."""

    file: str
    reason: str


class GradesDocument(Values):
    """Content of grades.json."""

    format: str
    """Version of grades.json."""
    assignment: str
    """Title of the assignment."""
    points: float
    """Points of the assignment."""
    students: list[StudentValues]
    """In the order of the roster."""
    unassigned: list[UnassignedFile]


class GradeOutput(JsonOutput):
    """Grades of a class for one assignment."""

    schema_id: Literal["hilrig.grade/1"] = Field(default="hilrig.grade/1", alias="schema")
    folder: str
    """Folder of the results."""
    grades: GradesDocument
    exports: list[str]
    """Paths of the filled gradebook exports."""


class AssignCheckOutput(JsonOutput):
    """Result of the validation of an assignment."""

    schema_id: Literal["hilrig.assign-check/1"] = Field(default="hilrig.assign-check/1", alias="schema")
    assignment: str
    """Title of the assignment."""
    points: float
    warnings: list[str]
    solution: AttemptValues | None
    """Graded run of the solution; null: without --solution."""
