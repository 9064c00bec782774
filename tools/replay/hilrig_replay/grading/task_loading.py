"""Loads and validates the task that a run is graded by: from its recording, or from a lab file."""

from pathlib import Path

from pydantic import ValidationError

from hilrig_replay.io.run import Run
from hilrig_runtime.config.lab import load_lab
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.config.validation import format_validation_error, parse_toml
from hilrig_runtime.errors import InputError


def recorded_task(run: Run) -> TaskConfig | None:
    """The task in the recorded `lab.toml` of a run; None: no task is recorded.

    The rest of the file is ignored, so that recordings of other versions can be graded.

    Raises:
        InputError: the recorded task is invalid in this version.
    """
    text = run.file.attachments.get("lab.toml", b"").decode("utf-8", errors="replace")
    try:
        task = parse_toml(text, f"{run.path}: recorded lab.toml").get("task")
        return None if task is None else TaskConfig.model_validate(task)
    except ValidationError as error:
        errors = "; ".join(format_validation_error(error))
        raise InputError(f"{run.path}: recorded lab.toml: invalid task: {errors}") from error


def load_task(path: Path) -> TaskConfig:
    """The task of a lab file.

    Raises:
        InputError: the lab file is invalid or has no task.
    """
    task = load_lab(path).task
    if task is None:
        raise InputError(f"{path}: no task: add [[task.poses]], [task.path] or [task.place]")
    return task
