"""A rig from above as plain numbers for a page that draws it: what stands still (a scene) and how the arm is (a pose).

World frame as everywhere, x forwards, y to the left; here in whole millimetres, for the page draws no finer.
"""

import math
from typing import Any, Final

from hilrig_replay.geometry.quaternion import Floats
from hilrig_replay.geometry.scene import workspace_outline
from hilrig_schemas import JointState
from hilrig_sim.arm.model import ArmParameters, RigParameters

MAGNET: Final = 1
"""Bits of a pose's flags: the magnet is on."""
HOLDS: Final = 2
"""The magnet holds a part."""
AT_STOP: Final = 4
"""A joint is on its stop, or the tool on what lies below."""

Scene = dict[str, Any]
Pose = list[int]
"""Elbow x, y, tool x, y, z, mm, and flags."""


def scene_of(rig: RigParameters) -> Scene:
    """What of a rig stands still, as plain values for JSON; lengths in mm, yaws in degrees.

    `reach` is the outline of what the tool reaches, as SVG path data; `top` and `bottom` are how high and low the tool
    gets. The parts are in the order in which states have them.
    """
    arm, scene = rig.arm, rig.scene
    return {
        "span": _mm(arm.l2 + arm.l3),
        "top": _mm(arm.l1 - arm.lower[2]),
        "bottom": _mm(arm.l1 - arm.upper[2]),
        "reach": " ".join(map(_line, workspace_outline(arm, 0.0))),
        "trays": [
            {
                "name": tray.name,
                "at": [_mm(tray.position[0]), _mm(tray.position[1]), _degrees(tray.yaw)],
                "size": [_mm(tray.size[0]), _mm(tray.size[1])],
                "colour": tray.colour,
                "places": [[_mm(x), _mm(y)] for x, y, _ in tray.places],
            }
            for tray in scene.trays
        ],
        "parts": [
            {
                "name": part.name,
                "round": part.shape == "cylinder",
                "size": [_mm(part.size[0]), _mm(part.size[1])],
                "colour": part.colour,
                "at": [_mm(part.position[0]), _mm(part.position[1]), _degrees(part.yaw)],
            }
            for part in scene.parts
        ],
    }


def pose_of(arm: ArmParameters, state: JointState) -> Pose | None:
    """How the arm of a state is; None: its numbers are none."""
    theta1, theta2, d3, _ = state.position
    if not (math.isfinite(theta1) and math.isfinite(theta2) and math.isfinite(d3)):
        return None
    elbow_x, elbow_y = arm.l2 * math.cos(theta1), arm.l2 * math.sin(theta1)
    x, y = elbow_x + arm.l3 * math.cos(theta1 + theta2), elbow_y + arm.l3 * math.sin(theta1 + theta2)
    flags = (MAGNET if state.magnet else 0) | (HOLDS if state.held_part else 0) | (AT_STOP if state.limit_flags else 0)
    return [_mm(elbow_x), _mm(elbow_y), _mm(x), _mm(y), _mm(arm.l1 - d3), flags]


def parts_of(state: JointState) -> list[list[int]]:
    """Where the parts of a state are: x, y, mm, and yaw, degrees."""
    return [
        [_mm(part.x), _mm(part.y), _degrees(part.yaw)]
        for part in state.parts
        if math.isfinite(part.x) and math.isfinite(part.y) and math.isfinite(part.yaw)
    ]


def _line(points: Floats) -> str:
    return "M" + "L".join(dict.fromkeys(f"{_mm(x)} {_mm(y)}" for x, y, _ in points.tolist()))


def _mm(metres: float) -> int:
    return round(1000 * metres)


def _degrees(radians: float) -> int:
    return round(math.degrees(radians))
