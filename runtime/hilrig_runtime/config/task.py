"""The `[task]` section of `lab.toml`: the task by which recordings are graded.

Poses are reached one after the other, a path is followed from its first point to its last, parts are placed in trays;
a task has at least one of these. Lengths are in millimeters and angles in degrees, in the world frame.
"""

import math
from typing import Annotated

from pydantic import Field, model_validator

from hilrig_runtime.config.types import Name, NotNegative, Number, Positive, Section, check_distinct

Vector3 = tuple[Number, Number, Number]


class PoseConfig(Section):
    """A pose that the tool must reach and hold."""

    name: Name
    position_mm: Vector3
    """Target of the tool's tip: x, y, z."""
    yaw_deg: Number | None = None
    """Angle about world z; default: any."""
    tolerance_mm: Positive = 2.0
    """Largest distance from the target."""
    yaw_tolerance_deg: Positive = 2.0
    hold_s: Positive = 0.5
    """Time that the pose must be held."""


class PathConfig(Section):
    """A path that the tool must follow: straight from point to point."""

    points_mm: Annotated[tuple[Vector3, ...], Field(min_length=2, max_length=200)]
    """Its points: x, y, z each."""
    tolerance_mm: Positive = 5.0
    """Largest distance from the path."""

    @model_validator(mode="after")
    def _points_are_distinct(self) -> "PathConfig":
        for number, (one, following) in enumerate(zip(self.points_mm, self.points_mm[1:], strict=False), start=1):
            if math.dist(one, following) < 0.1:
                raise ValueError(f"points {number} and {number + 1} of the path are the same")
        return self


class PlaceConfig(Section):
    """Parts that must be in the trays at the end."""

    parts: tuple[Name, ...] = ()
    """Names of parts of the scene; default: all that the magnet can hold."""
    tolerance_mm: Positive = 2.0
    """Largest distance between the centers of a part and its place."""


class TaskConfig(Section):
    """Task by which a run is graded."""

    title: Annotated[str, Field(max_length=200)] = ""
    """Title in reports."""
    time_limit_s: NotNegative = 0.0
    """Time limit from the controller's first torque on; 0: none."""
    poses: Annotated[tuple[PoseConfig, ...], Field(max_length=100)] = ()
    """Poses to reach, in this order."""
    path: PathConfig | None = None
    """Path to follow from its first point to its last, before or after the poses."""
    place: PlaceConfig | None = None
    """Parts to place."""

    @model_validator(mode="after")
    def _task_is_not_empty(self) -> "TaskConfig":
        if not self.poses and self.path is None and self.place is None:
            raise ValueError("a task needs poses, a path or parts to place: [[task.poses]], [task.path], [task.place]")
        check_distinct("pose name", (pose.name for pose in self.poses))
        return self
