"""Assignments: a folder with the lab file, the hand-out, the starter code, deadline and rubric.

`assignment.toml` has the settings of this module; `lab.toml` has the task; `handout.md` is the text for the students;
`starter.py`, which may be missing, is the program from which they start.
"""

from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import AwareDatetime, Field, model_validator

from hilrig_replay.grading.task_loading import load_task
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.config.types import NotNegative, Positive, Section
from hilrig_runtime.config.validation import parse_toml, read_text, validate
from hilrig_runtime.errors import InputError

SETTINGS_FILE: Final = "assignment.toml"
LAB_FILE: Final = "lab.toml"
HANDOUT_FILE: Final = "handout.md"
STARTER_FILE: Final = "starter.py"

Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class LateRule(Section):
    """Penalty of a late attempt."""

    percent_per_day: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
    """Share of the points that is lost for each begun day after deadline and grace."""
    last_day: NotNegative = 0.0
    """Days after the deadline until an attempt is accepted; 0: no late attempt is accepted."""


class Measure(Section):
    """Points for a figure of the run: all at `full` or below, none at `zero` or above, linear between."""

    weight: Share
    """Share of the points."""
    full: Positive
    zero: Positive

    @model_validator(mode="after")
    def _order(self) -> "Measure":
        if self.full >= self.zero:
            raise ValueError(f"full must be smaller than zero, got {self.full:g} and {self.zero:g}")
        return self

    def share(self, value: float | None) -> float:
        """Reached share of its points, 0 to 1; without a value 0."""
        if value is None:
            return 0.0
        return min(1.0, max(0.0, (self.zero - value) / (self.zero - self.full)))


class Rubric(Section):
    """How the points of an attempt are made up; what latency and energy leave is for the goals of the task."""

    points: Positive = 10.0
    """Points of an attempt that reaches everything."""
    latency_ms: Measure | None = None
    """Points for the age of the acting torque, 95th percentile, ms; none without valid data."""
    energy_j: Measure | None = None
    """Points for the work of the drives, J; only in the share in which the goals are reached."""

    @model_validator(mode="after")
    def _weights(self) -> "Rubric":
        if self.goals_weight < -1e-9:
            raise ValueError(f"the weights must add up to 1 at most, got {1 - self.goals_weight:g}")
        return self

    @property
    def goals_weight(self) -> float:
        """Share of the points for the goals of the task."""
        return 1.0 - sum(each.weight for each in (self.latency_ms, self.energy_j) if each is not None)


class AssignmentConfig(Section):
    """The settings of `assignment.toml`."""

    title: Annotated[str, Field(min_length=1, max_length=200)]
    deadline: AwareDatetime | None = None
    """Time until which an attempt is in time, with time zone; default: none."""
    grace_minutes: NotNegative = 0.0
    """Time after the deadline without a penalty."""
    attempts: Literal["best", "last"] = "best"
    """The attempt that counts."""
    max_attempts: Annotated[int, Field(ge=0)] = 0
    """Attempts that count, the first ones; 0: all."""
    late: LateRule = LateRule()
    rubric: Rubric = Rubric()


@dataclass(frozen=True, slots=True)
class Assignment:
    """An assignment with its task."""

    folder: Path
    config: AssignmentConfig
    task: TaskConfig

    @property
    def lab_file(self) -> Path:
        """Its lab file."""
        return self.folder / LAB_FILE

    def penalty(self, started: datetime | None) -> float | None:
        """Share of the points that an attempt loses, 0 to 1; None: it is not accepted.

        Args:
            started: start of the attempt; None: not recorded, treated as in time.
        """
        if self.config.deadline is None or started is None:
            return 0.0
        late = started - self.config.deadline
        if late <= timedelta(minutes=self.config.grace_minutes):
            return 0.0
        if late > timedelta(days=self.config.late.last_day):
            return None
        begun_days = -(-late // timedelta(days=1))
        return min(1.0, self.config.late.percent_per_day / 100 * begun_days)


def load_assignment(folder: Path) -> Assignment:
    """Load and validate an assignment.

    Raises:
        InputError: the folder or a file is missing or invalid; names all mistakes.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; an assignment is a folder with {SETTINGS_FILE} and {LAB_FILE}")
    errors: list[str] = []
    config = task = None
    path = folder / SETTINGS_FILE
    try:
        config = validate(AssignmentConfig, parse_toml(read_text(path), str(path)), str(path))
    except InputError as error:
        errors.append(str(error))
    try:
        task = load_task(folder / LAB_FILE)
    except InputError as error:
        errors.append(str(error))
    if not (folder / HANDOUT_FILE).is_file():
        errors.append(f"{folder / HANDOUT_FILE}: missing; write the text for the students into it")
    if config is None or task is None or errors:
        raise InputError("\n".join(errors))
    return Assignment(folder, config, task)
