"""Where the tool is, and which joints bring it there: forward and inverse kinematics, Jacobian, reach.

A pose is (x, y, z, yaw) in the world frame: m, m, m, rad, with z up from the base plane (docs/model.md). θ4 is
measured about +z like θ1 and θ2 (decision 1).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import JOINT_NAMES, JOINT_SCALE, ArmParameters

Floats = NDArray[np.float64]

_EDGE: Final = 1e-12
"""How far beyond the edge of reach, relative, is still on it: rounding."""
_HALF_DIGITS: Final = 1e-6
"""What rounding may make of joints near a singularity, rad."""
_UNITS: Final = ("°", "°", " mm", "°")


class UnreachableError(InputError):
    """No joint vector within the limits reaches the pose; says why."""


def forward(arm: ArmParameters, joints: ArrayLike) -> Floats:
    """Pose of the tool, (4, …) as (x, y, z, yaw), from joint vectors q, (4, …); (1)–(4)."""
    theta1, theta2, d3, theta4 = np.asarray(joints, dtype=np.float64)
    sum12 = theta1 + theta2
    x = arm.l2 * np.cos(theta1) + arm.l3 * np.cos(sum12)
    y = arm.l2 * np.sin(theta1) + arm.l3 * np.sin(sum12)
    return np.stack([x, y, arm.l1 - d3, sum12 + theta4])


def jacobian(arm: ArmParameters, joints: ArrayLike) -> Floats:
    """Derivative of the pose by the joints, (4, 4, …): rows x, y, z, yaw; columns in joint order."""
    theta1, theta2, *_ = np.asarray(joints, dtype=np.float64)
    sum12 = theta1 + theta2
    zero, one = np.zeros_like(theta1), np.ones_like(theta1)
    x2, y2 = -arm.l3 * np.sin(sum12), arm.l3 * np.cos(sum12)
    return np.array(
        [
            [x2 - arm.l2 * np.sin(theta1), x2, zero, zero],
            [y2 + arm.l2 * np.cos(theta1), y2, zero, zero],
            [zero, zero, -one, zero],
            [one, one, zero, one],
        ]
    )


def manipulability(arm: ArmParameters, joints: ArrayLike) -> Floats:
    """|det J| = l2 l3 |sin θ2|, m², (…): 0 at the singularities, where the arm is straight or folded."""
    theta2 = np.asarray(joints, dtype=np.float64)[1]
    return np.asarray(arm.l2 * arm.l3 * np.abs(np.sin(theta2)))


def is_singular(arm: ArmParameters, joints: ArrayLike, tolerance: float = 1e-6) -> NDArray[np.bool_]:
    """Where the tool can't move in every direction of the plane: |sin θ2| at most `tolerance`, (…)."""
    return np.asarray(manipulability(arm, joints) <= tolerance * arm.l2 * arm.l3)


@dataclass(frozen=True, slots=True)
class Reach:
    """The reachable area, a ring about joint 1 less what its stops cut off."""

    inner: float
    """Smallest distance of the tool from joint 1's axis, m."""
    outer: float
    """Largest one, m."""
    bottom: float
    """Lowest z, m."""
    top: float
    """Highest z, m."""
    area: float
    """Of the plane, m²."""


def reach(arm: ArmParameters) -> Reach:
    """The reachable area of an arm; the area is counted on a grid of 2 mm, good to about 1 %."""
    folded = max(abs(arm.lower[1]), abs(arm.upper[1]))
    straight = 0.0 if arm.lower[1] <= 0 <= arm.upper[1] else min(abs(arm.lower[1]), abs(arm.upper[1]))
    inner = _radius(arm, min(folded, math.pi))
    outer = _radius(arm, straight)
    cell = 0.002
    axis = np.arange(-outer, outer + cell, cell)
    x, y = np.meshgrid(axis, axis)
    area = float(np.count_nonzero(in_reach(arm, x, y))) * cell * cell
    return Reach(inner, outer, arm.l1 - arm.upper[2], arm.l1 - arm.lower[2], area)


def in_reach(arm: ArmParameters, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
    """Whether the tool gets to points of the plane, m, (…), with either elbow."""
    inside = np.zeros(np.broadcast(x, y).shape, dtype=np.bool_)
    for theta1, theta2, exists in _elbows(arm, np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)):
        inside |= exists & _within(arm, 0, theta1) & _within(arm, 1, theta2)
    return inside


