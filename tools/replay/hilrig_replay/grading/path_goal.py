"""Path goal: how much of a path the tool covered, and the tracking error.

Tracking starts when the tool first reaches the first point of the path, and ends when the tool is at the last point and
the path is covered. Covered are the points within the tolerance of the tool, and the points between two consecutive
states along the path.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.config.task import PathConfig

Floats = NDArray[np.float64]

MIN_COVERED_SHARE: Final = 0.98
"""Minimum covered share of a finished path."""
PATH_CELLS: Final = 1000
"""Number of cells of equal length in which coverage is counted."""
STATES_PER_BLOCK: Final = 2000
"""States that are processed together; bounds the memory."""
MAX_ADVANCE_RATIO: Final = 2.0
"""Maximum advance along the path between two states, relative to the distance that the tool moved (plus the tolerance):
the tool may cut corners slightly. A larger advance is a jump, and the path in between is not covered."""


@dataclass(frozen=True, slots=True)
class PathResult:
    """Result of the path; times from the start of the task."""

    length_m: float
    covered: float
    """Covered share of the path, 0 to 1."""
    began_s: float | None
    """Time at which the tool reached the first point, s; None: never."""
    done_s: float | None
    """Time at which the path was finished, s; None: not finished."""
    rms_mm: float | None
    """Tracking error: root mean square distance of the tool from the path, until the tool finally left it, mm."""
    largest_mm: float | None
    """Largest distance of the tool from the path over the same time, mm."""

    def sentence(self) -> str:
        """The result as a human-readable text."""
        if self.began_s is None or self.rms_mm is None:
            return "the tool never reached the first point"
        until = "" if self.done_s is None else f" from {self.began_s:.1f} s to {self.done_s:.1f} s"
        return (
            f"{self.covered:.0%} of {self.length_m:.2f} m{until}; "
            f"tracking error rms {self.rms_mm:.2f} mm, largest {self.largest_mm:.1f} mm"
        )


@dataclass(slots=True)
class _Errors:
    """Accumulated distances, m."""

    squares: float = 0.0
    count: int = 0
    largest: float = 0.0

    def add(self, error: float) -> None:
        self.squares += error * error
        self.count += 1
        self.largest = max(self.largest, error)

    def join(self, other: "_Errors") -> None:
        self.squares += other.squares
        self.count += other.count
        self.largest = max(self.largest, other.largest)


class PathGoal:
    """Evaluates the motion of the tool along a path."""

    def __init__(self, path: PathConfig) -> None:
        points = np.array(path.points_mm) / 1000
        self._begin, self._segments = points[:-1], np.diff(points, axis=0)
        self._lengths = np.linalg.norm(self._segments, axis=1)
        self._from_start = np.concatenate(([0.0], np.cumsum(self._lengths)))
        self._length = float(self._from_start[-1])
        self._ends = points[0], points[-1]
        self._tolerance = path.tolerance_mm / 1000
        self._covered = np.zeros(PATH_CELLS, np.bool_)
        self._last: tuple[float, Floats] | None = None
        """Position of the tool along the path, m, and in the world at the previous state; None: not on the path."""
        self._began_s: float | None = None
        self._done_s: float | None = None
        self._tracking, self._off_path = _Errors(), _Errors()

    def add(self, time_s: Floats, tip: Floats) -> None:
        """Add states: times, shape (n,), and positions of the tool, shape (n, 3), m."""
        for start in range(0, len(time_s), STATES_PER_BLOCK):
            if self._done_s is not None:
                return
            self._add(time_s[start : start + STATES_PER_BLOCK], tip[start : start + STATES_PER_BLOCK])

    def _add(self, time_s: Floats, tip: Floats) -> None:
        if self._began_s is None:
            at_start = np.linalg.norm(tip - self._ends[0], axis=1) <= self._tolerance
            if not at_start.any():
                return
            first = int(np.argmax(at_start))
            self._began_s = float(time_s[first])
            time_s, tip = time_s[first:], tip[first:]
        apart, along = self._nearest(tip)
        at_end = np.linalg.norm(tip - self._ends[1], axis=1) <= self._tolerance
        for row in range(len(tip)):
            self._off_path.add(float(apart[row]))
            if apart[row] > self._tolerance:
                self._last = None
                continue
            # Deviations between two states on the path count; those after the last state on the path do not.
            self._tracking.join(self._off_path)
            self._off_path = _Errors()
            self._cover(float(along[row]), tip[row])
            if at_end[row] and self._covered.mean() >= MIN_COVERED_SHARE:
                self._done_s = float(time_s[row])
                break

    def _cover(self, along: float, tip: Floats) -> None:
        """Mark the path between the previous position and `along` (m along the path) as covered."""
        before = along
        if self._last is not None:
            last_along, last_tip = self._last
            moved = float(np.linalg.norm(tip - last_tip))
            if abs(along - last_along) <= MAX_ADVANCE_RATIO * moved + self._tolerance:
                before = last_along
        low, high = (along_m / self._length * PATH_CELLS for along_m in sorted((before, along)))
        around = self._tolerance / self._length * PATH_CELLS
        self._covered[max(0, math.floor(low - around)) : math.ceil(high + around)] = True
        self._last = (along, tip)

    def _nearest(self, tip: Floats) -> tuple[Floats, Floats]:
        """Distance of the tool from the path, and position of the nearest point along the path, m, shapes (n,)."""
        share = np.einsum("nsk,sk->ns", tip[:, None] - self._begin, self._segments) / self._lengths**2
        share = np.clip(share, 0.0, 1.0)
        apart = np.linalg.norm(tip[:, None] - self._begin - share[..., None] * self._segments, axis=2)
        segment = np.argmin(apart, axis=1)
        rows = np.arange(len(tip))
        return apart[rows, segment], self._from_start[segment] + share[rows, segment] * self._lengths[segment]

    def result(self) -> PathResult:
        """Result of the states that were added."""
        tracking = self._tracking
        return PathResult(
            length_m=self._length,
            covered=float(self._covered.mean()) if self._done_s is None else 1.0,
            began_s=self._began_s,
            done_s=self._done_s,
            rms_mm=1000 * math.sqrt(tracking.squares / tracking.count) if tracking.count else None,
            largest_mm=1000 * tracking.largest if tracking.count else None,
        )
