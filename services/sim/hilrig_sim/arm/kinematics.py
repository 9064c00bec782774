"""Forward and inverse kinematics, Jacobian and reachable area of the arm.

A pose is (x, y, z, yaw) in the world frame: m, m, m, rad, with z up from the base plane (docs/model.md). θ4 is
measured about +z like θ1 and θ2 (decision 1).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.joints import JOINT_NAMES, JOINT_SCALE
from hilrig_sim.arm.model import ArmParameters

Floats = NDArray[np.float64]

_LIMIT_TOLERANCE: Final = 1e-12
"""Relative rounding tolerance at the limit of the reach and of the joints."""
_SINGULARITY_TOLERANCE: Final = 1e-6
"""Rounding error of joint angles near a singularity, rad."""
_UNITS: Final = ("°", "°", " mm", "°")


class UnreachableError(InputError):
    """A pose that no joint vector within the limits reaches; the message has the cause."""


def forward(arm: ArmParameters, joints: ArrayLike) -> Floats:
    """Return the tool pose (x, y, z, yaw), (4, …), of joint vectors q, (4, …); (1)–(4)."""
    theta1, theta2, d3, theta4 = np.asarray(joints, dtype=np.float64)
    sum12 = theta1 + theta2
    x = arm.l2 * np.cos(theta1) + arm.l3 * np.cos(sum12)
    y = arm.l2 * np.sin(theta1) + arm.l3 * np.sin(sum12)
    return np.stack([x, y, arm.l1 - d3, sum12 + theta4])


def jacobian(arm: ArmParameters, joints: ArrayLike) -> Floats:
    """Return the Jacobian of the pose, (4, 4, …): rows x, y, z, yaw; columns in joint order."""
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
    """Return |det J| = l2 l3 |sin θ2|, m², (…): 0 at the singularities, where the arm is straight or folded."""
    theta2 = np.asarray(joints, dtype=np.float64)[1]
    return np.asarray(arm.l2 * arm.l3 * np.abs(np.sin(theta2)))


def is_singular(arm: ArmParameters, joints: ArrayLike, tolerance: float = 1e-6) -> NDArray[np.bool_]:
    """Return where the tool can't move in every direction of the plane: |sin θ2| at most `tolerance`, (…)."""
    return np.asarray(manipulability(arm, joints) <= tolerance * arm.l2 * arm.l3)


@dataclass(frozen=True, slots=True)
class Reach:
    """Reachable area: a ring around joint 1, reduced by the joint limits."""

    inner: float
    """Smallest distance of the tool from the axis of joint 1, m."""
    outer: float
    """Largest distance of the tool from the axis of joint 1, m."""
    bottom: float
    """Lowest z, m."""
    top: float
    """Highest z, m."""
    area: float
    """Area in the plane, m²."""


def reach(arm: ArmParameters) -> Reach:
    """Return the reachable area of an arm; the area is counted on a grid of 2 mm, accurate to about 1 %."""
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
    """Return whether the tool reaches points of the plane, m, (…), with one of the elbow solutions."""
    inside = np.zeros(np.broadcast(x, y).shape, dtype=np.bool_)
    for theta1, theta2, exists in _elbows(arm, np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)):
        inside |= exists & _within(arm, 0, theta1) & _within(arm, 1, theta2)
    return inside


def inverse(arm: ArmParameters, pose: ArrayLike) -> Floats:
    """Return every joint vector within the limits that reaches a pose.

    Args:
        arm: the arm.
        pose: (x, y, z, yaw), m, m, m, rad, (4,).

    Returns:
        Joint vectors, (n, 4) with n ≥ 1: both elbow solutions, each with every θ4 + k·360° within its limits.

    Raises:
        UnreachableError: the pose has no solution; the message has the cause: too far, near, high or low, or the joint
            limit.
    """
    x, y, z, yaw = (float(value) for value in np.asarray(pose, dtype=np.float64))
    if not all(map(math.isfinite, (x, y, z, yaw))):
        raise UnreachableError(f"pose ({x:g}, {y:g}, {z:g}, {yaw:g}): its numbers must be finite")
    where = f"pose x {x * 1e3:.1f} mm, y {y * 1e3:.1f} mm, z {z * 1e3:.1f} mm"
    distance = math.hypot(x, y)
    outer, inner = arm.l2 + arm.l3, abs(arm.l2 - arm.l3)
    if distance > outer * (1 + _LIMIT_TOLERANCE):
        raise UnreachableError(
            f"{where} is too far: {distance * 1e3:.1f} mm from joint 1, must be at most {outer * 1e3:.1f} mm"
        )
    if distance < inner * (1 - _LIMIT_TOLERANCE):
        raise UnreachableError(
            f"{where} is too near: {distance * 1e3:.1f} mm from joint 1, must be at least {inner * 1e3:.1f} mm"
        )
    d3 = float(_snap_to_limit(arm, 2, arm.l1 - z))
    if not _within(arm, 2, d3):
        top, bottom = (arm.l1 - arm.lower[2]) * 1e3, (arm.l1 - arm.upper[2]) * 1e3
        raise UnreachableError(
            f"{where} is too {'high' if d3 < arm.lower[2] else 'low'}: must be {bottom:.1f} to {top:.1f} mm"
        )
    solutions: list[tuple[float, float, float, float]] = []
    blocked: list[str] = []
    for theta1_raw, theta2_raw, _ in _elbows(arm, np.array(x), np.array(y)):
        theta1, theta2 = float(theta1_raw), float(theta2_raw)
        over = [j for j, angle in ((0, theta1), (1, theta2)) if not _within(arm, j, angle)]
        if over:
            blocked.extend(_describe_violation(arm, j, (theta1, theta2)[j]) for j in over)
            continue
        turns = _turns(arm, yaw - theta1 - theta2)
        if not turns:
            blocked.append(_describe_violation(arm, 3, yaw - theta1 - theta2))
        solutions.extend((theta1, theta2, d3, theta4) for theta4 in turns)
    unique = list(dict.fromkeys(solutions))
    if not unique:
        raise UnreachableError(f"{where} is in reach, but {'; '.join(dict.fromkeys(blocked))}")
    return np.array(unique)


