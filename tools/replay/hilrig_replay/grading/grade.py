"""A run graded by its task, from the recording alone: poses reached, path followed, parts placed, and in what time.

Time counts from the first state on which a command of the controller acted. Nothing here knows what the controller
wanted, only what the task asks for: errors are distances of the tool from that.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.grading.path_goal import PathGoal, PathResult
from hilrig_replay.grading.placement import TaskResult
from hilrig_replay.grading.pose_goal import PoseGoals, PoseResult
from hilrig_runtime.config.task import PlaceConfig, TaskConfig
from hilrig_sim.arm.model import RigParameters

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PlaceResult:
    """How one part was placed."""

    part: str
    placed: bool
    error_mm: float | None
    """Distance of its middle from its place's, mm; None: it stands on none."""
    at_s: float | None
    """When the magnet let go of it for the last time, s from the beginning of the task; None: it never did."""

    def sentence(self) -> str:
        """What there is to say of it."""
        if self.error_mm is None:
            return "it stands on no place"
        where = f"{self.error_mm:.2f} mm from its place"
        return where if self.at_s is None else f"{where}, let go at {self.at_s:.1f} s"


@dataclass(frozen=True, slots=True)
class Grade:
    """What a run is worth."""

    title: str
    score: float
    """Share of the goals that were reached in time, 0 to 1: each pose is one, each part is one, and the path is one,
    which counts by the share of it that was passed."""
    passed: bool
    """Whether all were."""
    done_s: float | None
    """When the last goal was reached, s from the beginning of the task; None: one is missing."""
    time_limit_s: float
    """0: there is none."""
    poses: tuple[PoseResult, ...]
    path: PathResult | None
    parts: tuple[PlaceResult, ...]

    @property
    def error_mm(self) -> float | None:
        """The largest error of what counts: of poses held, of the path as root mean square, of parts placed, mm."""
        errors = [pose.error_mm for pose in self.poses if pose.error_mm is not None]
        errors += [part.error_mm for part in self.parts if part.placed and part.error_mm is not None]
        if self.path is not None and self.path.rms_mm is not None:
            errors.append(self.path.rms_mm)
        return max(errors, default=None)

    @property
    def rank(self) -> tuple[float, float, float]:
        """Smaller is better: by score, then by time, then by error."""
        done_s, error_mm = self.done_s, self.error_mm
        infinite = float("inf")
        return (-self.score, infinite if done_s is None else done_s, infinite if error_mm is None else error_mm)

    @property
    def percent(self) -> int:
        """The score in whole per cent, 100 for nothing less than all."""
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
        """Goal by goal: which, whether it was reached, and what there is to say of it."""
        rows = [(f"pose {pose.name}", pose.reached_s is not None, pose.sentence()) for pose in self.poses]
        if self.path is not None:
            rows.append(("path", self.path.done_s is not None, self.path.sentence()))
        rows += [(f"part {part.part}", part.placed, part.sentence()) for part in self.parts]
        return rows

    def as_dict(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        return {**asdict(self), "error_mm": self.error_mm}


class Grader:
    """Takes in a run piece by piece, and grades it at the end; its memory does not grow with the run."""

    def __init__(self, task: TaskConfig, parameters: RigParameters) -> None:
        self._task = task
        self._parameters = parameters
        self._poses = PoseGoals(task.poses)
        self._path = None if task.path is None else PathGoal(task.path)
        self._dropped_s: dict[str, float] = {}
        self._began_s: float | None = None

    def add_states(self, time_s: Floats, pose: Floats, commanded: NDArray[np.bool_]) -> None:
        """Take in states.

        Args:
            time_s: when, shape (n,), growing.
            pose: of the tool, shape (n, 4): x, y, z, m, and yaw, rad.
            commanded: where a command of the session's controller acted, shape (n,).
        """
        if self._began_s is None:
            if not commanded.any():
                return
            first = int(np.argmax(commanded))
            self._began_s = float(time_s[first])
            time_s, pose = time_s[first:], pose[first:]
        limit_s = self._task.time_limit_s
        within = time_s - self._began_s
        if limit_s:
            count = int(np.searchsorted(within, limit_s, side="right"))
            within, pose = within[:count], pose[:count]
        if len(within):
            self._poses.add(within, pose)
            if self._path is not None:
                self._path.add(within, pose[:, :3])

    def add_drop(self, part: str, time_s: float) -> None:
        """Take in that the magnet let go of a part, on the same time as the states."""
        self._dropped_s[part] = time_s

    def grade(self, stood: TaskResult | None) -> Grade:
        """The grade, once all of the run was taken in; `stood`: which parts stand on which places at the end."""
        poses = self._poses.results()
        path = None if self._path is None else self._path.result()
        parts = () if self._task.place is None else self._placed(self._task.place, stood)
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

    def _placed(self, place: PlaceConfig, stood: TaskResult | None) -> tuple[PlaceResult, ...]:
        found = {} if stood is None else {part.part: part.error_mm for part in stood.parts}
        asked = place.parts or tuple(part.name for part in self._parameters.scene.parts if part.ferromagnetic)
        results = []
        for name in asked:
            error_mm, dropped_s = found.get(name), self._dropped_s.get(name)
            at_s = None if dropped_s is None or self._began_s is None else dropped_s - self._began_s
            # What was placed too late does not count; what stood there from the start was never placed.
            in_time = at_s is not None and (not self._task.time_limit_s or at_s <= self._task.time_limit_s)
            placed = error_mm is not None and error_mm <= place.tolerance_mm and in_time
            results.append(PlaceResult(name, placed, error_mm, at_s))
        return tuple(results)
