"""Checks that a rig can reach the goals of a task: poses and path within the arm's reach, parts and places enough."""

import math

import numpy as np

from hilrig_replay.grading.grade import required_parts
from hilrig_runtime.config.task import TaskConfig
from hilrig_sim.arm.kinematics import UnreachableError, inverse
from hilrig_sim.arm.model import ArmParameters, RigParameters

_POINTS_PER_SEGMENT = 21


def task_mistakes(task: TaskConfig, parameters: RigParameters) -> list[str]:
    """Sentences on goals that the rig can't reach; empty: none."""
    arm, scene = parameters.arm, parameters.scene
    mistakes = []
    for pose in task.poses:
        if cause := _cause(arm, pose.position_mm, pose.yaw_deg or 0.0):
            mistakes.append(f"task.poses: {pose.name!r} can't be reached: {cause}")
    if task.path is not None:
        for number, (begin, end) in enumerate(zip(task.path.points_mm, task.path.points_mm[1:], strict=False), start=1):
            points = np.linspace(begin, end, _POINTS_PER_SEGMENT).tolist()
            if cause := next(filter(None, (_cause(arm, point, 0.0) for point in points)), ""):
                mistakes.append(f"task.path: between points {number} and {number + 1}: {cause}")
    if task.place is not None:
        required, known = required_parts(task.place, scene), {part.name: part for part in scene.parts}
        for name in required:
            if name not in known:
                mistakes.append(f"task.place: no part {name!r}; the scene has {', '.join(known) or 'none'}")
            elif not known[name].ferromagnetic:
                mistakes.append(f"task.place: the magnet can't hold part {name!r}, which is not ferromagnetic")
        places = sum(len(tray.places) for tray in scene.trays)
        if not required:
            mistakes.append("task.place: the scene has no part that the magnet can hold")
        if len(required) > places:
            mistakes.append(f"task.place: {len(required)} parts, but the trays have {places} places")
    return mistakes


def _cause(arm: ArmParameters, position_mm: tuple[float, float, float] | list[float], yaw_deg: float) -> str:
    """Reason why a pose can't be reached; empty: it can."""
    try:
        inverse(arm, (*(value / 1e3 for value in position_mm), math.radians(yaw_deg)))
    except UnreachableError as error:
        return str(error)
    return ""