def inverse(arm: ArmParameters, pose: ArrayLike) -> Floats:
    """Every joint vector within the limits that reaches a pose.

    Args:
        arm: the arm.
        pose: (x, y, z, yaw), m, m, m, rad, (4,).

    Returns:
        Joint vectors, (n, 4) with n ≥ 1: both elbows, and each θ4 that differs by 360° and is in range.

    Raises:
        UnreachableError: there is none; it says whether the pose is too far, too near, too high, too low, or which
            joint's limit is in the way.
    """
    x, y, z, yaw = (float(value) for value in np.asarray(pose, dtype=np.float64))
    if not all(map(math.isfinite, (x, y, z, yaw))):
        raise UnreachableError(f"pose ({x:g}, {y:g}, {z:g}, {yaw:g}): its numbers must be finite")
    where = f"pose x {x * 1e3:.1f} mm, y {y * 1e3:.1f} mm, z {z * 1e3:.1f} mm"
    distance = math.hypot(x, y)
    outer, inner = arm.l2 + arm.l3, abs(arm.l2 - arm.l3)
    if distance > outer * (1 + _EDGE):
        raise UnreachableError(
            f"{where} is too far: {distance * 1e3:.1f} mm from joint 1, {outer * 1e3:.1f} mm is the most"
        )
    if distance < inner * (1 - _EDGE):
        raise UnreachableError(
            f"{where} is too near: {distance * 1e3:.1f} mm from joint 1, {inner * 1e3:.1f} mm is the least"
        )
    d3 = float(_on_edge(arm, 2, arm.l1 - z))
    if not _within(arm, 2, d3):
        top, bottom = (arm.l1 - arm.lower[2]) * 1e3, (arm.l1 - arm.upper[2]) * 1e3
        raise UnreachableError(
            f"{where} is too {'high' if d3 < arm.lower[2] else 'low'}: z goes from {bottom:.1f} to {top:.1f} mm"
        )
    solutions: list[tuple[float, float, float, float]] = []
    blocked: list[str] = []
    for theta1_raw, theta2_raw, _ in _elbows(arm, np.array(x), np.array(y)):
        theta1, theta2 = float(theta1_raw), float(theta2_raw)
        over = [j for j, angle in ((0, theta1), (1, theta2)) if not _within(arm, j, angle)]
        if over:
            blocked.extend(_limit_sentence(arm, j, (theta1, theta2)[j]) for j in over)
            continue
        turns = _turns(arm, yaw - theta1 - theta2)
        if not turns:
            blocked.append(_limit_sentence(arm, 3, yaw - theta1 - theta2))
        solutions.extend((theta1, theta2, d3, theta4) for theta4 in turns)
    unique = list(dict.fromkeys(solutions))
    if not unique:
        raise UnreachableError(f"{where} is in reach, but {'; '.join(dict.fromkeys(blocked))}")
    return np.array(unique)


def inverse_many(arm: ArmParameters, poses: ArrayLike) -> Floats:
    """As `inverse`, for many poses at once: (4, n) gives (branches, 4, n), NaN where a branch has no solution.

    The branches are both elbows and, for each, every turn of θ4 that its range has room for.
    """
    x, y, z, yaw = np.asarray(poses, dtype=np.float64)
    turn = 2 * math.pi
    d3 = _on_edge(arm, 2, arm.l1 - z)
    branches = []
    for number, (theta1_raw, theta2_raw, exists) in enumerate(_elbows(arm, x, y)):
        theta1, theta2 = theta1_raw, theta2_raw
        possible = exists & _within(arm, 0, theta1) & _within(arm, 1, theta2) & _within(arm, 2, d3)
        if number:
            # A straight arm has one elbow.
            possible &= theta2 != 0
        rest = yaw - theta1 - theta2
        first = np.ceil((arm.lower[3] - rest) / turn - 1e-9)
        for k in range(int((arm.upper[3] - arm.lower[3]) / turn) + 1):
            theta4 = _on_edge(arm, 3, rest + (first + k) * turn)
            valid = possible & _within(arm, 3, theta4)
            branches.append(np.where(valid, np.stack([theta1, theta2, d3, theta4]), np.nan))
    return np.stack(branches)


