"""Loads and validates the task that a run is graded by: from its recording, or from a lab file."""

import math
from pathlib import Path

from pydantic import ValidationError

from hilrig_replay.io.run import Run
from hilrig_runtime.config.lab import load_lab
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.config.validation import format_validation_error, parse_toml
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.kinematics import UnreachableError, forward, in_reach, inverse
from hilrig_sim.arm.model import RigParameters


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


def validate_task(task: TaskConfig, parameters: RigParameters) -> None:
    """Check that a rig can perform a task.

    Raises:
        InputError: a pose or a point of the path is out of reach, or a part is not in the scene.
    """
    for pose in task.poses:
        x, y, z = (length / 1000 for length in pose.position_mm)
        try:
            inverse(parameters.arm, (x, y, z, 0.0 if pose.yaw_deg is None else math.radians(pose.yaw_deg)))
        except UnreachableError as error:
            raise InputError(f"task: pose {pose.name!r} is out of reach: {error}") from error
    low, high = (float(forward(parameters.arm, (0.0, 0.0, d3, 0.0))[2]) for d3 in _strokes(parameters))
    for number, (x_mm, y_mm, z_mm) in enumerate(() if task.path is None else task.path.points_mm, start=1):
        within = low <= z_mm / 1000 <= high and bool(in_reach(parameters.arm, x_mm / 1000, y_mm / 1000))
        if not within:
            raise InputError(f"task: point {number} of the path, ({x_mm:g}, {y_mm:g}, {z_mm:g}) mm, is out of reach")
    known = [part.name for part in parameters.scene.parts if part.ferromagnetic]
    for name in () if task.place is None else task.place.parts:
        if name not in known:
            raise InputError(
                f"task.place.parts: no ferromagnetic part {name!r} in the scene; its ferromagnetic parts: "
                f"{', '.join(known) or 'none'}"
            )
    if task.place is not None and not any(tray.places for tray in parameters.scene.trays):
        raise InputError("task.place: the scene has no tray with places")


def _strokes(parameters: RigParameters) -> tuple[float, float]:
    """Lowest and highest position of the quill, m."""
    return parameters.arm.upper[2], parameters.arm.lower[2]
