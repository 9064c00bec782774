"""Pose goals: poses to be reached in sequence, with settling time, overshoot and error of each.

A pose is reached when the tool was within its tolerances for its hold time; then the next pose is the target. As in a
step response, the settling time is measured from the start of the target's turn until the tool stays within the
tolerances, and the overshoot is measured along the straight line from the start position of the turn to the pose. All
are measured on the motion between the states (`interpolation`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.grading.interpolation import yaw_error
from hilrig_runtime.config.task import PoseConfig

Floats = NDArray[np.float64]

OVERSHOOT_START_SHARE: Final = 0.1
"""Overshoot counts after the tool came within this share of the distance; before, a curved path can pass the pose."""

_ROUNDING_S: Final = 1e-9


@dataclass(frozen=True, slots=True)
class PoseResult:
    """Result of one pose; times from the start of the task."""

    name: str
    turn_s: float | None
    """Time at which the pose became the target, s; None: never."""
    reached_s: float | None
    """Time at which the hold time was complete, s; None: not reached."""
    settling_s: float | None
    """Time from the start of the turn until the tool stayed within the tolerances, s."""
    overshoot_mm: float
    """Largest distance beyond the pose, mm."""
    overshoot_share: float
    """Overshoot as a share of the distance to the pose, 0 to 1."""
    error_mm: float | None
    """Largest distance from the pose during the hold time, mm."""
    closest_mm: float | None
    """Smallest distance from the pose during its turn, mm; None: it never became the target."""

    def sentence(self) -> str:
        """The result as a human-readable text."""
        if self.turn_s is None:
            return "not attempted: an earlier pose was not reached"
        if self.reached_s is None or self.settling_s is None or self.error_mm is None:
            return f"not held; closest distance {self.closest_mm:.1f} mm" if self.closest_mm is not None else "not held"
        return (
            f"reached at {self.reached_s:.1f} s, settled in {self.settling_s:.2f} s, "
            f"overshoot {self.overshoot_mm:.1f} mm ({self.overshoot_share:.0%}), held within {self.error_mm:.2f} mm"
        )


class PoseGoals:
    """Evaluates the motion of the tool from pose to pose."""

    def __init__(self, poses: Sequence[PoseConfig]) -> None:
        self._poses = poses
        self._results: list[PoseResult] = []
        self._turn: _Turn | None = None

    def add(self, time_s: Floats, pose: Floats) -> None:
        """Add states: times, shape (n,), and poses of the tool, shape (n, 4), as in `Grader.add_states`."""
        at = 0
        while at < len(time_s) and len(self._results) < len(self._poses):
            if self._turn is None:
                self._turn = _Turn(self._poses[len(self._results)], float(time_s[at]), pose[at, :3].copy())
            used = self._turn.add(time_s[at:], pose[at:])
            at += used
            if self._turn.reached_s is not None:
                self._results.append(self._turn.result())
                self._turn = None

    def results(self) -> tuple[PoseResult, ...]:
        """One result per pose, in the order of the poses."""
        results = list(self._results)
        if self._turn is not None:
            results.append(self._turn.result())
        for pose in self._poses[len(results) :]:
            results.append(PoseResult(pose.name, None, None, None, 0.0, 0.0, None, None))
        return tuple(results)


class _Turn:
    """The time during which one pose is the target."""

    def __init__(self, pose: PoseConfig, turn_s: float, start: Floats) -> None:
        self._pose = pose
        self._turn_s = turn_s
        self._goal = np.array(pose.position_mm) / 1000
        direct_path = self._goal - start
        self._length = float(np.linalg.norm(direct_path))
        self._direction = direct_path / self._length if self._length else np.zeros(3)
        self._start = start
        self._near = False
        self._beyond = 0.0
        self._closest = math.inf
        self._since_s: float | None = None
        """Time since which the tool is within the tolerances without interruption."""
        self._farthest = 0.0
        """Largest distance during this time, m."""
        self.reached_s: float | None = None

    def add(self, time_s: Floats, pose: Floats) -> int:
        """Add states until the pose is reached; returns the number of states used."""
        apart = np.linalg.norm(pose[:, :3] - self._goal, axis=1)
        within = apart <= self._pose.tolerance_mm / 1000
        if self._pose.yaw_deg is not None:
            within &= yaw_error(pose[:, 3], self._pose.yaw_deg) <= math.radians(self._pose.yaw_tolerance_deg)
        used = self._update_hold(time_s, apart, within)
        apart, along = apart[:used], (pose[:used, :3] - self._start) @ self._direction - self._length
        near = apart <= max(OVERSHOOT_START_SHARE * self._length, self._pose.tolerance_mm / 1000)
        if not self._near and near.any():
            along = along[int(np.argmax(near)) :]
            self._near = True
        if self._near:
            self._beyond = max(self._beyond, float(along.max(initial=0.0)))
        self._closest = min(self._closest, float(apart.min()))
        return used

    def _update_hold(self, time_s: Floats, apart: Floats, within: NDArray[np.bool_]) -> int:
        """Update the hold time; returns the number of states until it is complete, or all."""
        changes = np.flatnonzero(np.diff(within)) + 1
        for begin, end in zip([0, *changes.tolist()], [*changes.tolist(), len(within)], strict=True):
            if not within[begin]:
                self._since_s, self._farthest = None, 0.0
                continue
            if self._since_s is None:
                self._since_s = float(time_s[begin])
            complete = begin + int(np.searchsorted(time_s[begin:end], self._since_s + self._pose.hold_s - _ROUNDING_S))
            last = min(complete + 1, end)
            self._farthest = max(self._farthest, float(apart[begin:last].max()))
            if complete < end:
                self.reached_s = float(time_s[complete])
                return last
        return len(within)

    def result(self) -> PoseResult:
        reached = self.reached_s is not None
        return PoseResult(
            name=self._pose.name,
            turn_s=self._turn_s,
            reached_s=self.reached_s,
            settling_s=self._since_s - self._turn_s if reached and self._since_s is not None else None,
            overshoot_mm=1000 * self._beyond,
            overshoot_share=self._beyond / self._length if self._length else 0.0,
            error_mm=1000 * self._farthest if reached else None,
            closest_mm=1000 * self._closest if math.isfinite(self._closest) else None,
        )
