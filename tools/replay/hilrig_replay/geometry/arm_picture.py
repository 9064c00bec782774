"""Views of a rig as JSON values, for pages: static geometry (scene) and arm position (pose).

World frame, x forward, y to the left, rounded to millimeters.
"""

import math
from typing import Any, Final

from hilrig_replay.geometry.quaternion import Floats
from hilrig_replay.geometry.scene import workspace_outline
from hilrig_schemas import JointState
from hilrig_sim.arm.model import ArmParameters, RigParameters

MAGNET_ON: Final = 1
"""Flag of a pose: the magnet is on."""
HOLDS_PART: Final = 2
"""Flag of a pose: the magnet holds a part."""
AT_STOP: Final = 4
"""Flag of a pose: a joint is at its stop, or the tool touches the object below it."""

Scene = dict[str, Any]
Pose = list[int]
"""Elbow x, y, tool x, y, z, mm, and flags."""


def scene_of(rig: RigParameters) -> Scene:
    """Return the static geometry of a rig as JSON values; lengths in mm, yaw angles in degrees.

    `reach` is the outline of the workspace as SVG path data; `links` are the lengths of the upper arm and the forearm,
    `shoulder` is their height; `top` and `bottom` are the limits of the tool height. The parts are in the order of the
    parts in a state. A position is that of the center, of a tray that of its bottom.
    """
    arm, scene = rig.arm, rig.scene
    return {
        "span": _mm(arm.l2 + arm.l3),
        "links": [_mm(arm.l2), _mm(arm.l3)],
        "shoulder": _mm(arm.l1),
        "table": _mm(scene.table_height),
        "top": _mm(arm.l1 - arm.lower[2]),
        "bottom": _mm(arm.l1 - arm.upper[2]),
        "reach": " ".join(map(_line, workspace_outline(arm, 0.0))),
        "trays": [
            {
                "name": tray.name,
                "at": [_mm(tray.position[0]), _mm(tray.position[1]), _degrees(tray.yaw)],
                "size": [_mm(tray.size[0]), _mm(tray.size[1])],
                "z": [_mm(tray.position[2]), _mm(tray.size[2])],
                "color": tray.colour,
                "places": [[_mm(x), _mm(y)] for x, y, _ in tray.places],
            }
            for tray in scene.trays
        ],
        "parts": [
            {
                "name": part.name,
                "round": part.shape == "cylinder",
                "size": [_mm(part.size[0]), _mm(part.size[1])],
                "z": [_mm(part.position[2]), _mm(part.size[2])],
                "color": part.colour,
                "at": [_mm(part.position[0]), _mm(part.position[1]), _degrees(part.yaw)],
            }
            for part in scene.parts
        ],
    }


def pose_of(arm: ArmParameters, state: JointState) -> Pose | None:
    """Return the pose of the arm in a state; None: a joint position is not finite."""
    theta1, theta2, d3, _ = state.position
    if not (math.isfinite(theta1) and math.isfinite(theta2) and math.isfinite(d3)):
        return None
    elbow_x, elbow_y = arm.l2 * math.cos(theta1), arm.l2 * math.sin(theta1)
    x, y = elbow_x + arm.l3 * math.cos(theta1 + theta2), elbow_y + arm.l3 * math.sin(theta1 + theta2)
    flags = MAGNET_ON * state.magnet + HOLDS_PART * bool(state.held_part) + AT_STOP * bool(state.limit_flags)
    return [_mm(elbow_x), _mm(elbow_y), _mm(x), _mm(y), _mm(arm.l1 - d3), flags]


def parts_of(state: JointState) -> list[list[int]]:
    """Return the positions of the parts in a state: x, y, mm, and yaw, degrees."""
    return [
        [_mm(part.x), _mm(part.y), _degrees(part.yaw)]
        for part in state.parts
        if math.isfinite(part.x) and math.isfinite(part.y) and math.isfinite(part.yaw)
    ]


def _line(points: Floats) -> str:
    return "M" + "L".join(dict.fromkeys(f"{_mm(x)} {_mm(y)}" for x, y, _ in points.tolist()))


def _mm(meters: float) -> int:
    return round(1000 * meters)


def _degrees(radians: float) -> int:
    return round(math.degrees(radians))
