"""Path goal: how much of a path the tool covered in its order, and the tracking error.

Tracking starts when the tool first reaches the first point of the path, and ends when the tool is at the last point and
the path is covered. The position along the path is followed continuously: near its last position, so that a stretch
that the path passes twice, or a loop, counts each time that the tool passes it. All is measured on the motion between
the states (`interpolation`).
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
LONGEST_MOVE_SHARE: Final = 0.25
"""The motion is evaluated after each move of this share of the tolerance."""
EVALUATION_PERIOD_S: Final = 0.02
"""Longest time between two evaluations, s."""
MAX_ADVANCE_RATIO: Final = 2.0
"""Maximum advance along the path, relative to the distance that the tool moved since it was last on the path (plus
twice the tolerance): the tool may cut corners slightly. Points farther ahead are another stretch of the path."""
BACKWARD_PENALTY: Final = 0.5
"""Of two stretches within reach, the later one is taken unless the tool is nearer to the earlier one by this share of
the tolerance: at a turning point both are equally near."""


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
    """Accumulated distances over time, m, s."""

    squares: float = 0.0
    time_s: float = 0.0
    largest: float = 0.0

    def add(self, error: float, time_s: float) -> None:
        self.squares += error * error * time_s
        self.time_s += time_s
        self.largest = max(self.largest, error)

    def join(self, other: "_Errors") -> None:
        self.squares += other.squares
        self.time_s += other.time_s
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
        self._along: float | None = None
        """Last position of the tool along the path, m; None: it has not reached the first point."""
        self._on_path = False
        """Whether the tool was on the path at the last evaluated state."""
        self._moved = 0.0
        """Distance that the tool moved since then, m."""
        self._last: tuple[float, Floats] | None = None
        """Time, s, and position of the last state."""
        self._pending_s = 0.0
        """Time since the last evaluated state, s."""
        self._began_s: float | None = None
        self._done_s: float | None = None
        self._tracking, self._off_path = _Errors(), _Errors()

    def add(self, time_s: Floats, tip: Floats) -> None:
        """Add states of the interpolated motion: times, (n,), and positions of the tool, (n, 3), m."""
        if self._began_s is None:
            at_start = np.linalg.norm(tip - self._ends[0], axis=1) <= self._tolerance
            if not at_start.any():
                return
            first = int(np.argmax(at_start))
            time_s, tip = time_s[first:], tip[first:]
            self._began_s, self._along, self._on_path = float(time_s[0]), 0.0, True
            self._last = float(time_s[0]), tip[0]
            self._evaluate(float(time_s[0]), tip[0])
            time_s, tip = time_s[1:], tip[1:]
        if self._done_s is not None or not len(time_s):
            return
        assert self._last is not None
        before = np.concatenate((self._last[1][np.newaxis], tip[:-1]))
        moves = np.linalg.norm(tip - before, axis=1).tolist()
        times = np.diff(time_s, prepend=self._last[0]).tolist()
        longest = LONGEST_MOVE_SHARE * self._tolerance
        self._last = float(time_s[-1]), tip[-1].copy()
        since = self._moved if self._on_path else 0.0
        for row, (move, span_s) in enumerate(zip(moves, times, strict=True)):
            self._moved += move
            since += move
            self._pending_s += span_s
            # A tool that hardly moves is evaluated less often.
            if since >= longest or self._pending_s >= EVALUATION_PERIOD_S:
                since = 0.0
                self._evaluate(float(time_s[row]), tip[row])
                if self._done_s is not None:
                    return

    def _evaluate(self, time_s: float, tip: Floats) -> None:
        """Follow the position along the path, count coverage and error."""
        assert self._along is not None
        reach = MAX_ADVANCE_RATIO * self._moved + 2 * self._tolerance
        apart, along = self._nearest(tip, self._along - reach, self._along + reach)
        self._off_path.add(apart, self._pending_s)
        self._pending_s = 0.0
        if apart > self._tolerance:
            self._on_path = False
            return
        # Deviations between two times on the path count; those after the last time on the path do not.
        self._tracking.join(self._off_path)
        self._off_path = _Errors()
        before = self._along if self._on_path else along
        low, high = (along_m / self._length * PATH_CELLS for along_m in sorted((before, along)))
        around = self._tolerance / self._length * PATH_CELLS
        self._covered[max(0, math.floor(low - around)) : math.ceil(high + around)] = True
        self._along, self._on_path, self._moved = along, True, 0.0
        at_end = float(np.linalg.norm(tip - self._ends[1])) <= self._tolerance
        if at_end and along >= self._length - 2 * self._tolerance and self._covered.mean() >= MIN_COVERED_SHARE:
            self._done_s = time_s

    def _nearest(self, tip: Floats, low: float, high: float) -> tuple[float, float]:
        """Return distance and position of the nearest point of the path between two positions along it, m."""
        assert self._along is not None
        starts, lengths = self._from_start[:-1], self._lengths
        within = np.flatnonzero((starts <= high) & (starts + lengths >= low))
        starts, lengths = starts[within], lengths[within]
        begin, segments = self._begin[within], self._segments[within]
        share = np.einsum("sk,sk->s", tip - begin, segments) / lengths**2
        share = np.minimum(np.maximum(share, np.maximum(low - starts, 0.0) / lengths), (high - starts) / lengths)
        share = np.minimum(np.maximum(share, 0.0), 1.0)
        apart = np.linalg.norm(tip - begin - share[:, np.newaxis] * segments, axis=1)
        along = starts + share * lengths
        cost = apart + np.where(along < self._along, BACKWARD_PENALTY * self._tolerance, 0.0)
        best = int(np.argmin(cost))
        return float(apart[best]), float(along[best])

    def result(self) -> PathResult:
        """Result of the states that were added."""
        tracking = self._tracking
        return PathResult(
            length_m=self._length,
            covered=float(self._covered.mean()) if self._done_s is None else 1.0,
            began_s=self._began_s,
            done_s=self._done_s,
            rms_mm=1000 * math.sqrt(tracking.squares / tracking.time_s) if tracking.time_s else None,
            largest_mm=1000 * tracking.largest if tracking.time_s else None,
        )
