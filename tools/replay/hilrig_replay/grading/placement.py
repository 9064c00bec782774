"""The judge of the demo: which parts stand in a tray at the end of a run, and how far from their places."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from hilrig_sim.arm.model import SceneParameters

STANDING_MM = 1.0
"""Largest difference in height between a part's bottom and its place, mm."""


class Pose(Protocol):
    """A part as `JointState.parts` states it: centre, m, world."""

    name: str
    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class PlacedPart:
    """Where one part of the scene ended."""

    part: str
    place: int | None
    """Number of the place that it stands on, from 0 through all trays; None: it stands on none."""
    error_mm: float | None
    """Distance of its middle from that place's, mm; None: it stands on none."""


@dataclass(frozen=True, slots=True)
class TaskResult:
    """How much of the work is done."""

    parts: tuple[PlacedPart, ...]
    """Each part of the scene, in its order."""

    @property
    def placed(self) -> int:
        """How many parts stand on a place."""
        return sum(part.place is not None for part in self.parts)

    @property
    def largest_error_mm(self) -> float | None:
        """Of the placed parts, mm; None: there are none."""
        return max((part.error_mm for part in self.parts if part.error_mm is not None), default=None)


def placed_parts(
    scene: SceneParameters, poses: Sequence[Pose], *, held: str = "", reach_mm: float = 15.0
) -> TaskResult:
    """Judge where the parts are.

    Args:
        scene: of `RigParameters.from_json(RigConfig.parameters_json)`.
        poses: the last `JointState.parts` of the run that is not empty.
        held: `JointState.held_part` of the same state: what hangs on the magnet does not stand.
        reach_mm: a part further from every place than this stands on none, mm.
    """
    places = [place for tray in scene.trays for place in tray.places]
    pose_of = {pose.name: pose for pose in poses}
    taken: set[int] = set()
    results = []
    for part in scene.parts:
        pose = pose_of.get(part.name)
        best: tuple[float, int] | None = None
        if pose is not None and part.name != held:
            bottom = pose.z - part.size[2] / 2
            for index, (x, y, z) in enumerate(places):
                error_mm = math.hypot(pose.x - x, pose.y - y) * 1e3
                standing = abs(bottom - z) * 1e3 <= STANDING_MM
                if standing and index not in taken and error_mm <= reach_mm and (best is None or error_mm < best[0]):
                    best = (error_mm, index)
        if best is None:
            results.append(PlacedPart(part.name, None, None))
        else:
            taken.add(best[1])
            results.append(PlacedPart(part.name, best[1], best[0]))
    return TaskResult(tuple(results))
