"""Poses to be reached one after the other: when each was, how far the tool overshot, and how well it was held.

A pose is reached when the tool was within its tolerances for as long as it is to be held; then the next one's turn
begins. As in a step response, the settling time runs from the beginning of the turn to when the tool came to stay, and
the overshoot is how far it went beyond the pose on the straight line from where the turn began.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.config.task import PoseConfig

Floats = NDArray[np.float64]

NEAR: Final = 0.1
"""Overshoot counts once the tool came within this share of the way; before, a curved way may lead past the pose."""

_ROUNDING_S: Final = 1e-9


@dataclass(frozen=True, slots=True)
class PoseResult:
    """How one pose was reached; times from the beginning of the task."""

    name: str
    turn_s: float | None
    """When its turn began, s; None: it never did."""
    reached_s: float | None
    """When it had been held for long enough, s; None: it was not."""
    settling_s: float | None
    """From the beginning of its turn until the tool came to stay, s."""
    overshoot_mm: float
    """Farthest beyond it, mm."""
    overshoot_share: float
    """The same as a share of the way to it, 0 to 1."""
    error_mm: float | None
    """Mean distance from it while it was held, mm."""
    closest_mm: float | None
    """Smallest distance from it during its turn, mm; None: its turn never came."""

    def sentence(self) -> str:
        """What there is to say of it."""
        if self.turn_s is None:
            return "its turn never came"
        if self.reached_s is None or self.settling_s is None or self.error_mm is None:
            return f"not held; at least {self.closest_mm:.1f} mm away" if self.closest_mm is not None else "not held"
        return (
            f"at {self.reached_s:.1f} s, settled in {self.settling_s:.2f} s, overshoot {self.overshoot_mm:.1f} mm "
            f"({self.overshoot_share:.0%}), held within {self.error_mm:.2f} mm"
        )


class PoseGoals:
    """Watches the tool on its way from pose to pose."""

    def __init__(self, poses: Sequence[PoseConfig]) -> None:
        self._poses = poses
        self._results: list[PoseResult] = []
        self._turn: _Turn | None = None

    def add(self, time_s: Floats, pose: Floats) -> None:
        """Take in states, as `Grader.add_states`."""
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
        """One a pose, in their order."""
        results = list(self._results)
        if self._turn is not None:
            results.append(self._turn.result())
        for pose in self._poses[len(results) :]:
            results.append(PoseResult(pose.name, None, None, None, 0.0, 0.0, None, None))
        return tuple(results)


class _Turn:
    """One pose's turn."""

    def __init__(self, pose: PoseConfig, turn_s: float, start: Floats) -> None:
        self._pose = pose
        self._turn_s = turn_s
        self._goal = np.array(pose.position_mm) / 1000
        way = self._goal - start
        self._length = float(np.linalg.norm(way))
        self._direction = way / self._length if self._length else np.zeros(3)
        self._start = start
        self._near = False
        self._beyond = 0.0
        self._closest = math.inf
        self._since_s: float | None = None
        """Since when the tool is there without a break."""
        self._sum, self._count = 0.0, 0
        self.reached_s: float | None = None

    def add(self, time_s: Floats, pose: Floats) -> int:
        """Take in states up to where the pose is reached; how many that are."""
        apart = np.linalg.norm(pose[:, :3] - self._goal, axis=1)
        there = apart <= self._pose.tolerance_mm / 1000
        if self._pose.yaw_deg is not None:
            turned = np.abs(np.angle(np.exp(1j * (pose[:, 3] - math.radians(self._pose.yaw_deg)))))
            there &= turned <= math.radians(self._pose.yaw_tolerance_deg)
        used = self._held(time_s, apart, there)
        apart, along = apart[:used], (pose[:used, :3] - self._start) @ self._direction - self._length
        near = apart <= max(NEAR * self._length, self._pose.tolerance_mm / 1000)
        if not self._near and near.any():
            along = along[int(np.argmax(near)) :]
            self._near = True
        if self._near:
            self._beyond = max(self._beyond, float(along.max(initial=0.0)))
        self._closest = min(self._closest, float(apart.min()))
        return used

    def _held(self, time_s: Floats, apart: Floats, there: NDArray[np.bool_]) -> int:
        """Follow how long the tool stays; how many states until it was long enough, or all."""
        changes = np.flatnonzero(np.diff(there)) + 1
        for begin, end in zip([0, *changes.tolist()], [*changes.tolist(), len(there)], strict=True):
            if not there[begin]:
                self._since_s, self._sum, self._count = None, 0.0, 0
                continue
            if self._since_s is None:
                self._since_s = float(time_s[begin])
            enough = begin + int(np.searchsorted(time_s[begin:end], self._since_s + self._pose.hold_s - _ROUNDING_S))
            last = min(enough + 1, end)
            self._sum += float(apart[begin:last].sum())
            self._count += last - begin
            if enough < end:
                self.reached_s = float(time_s[enough])
                return last
        return len(there)

    def result(self) -> PoseResult:
        reached = self.reached_s is not None
        return PoseResult(
            name=self._pose.name,
            turn_s=self._turn_s,
            reached_s=self.reached_s,
            settling_s=self._since_s - self._turn_s if reached and self._since_s is not None else None,
            overshoot_mm=1000 * self._beyond,
            overshoot_share=self._beyond / self._length if self._length else 0.0,
            error_mm=1000 * self._sum / self._count if reached and self._count else None,
            closest_mm=1000 * self._closest if math.isfinite(self._closest) else None,
        )
