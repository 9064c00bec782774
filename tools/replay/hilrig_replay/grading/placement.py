"""Placement check: which parts are on a place of a tray at the end of a run, and their placement errors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from hilrig_sim.arm.model import SceneParameters

MAX_HEIGHT_ERROR_MM = 1.0
"""Maximum difference in height between the bottom of a part and its place, mm."""


class PartPose(Protocol):
    """Position of a part as in `JointState.parts`: center, m, world."""

    name: str
    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class PartPlacement:
    """Final placement of one part of the scene."""

    part: str
    place: int | None
    """Number of the place, from 0, counted over all trays; None: not on a place."""
    error_mm: float | None
    """Distance between the centers of part and place, mm; None: not on a place."""


@dataclass(frozen=True, slots=True)
class PlacementReport:
    """Placement of all parts of a scene."""

    parts: tuple[PartPlacement, ...]
    """One per part of the scene, in the order of the scene."""

    @property
    def placed(self) -> int:
        """Number of parts on a place."""
        return sum(part.place is not None for part in self.parts)

    @property
    def largest_error_mm(self) -> float | None:
        """Largest error of the placed parts, mm; None: no part is placed."""
        return max((part.error_mm for part in self.parts if part.error_mm is not None), default=None)


def evaluate_placement(
    scene: SceneParameters, poses: Sequence[PartPose], *, held: str = "", reach_mm: float = 15.0
) -> PlacementReport:
    """Assign the parts to the places of the trays.

    Args:
        scene: scene of `RigParameters.from_json(RigConfig.parameters_json)`.
        poses: the last `JointState.parts` of the run that is not empty.
        held: `JointState.held_part` of the same state; a part on the magnet is not placed.
        reach_mm: maximum distance of a part from its place, mm.
    """
    places = [place for tray in scene.trays for place in tray.places]
    pose_of = {pose.name: pose for pose in poses}
    occupied: set[int] = set()
    results = []
    for part in scene.parts:
        pose = pose_of.get(part.name)
        best: tuple[float, int] | None = None
        if pose is not None and part.name != held:
            bottom = pose.z - part.size[2] / 2
            for index, (x, y, z) in enumerate(places):
                error_mm = math.hypot(pose.x - x, pose.y - y) * 1e3
                if abs(bottom - z) * 1e3 > MAX_HEIGHT_ERROR_MM or index in occupied or error_mm > reach_mm:
                    continue
                if best is None or error_mm < best[0]:
                    best = (error_mm, index)
        if best is None:
            results.append(PartPlacement(part.name, None, None))
        else:
            occupied.add(best[1])
            results.append(PartPlacement(part.name, best[1], best[0]))
    return PlacementReport(tuple(results))