def inverse_many(arm: ArmParameters, poses: ArrayLike) -> Floats:
    """Return the solutions of many poses at once: (4, n) to (branches, 4, n), NaN where a branch has no solution.

    The branches are both elbow solutions, each with every θ4 + k·360° within its limits.
    """
    x, y, z, yaw = np.asarray(poses, dtype=np.float64)
    turn = 2 * math.pi
    d3 = _snap_to_limit(arm, 2, arm.l1 - z)
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
            theta4 = _snap_to_limit(arm, 3, rest + (first + k) * turn)
            valid = possible & _within(arm, 3, theta4)
            branches.append(np.where(valid, np.stack([theta1, theta2, d3, theta4]), np.nan))
    return np.stack(branches)


def _elbows(arm: ArmParameters, x: Floats, y: Floats) -> list[tuple[Floats, Floats, NDArray[np.bool_]]]:
    """Return θ1, θ2 of both elbow solutions, and whether they exist at the distance."""
    cosine = (x * x + y * y - arm.l2**2 - arm.l3**2) / (2 * arm.l2 * arm.l3)
    exists = np.abs(cosine) <= 1 + 4 * _LIMIT_TOLERANCE
    bend = np.arccos(np.clip(cosine, -1.0, 1.0))
    found = []
    for elbow in (bend, -bend):
        shoulder = np.arctan2(y, x) - np.arctan2(arm.l3 * np.sin(elbow), arm.l2 + arm.l3 * np.cos(elbow))
        theta1, theta2 = _clip_theta1(arm, x, y, _into(arm, 0, shoulder), elbow)
        found.append((_snap_to_limit(arm, 0, theta1), _snap_to_limit(arm, 1, theta2), exists))
    return found


def _clip_theta1(arm: ArmParameters, x: Floats, y: Floats, theta1: Floats, theta2: Floats) -> tuple[Floats, Floats]:
    """Return θ1, θ2 with θ1 at its limit, if it exceeds the limit by rounding only.

    Near a singularity, the joint angles of a pose have half the digits only. A θ1 that is slightly beyond its limit is
    set to the limit, and θ2 is recomputed to point link 2 at the pose. The result is used if it reaches the pose.
    """
    at_limit = np.clip(theta1, arm.lower[0], arm.upper[0])
    elbow_x, elbow_y = arm.l2 * np.cos(at_limit), arm.l2 * np.sin(at_limit)
    pointing = np.arctan2(y - elbow_y, x - elbow_x)
    away = np.hypot(elbow_x + arm.l3 * np.cos(pointing) - x, elbow_y + arm.l3 * np.sin(pointing) - y)
    turned = np.arctan2(np.sin(pointing - at_limit), np.cos(pointing - at_limit))
    better = (at_limit != theta1) & (np.abs(at_limit - theta1) < _SINGULARITY_TOLERANCE) & (away < _LIMIT_TOLERANCE)
    return np.where(better, at_limit, theta1), np.where(better, turned, theta2)


def _radius(arm: ArmParameters, theta2: float) -> float:
    return math.sqrt(max(0.0, arm.l2**2 + arm.l3**2 + 2 * arm.l2 * arm.l3 * math.cos(theta2)))


def _into(arm: ArmParameters, joint: int, angle: ArrayLike) -> Floats:
    """Return the angle plus a multiple of 360° that is nearest to the center of the joint's range."""
    center = 0.5 * (arm.lower[joint] + arm.upper[joint])
    turn = 2 * math.pi
    value = np.asarray(angle, dtype=np.float64)
    return np.asarray(value - turn * np.round((value - center) / turn))


def _within(arm: ArmParameters, joint: int, value: ArrayLike) -> NDArray[np.bool_]:
    return np.asarray((arm.lower[joint] <= np.asarray(value)) & (np.asarray(value) <= arm.upper[joint]))


def _snap_to_limit(arm: ArmParameters, joint: int, value: ArrayLike) -> Floats:
    """Return the values; those beyond a limit by rounding only are set to the limit."""
    low, high = arm.lower[joint], arm.upper[joint]
    slack = _LIMIT_TOLERANCE * max(1.0, abs(low), abs(high))
    values = np.asarray(value, dtype=np.float64)
    return np.where((values >= low - slack) & (values <= high + slack), np.clip(values, low, high), values)


def _turns(arm: ArmParameters, theta4: float) -> list[float]:
    """Return every angle θ4 + k·360° within the limits of joint 4."""
    turn = 2 * math.pi
    first = math.ceil((arm.lower[3] - theta4) / turn - 1e-9)
    last = math.floor((arm.upper[3] - theta4) / turn + 1e-9)
    angles = (float(_snap_to_limit(arm, 3, theta4 + k * turn)) for k in range(first, last + 1))
    return [angle for angle in angles if _within(arm, 3, angle)]


def _describe_violation(arm: ArmParameters, joint: int, value: float) -> str:
    scale, unit = JOINT_SCALE[joint], _UNITS[joint]
    return (
        f"{JOINT_NAMES[joint]} would be {value * scale:.1f}{unit}, but its limits are "
        f"{arm.lower[joint] * scale:.1f}{unit} to {arm.upper[joint] * scale:.1f}{unit}"
    )
