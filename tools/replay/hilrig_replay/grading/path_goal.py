"""A path to be followed: how much of it the tool passed, and how far from it the tool was on the way.

Following begins where the tool first comes to the path's first point, and ends at its last point with the path passed.
Passed is what is within tolerance of the tool, and all between two states that follow each other along the path.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.config.task import PathConfig

Floats = NDArray[np.float64]

COVERED: Final = 0.98
"""Share of a path that has to be passed for it to count as followed."""
CELLS: Final = 1000
"""What is passed is counted in so many pieces of equal length."""
ROWS: Final = 2000
"""States that are looked at together: bounds the memory."""
CORNER: Final = 2.0
"""From one state to the next the tool advances along the path at most so many times as far as it moves, and by a
tolerance more: at a corner it may cut a little. What is farther along was not passed, but jumped to."""


@dataclass(frozen=True, slots=True)
class PathResult:
    """How a path was followed; times from the beginning of the task."""

    length_m: float
    covered: float
    """Share of it that was passed, 0 to 1."""
    began_s: float | None
    """When the tool came to its first point, s; None: it never did."""
    done_s: float | None
    """When it was passed to its last point, s; None: it was not."""
    rms_mm: float | None
    """Distance of the tool from the path while following it, until it left it for good, root mean square, mm: the
    tracking error."""
    largest_mm: float | None

    def sentence(self) -> str:
        """What there is to say of it."""
        if self.began_s is None or self.rms_mm is None:
            return "the tool never came to its beginning"
        until = "" if self.done_s is None else f" from {self.began_s:.1f} s to {self.done_s:.1f} s"
        return (
            f"{self.covered:.0%} of {self.length_m:.2f} m{until}; "
            f"tracking error rms {self.rms_mm:.2f} mm, largest {self.largest_mm:.1f} mm"
        )


@dataclass(slots=True)
class _Errors:
    """Distances, summed up; m."""

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
    """Watches the tool along a path."""

    def __init__(self, path: PathConfig) -> None:
        points = np.array(path.points_mm) / 1000
        self._begin, self._ways = points[:-1], np.diff(points, axis=0)
        self._lengths = np.linalg.norm(self._ways, axis=1)
        self._from_start = np.concatenate(([0.0], np.cumsum(self._lengths)))
        self._length = float(self._from_start[-1])
        self._ends = points[0], points[-1]
        self._tolerance = path.tolerance_mm / 1000
        self._passed = np.zeros(CELLS, np.bool_)
        self._last: tuple[float, Floats] | None = None
        """Where the tool was on the path, m along it, and in the world, at the state before; None: it was not."""
        self._began_s: float | None = None
        self._done_s: float | None = None
        self._following, self._away = _Errors(), _Errors()

    def add(self, time_s: Floats, tip: Floats) -> None:
        """Take in states: when, shape (n,), and where the tool was, shape (n, 3), m."""
        for start in range(0, len(time_s), ROWS):
            if self._done_s is not None:
                return
            self._add(time_s[start : start + ROWS], tip[start : start + ROWS])

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
            self._away.add(float(apart[row]))
            if apart[row] > self._tolerance:
                self._last = None
                continue
            # What lies between two states on the path was on its way; what comes after the last one was not.
            self._following.join(self._away)
            self._away = _Errors()
            self._pass(float(along[row]), tip[row])
            if at_end[row] and self._passed.mean() >= COVERED:
                self._done_s = float(time_s[row])
                break

    def _pass(self, along: float, tip: Floats) -> None:
        """The tool is at `along` on the path, m, and passed what is between there and where it was before."""
        before = along
        if self._last is not None:
            last_along, last_tip = self._last
            moved = float(np.linalg.norm(tip - last_tip))
            if abs(along - last_along) <= CORNER * moved + self._tolerance:
                before = last_along
        low, high = (along_m / self._length * CELLS for along_m in sorted((before, along)))
        around = self._tolerance / self._length * CELLS
        self._passed[max(0, math.floor(low - around)) : math.ceil(high + around)] = True
        self._last = (along, tip)

    def _nearest(self, tip: Floats) -> tuple[Floats, Floats]:
        """Distance of the tool from the path, and how far along it the nearest point is, m, shapes (n,)."""
        share = np.einsum("nsk,sk->ns", tip[:, None] - self._begin, self._ways) / self._lengths**2
        share = np.clip(share, 0.0, 1.0)
        apart = np.linalg.norm(tip[:, None] - self._begin - share[..., None] * self._ways, axis=2)
        segment = np.argmin(apart, axis=1)
        rows = np.arange(len(tip))
        return apart[rows, segment], self._from_start[segment] + share[rows, segment] * self._lengths[segment]

    def result(self) -> PathResult:
        """How it went."""
        following = self._following
        return PathResult(
            length_m=self._length,
            covered=float(self._passed.mean()) if self._done_s is None else 1.0,
            began_s=self._began_s,
            done_s=self._done_s,
            rms_mm=1000 * math.sqrt(following.squares / following.count) if following.count else None,
            largest_mm=1000 * following.largest if following.count else None,
        )
