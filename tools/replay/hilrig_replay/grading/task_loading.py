"""Which task a run is graded by: the one of its lab as it was recorded, or one that a teacher gives afterwards."""

import math
import tomllib
from pathlib import Path

from pydantic import ValidationError

from hilrig_replay.io.run import Run
from hilrig_runtime.config.lab import load_lab
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.config.validation import format_validation_error
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.kinematics import UnreachableError, forward, in_reach, inverse
from hilrig_sim.arm.model import RigParameters


def task_of(run: Run) -> TaskConfig | None:
    """The task in the `lab.toml` that a recording carries; None: it carries none.

    The rest of that file is not looked at: a task can be read whatever the version that recorded it.

    Raises:
        InputError: what it carries is no task that this version understands.
    """
    text = run.file.attachments.get("lab.toml", b"").decode("utf-8", errors="replace")
    try:
        task = tomllib.loads(text).get("task")
        return None if task is None else TaskConfig.model_validate(task)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{run.path}: its lab.toml is no valid TOML: {error}") from error
    except ValidationError as error:
        said = "; ".join(format_validation_error(error))
        raise InputError(f"{run.path}: the task in its lab.toml is not understood: {said}") from error


def read_task(path: Path) -> TaskConfig:
    """The task of a lab's file.

    Raises:
        InputError: it is no lab's file, or has no task.
    """
    task = load_lab(path).task
    if task is None:
        raise InputError(f"{path}: has no task: it needs [[task.poses]], [task.path] or [task.place]")
    return task


def check_task(task: TaskConfig, parameters: RigParameters) -> None:
    """Refuse what a rig can't do.

    Raises:
        InputError: a pose or a point of the path is out of reach, or a part is not in the scene.
    """
    for pose in task.poses:
        x, y, z = (length / 1000 for length in pose.position_mm)
        try:
            inverse(parameters.arm, (x, y, z, 0.0 if pose.yaw_deg is None else math.radians(pose.yaw_deg)))
        except UnreachableError as error:
            raise InputError(f"task: pose {pose.name!r} can't be reached: {error}") from error
    low, high = (float(forward(parameters.arm, (0.0, 0.0, d3, 0.0))[2]) for d3 in _strokes(parameters))
    for number, (x_mm, y_mm, z_mm) in enumerate(() if task.path is None else task.path.points_mm, start=1):
        within = low <= z_mm / 1000 <= high and bool(in_reach(parameters.arm, x_mm / 1000, y_mm / 1000))
        if not within:
            raise InputError(f"task: point {number} of the path, ({x_mm:g}, {y_mm:g}, {z_mm:g}) mm, is out of reach")
    known = [part.name for part in parameters.scene.parts if part.ferromagnetic]
    for name in () if task.place is None else task.place.parts:
        if name not in known:
            raise InputError(
                f"task: no part {name!r} that the magnet holds is in the scene; it has {', '.join(known) or 'none'}"
            )
    if task.place is not None and not any(tray.places for tray in parameters.scene.trays):
        raise InputError("task: parts are to be placed, and the scene has no tray")


def _strokes(parameters: RigParameters) -> tuple[float, float]:
    """The quill at its lowest and at its highest, m."""
    return parameters.arm.upper[2], parameters.arm.lower[2]
