"""Grades a run by its task, from the recording alone: poses reached, path followed, parts placed, and times.

Times are measured from the first state at which a command of the controller acted. Errors are distances of the tool
from the task, because the setpoints of the controller are not known.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.grading.interpolation import Interpolation
from hilrig_replay.grading.path_goal import PathGoal, PathResult
from hilrig_replay.grading.placement import PlacementReport
from hilrig_replay.grading.pose_goal import PoseGoals, PoseResult
from hilrig_runtime.config.task import PlaceConfig, TaskConfig
from hilrig_sim.arm.model import RigParameters

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PlaceResult:
    """Result of one part."""

    part: str
    placed: bool
    error_mm: float | None
    """Distance between the centers of part and place, mm; None: the part is not on a place."""
    at_s: float | None
    """Time of the last release by the magnet, s from the start of the task; None: never released."""

    def sentence(self) -> str:
        """The result as a human-readable text."""
        if self.error_mm is None:
            return "not on a place"
        error = f"{self.error_mm:.2f} mm from its place"
        return error if self.at_s is None else f"{error}, released at {self.at_s:.1f} s"


@dataclass(frozen=True, slots=True)
class Grade:
    """Grade of a run."""

    title: str
    score: float
    """Share of the goals that were reached in time, 0 to 1. Each pose, each part and the path is one goal; an
    unfinished path counts by the share that was covered."""
    passed: bool
    """Whether all goals were reached."""
    done_s: float | None
    """Time at which the last goal was reached, s from the start of the task; None: a goal is missing."""
    time_limit_s: float
    """Time limit, s; 0: no limit."""
    poses: tuple[PoseResult, ...]
    path: PathResult | None
    parts: tuple[PlaceResult, ...]

    @property
    def error_mm(self) -> float | None:
        """Largest error of the held poses, the path (root mean square) and the placed parts, mm."""
        errors = [pose.error_mm for pose in self.poses if pose.error_mm is not None]
        errors += [part.error_mm for part in self.parts if part.placed and part.error_mm is not None]
        if self.path is not None and self.path.rms_mm is not None:
            errors.append(self.path.rms_mm)
        return max(errors, default=None)

    @property
    def rank(self) -> tuple[float, float, float]:
        """Sort key of a ranking, smaller is better: score, then time, then error."""
        done_s, error_mm = self.done_s, self.error_mm
        infinite = float("inf")
        return (-self.score, infinite if done_s is None else done_s, infinite if error_mm is None else error_mm)

    @property
    def percent(self) -> int:
        """Score in percent, rounded down: 100 only if all goals were reached."""
        return math.floor(100 * self.score + 1e-9)

    def headline(self) -> str:
        """The grade in one sentence."""
        limit = f" of {self.time_limit_s:g} s" if self.time_limit_s else ""
        if self.passed:
            return "passed" if self.done_s is None else f"passed in {self.done_s:.1f} s{limit}"
        lines = self.lines()
        within = f" within {self.time_limit_s:g} s" if self.time_limit_s else ""
        return f"{sum(reached for _, reached, _ in lines)} of {len(lines)} goals{within}"

    def lines(self) -> list[tuple[str, bool, str]]:
        """Goals as (name, whether it was reached, result text)."""
        rows = [(f"pose {pose.name}", pose.reached_s is not None, pose.sentence()) for pose in self.poses]
        if self.path is not None:
            rows.append(("path", self.path.done_s is not None, self.path.sentence()))
        rows += [(f"part {part.part}", part.placed, part.sentence()) for part in self.parts]
        return rows

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**asdict(self), "error_mm": self.error_mm}


class Grader:
    """Grades a run that is added block by block; its memory does not depend on the length of the run."""

    def __init__(self, task: TaskConfig, parameters: RigParameters) -> None:
        self._task = task
        self._parameters = parameters
        self._poses = PoseGoals(task.poses)
        self._path = None if task.path is None else PathGoal(task.path)
        self._motion = Interpolation()
        self._dropped_s: dict[str, float] = {}
        self._began_s: float | None = None

    def add_states(self, time_s: Floats, pose: Floats, velocity: Floats, commanded: NDArray[np.bool_]) -> None:
        """Add states.

        Args:
            time_s: times of the states, increasing, shape (n,).
            pose: pose of the tool, shape (n, 4): x, y, z in m, yaw in rad.
            velocity: derivatives of the pose, shape (n, 4).
            commanded: whether a command of the session's controller acted, shape (n,).
        """
        if self._began_s is None:
            if not commanded.any():
                return
            first = int(np.argmax(commanded))
            self._began_s = float(time_s[first])
            time_s, pose, velocity = time_s[first:], pose[first:], velocity[first:]
        limit_s = self._task.time_limit_s
        within, pose = self._motion.add(time_s - self._began_s, pose, velocity)
        if limit_s:
            count = int(np.searchsorted(within, limit_s, side="right"))
            within, pose = within[:count], pose[:count]
        if len(within):
            self._poses.add(within, pose)
            if self._path is not None:
                self._path.add(within, pose[:, :3])

    def add_drop(self, part: str, time_s: float) -> None:
        """Add the release of a part by the magnet, on the time axis of the states."""
        self._dropped_s[part] = time_s

    def grade(self, placement: PlacementReport | None) -> Grade:
        """Compute the grade after all blocks were added.

        Args:
            placement: placement of the parts at the end of the run.
        """
        poses = self._poses.results()
        path = None if self._path is None else self._path.result()
        parts = () if self._task.place is None else self._part_results(self._task.place, placement)
        reached = [float(pose.reached_s is not None) for pose in poses] + [float(part.placed) for part in parts]
        times = [pose.reached_s for pose in poses] + [part.at_s if part.placed else None for part in parts]
        if path is not None:
            reached.append(1.0 if path.done_s is not None else path.covered)
            times.append(path.done_s)
        known = [time_s for time_s in times if time_s is not None]
        passed = bool(reached) and all(share == 1.0 for share in reached)
        return Grade(
            title=self._task.title,
            score=sum(reached) / len(reached) if reached else 0.0,
            passed=passed,
            done_s=max(known) if passed and len(known) == len(times) else None,
            time_limit_s=self._task.time_limit_s,
            poses=poses,
            path=path,
            parts=parts,
        )

    def _part_results(self, place: PlaceConfig, placement: PlacementReport | None) -> tuple[PlaceResult, ...]:
        found = {} if placement is None else {part.part: part.error_mm for part in placement.parts}
        required = place.parts or tuple(part.name for part in self._parameters.scene.parts if part.ferromagnetic)
        results = []
        for name in required:
            error_mm, dropped_s = found.get(name), self._dropped_s.get(name)
            at_s = None if dropped_s is None or self._began_s is None else dropped_s - self._began_s
            # Parts that were released too late, or that were on a place from the start, do not count.
            in_time = at_s is not None and (not self._task.time_limit_s or at_s <= self._task.time_limit_s)
            placed = error_mm is not None and error_mm <= place.tolerance_mm and in_time
            results.append(PlaceResult(name, placed, error_mm, at_s))
        return tuple(results)
