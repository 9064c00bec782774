"""Validation of an assignment before it is handed out: its files, its task on its rig, and rules without effect."""

import ast
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from hilrig_classroom.assignment import (
    HANDOUT_FILE,
    SETTINGS_FILE,
    STARTER_FILE,
    Assignment,
    AssignmentConfig,
    load_assignment,
)
from hilrig_classroom.gradebook import check_title
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.config.validation import read_text
from hilrig_runtime.errors import InputError
from hilrig_sim.parameters import lab_parameters


def check_assignment(folder: Path) -> tuple[Assignment, LabConfig]:
    """Load an assignment and its lab, and check that students can solve it.

    Raises:
        InputError: it has mistakes; names all of them.
    """
    assignment = load_assignment(folder)
    lab = load_lab(assignment.lab_file)
    mistakes = []
    try:
        lab_parameters(lab, str(assignment.lab_file))
    except InputError as error:
        mistakes.append(str(error))
    mistakes += [f"{folder / SETTINGS_FILE}: {text}" for text in _settings_mistakes(assignment.config)]
    mistakes += _file_mistakes(folder)
    if mistakes:
        raise InputError("\n".join(mistakes))
    return assignment, lab


def warnings(assignment: Assignment, now: datetime) -> list[str]:
    """Sentences on settings that are valid, but probably not meant; `now` has a time zone."""
    deadline = assignment.config.deadline
    if deadline is None:
        return ["no deadline: attempts are never late"]
    return [f"the deadline {deadline.isoformat()} has passed"] if deadline < now else []


def _settings_mistakes(config: AssignmentConfig) -> Iterator[str]:
    late = config.late
    try:
        check_title(config.title)
    except InputError as error:
        yield str(error)
    if config.deadline is None and (late.last_day or config.grace_minutes):
        yield "late and grace_minutes have no effect without a deadline; add deadline, or remove them"
    if late.percent_per_day and not late.last_day:
        yield "late.percent_per_day has no effect: late.last_day = 0 accepts no late attempt; set late.last_day"


def _file_mistakes(folder: Path) -> Iterator[str]:
    handout, starter = folder / HANDOUT_FILE, folder / STARTER_FILE
    try:
        if not read_text(handout).strip():
            yield f"{handout}: empty; write the text for the students into it"
        if starter.exists():
            ast.parse(read_text(starter))
    except InputError as error:
        yield str(error)
    except (SyntaxError, ValueError) as error:
        yield f"{starter}: no valid Python program: {error}"
