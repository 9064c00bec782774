"""The `[task]` of a lab: what the arm is to do, so that a recording can be graded.

Poses are reached one after the other, a path is followed from its first point to its last, parts are placed in trays;
a task is any of these together. Lengths are millimetres and angles degrees, world frame.
"""

import math
from typing import Annotated

from pydantic import Field, model_validator

from hilrig_runtime.config.types import Name, NotNegative, Number, Positive, Section

Vector3 = tuple[Number, Number, Number]


class PoseConfig(Section):
    """A pose that the tool is to reach and hold."""

    name: Name
    position_mm: Vector3
    """Where the tool's tip is to be: x, y, z."""
    yaw_deg: Number | None = None
    """About world z; left out: any will do."""
    tolerance_mm: Positive = 2.0
    """Largest distance that counts as there."""
    yaw_tolerance_deg: Positive = 2.0
    hold_s: Positive = 0.5
    """Reached is what was held for so long."""


class PathConfig(Section):
    """A path that the tool is to follow: straight from point to point."""

    points_mm: Annotated[tuple[Vector3, ...], Field(min_length=2, max_length=200)]
    """Its corners: x, y, z each."""
    tolerance_mm: Positive = 5.0
    """Largest distance from the path that counts as on it."""

    @model_validator(mode="after")
    def _points_are_apart(self) -> "PathConfig":
        for number, (one, following) in enumerate(zip(self.points_mm, self.points_mm[1:], strict=False), start=1):
            if math.dist(one, following) < 0.1:
                raise ValueError(f"points {number} and {number + 1} of the path are the same")
        return self


class PlaceConfig(Section):
    """Parts that are to stand in the trays at the end."""

    parts: tuple[Name, ...] = ()
    """Which of the scene's parts; none named: all that the magnet holds."""
    tolerance_mm: Positive = 2.0
    """Largest distance of a part's middle from its place's."""


class TaskConfig(Section):
    """What a run is graded by."""

    title: Annotated[str, Field(max_length=200)] = ""
    """What people call it."""
    time_limit_s: NotNegative = 0.0
    """From the controller's first torque on; 0: none."""
    poses: Annotated[tuple[PoseConfig, ...], Field(max_length=100)] = ()
    """Reached in this order."""
    path: PathConfig | None = None
    """Followed from its first point to its last; where there are poses too, the two may be done in any order."""
    place: PlaceConfig | None = None
    """Parts to place."""

    @model_validator(mode="after")
    def _there_is_something_to_do(self) -> "TaskConfig":
        if not self.poses and self.path is None and self.place is None:
            raise ValueError("a task needs poses, a path or parts to place: [[task.poses]], [task.path], [task.place]")
        names = [pose.name for pose in self.poses]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two poses are called {name!r}: names must be distinct")
        return self