def _elbows(arm: ArmParameters, x: Floats, y: Floats) -> list[tuple[Floats, Floats, NDArray[np.bool_]]]:
    """θ1, θ2 of both elbows, and whether the distance allows them."""
    cosine = (x * x + y * y - arm.l2**2 - arm.l3**2) / (2 * arm.l2 * arm.l3)
    exists = np.abs(cosine) <= 1 + 4 * _EDGE
    bend = np.arccos(np.clip(cosine, -1.0, 1.0))
    found = []
    for elbow in (bend, -bend):
        shoulder = np.arctan2(y, x) - np.arctan2(arm.l3 * np.sin(elbow), arm.l2 + arm.l3 * np.cos(elbow))
        theta1, theta2 = _off_the_stop(arm, x, y, _into(arm, 0, shoulder), elbow)
        found.append((_on_edge(arm, 0, theta1), _on_edge(arm, 1, theta2), exists))
    return found


def _off_the_stop(arm: ArmParameters, x: Floats, y: Floats, theta1: Floats, theta2: Floats) -> tuple[Floats, Floats]:
    """The same pose with θ1 at its limit, where rounding put it beyond.

    Near a singularity a pose tells its joints to half the digits only. A θ1 that is so little beyond its limit is set
    to it, and θ2 then points link 2 at the pose again; kept where that is the pose.
    """
    at_limit = np.clip(theta1, arm.lower[0], arm.upper[0])
    elbow_x, elbow_y = arm.l2 * np.cos(at_limit), arm.l2 * np.sin(at_limit)
    pointing = np.arctan2(y - elbow_y, x - elbow_x)
    away = np.hypot(elbow_x + arm.l3 * np.cos(pointing) - x, elbow_y + arm.l3 * np.sin(pointing) - y)
    turned = np.arctan2(np.sin(pointing - at_limit), np.cos(pointing - at_limit))
    better = (at_limit != theta1) & (np.abs(at_limit - theta1) < _HALF_DIGITS) & (away < _EDGE)
    return np.where(better, at_limit, theta1), np.where(better, turned, theta2)


def _radius(arm: ArmParameters, theta2: float) -> float:
    return math.sqrt(max(0.0, arm.l2**2 + arm.l3**2 + 2 * arm.l2 * arm.l3 * math.cos(theta2)))


def _into(arm: ArmParameters, joint: int, angle: ArrayLike) -> Floats:
    """The same angle, turned by whole turns to where it is nearest to the middle of the joint's range."""
    middle = 0.5 * (arm.lower[joint] + arm.upper[joint])
    turn = 2 * math.pi
    value = np.asarray(angle, dtype=np.float64)
    return np.asarray(value - turn * np.round((value - middle) / turn))


def _within(arm: ArmParameters, joint: int, value: ArrayLike) -> NDArray[np.bool_]:
    return np.asarray((arm.lower[joint] <= np.asarray(value)) & (np.asarray(value) <= arm.upper[joint]))


def _on_edge(arm: ArmParameters, joint: int, value: ArrayLike) -> Floats:
    """Values that rounding put just outside a limit are on it."""
    low, high = arm.lower[joint], arm.upper[joint]
    slack = _EDGE * max(1.0, abs(low), abs(high))
    values = np.asarray(value, dtype=np.float64)
    return np.where((values >= low - slack) & (values <= high + slack), np.clip(values, low, high), values)


def _turns(arm: ArmParameters, theta4: float) -> list[float]:
    """Every angle in joint 4's range that is θ4 up to whole turns."""
    turn = 2 * math.pi
    first = math.ceil((arm.lower[3] - theta4) / turn - 1e-9)
    last = math.floor((arm.upper[3] - theta4) / turn + 1e-9)
    angles = (float(_on_edge(arm, 3, theta4 + k * turn)) for k in range(first, last + 1))
    return [angle for angle in angles if _within(arm, 3, angle)]


def _limit_sentence(arm: ArmParameters, joint: int, value: float) -> str:
    scale, unit = JOINT_SCALE[joint], _UNITS[joint]
    return (
        f"{JOINT_NAMES[joint]} would be {value * scale:.1f}{unit}, its limits are "
        f"{arm.lower[joint] * scale:.1f}{unit} to {arm.upper[joint] * scale:.1f}{unit}"
    )
