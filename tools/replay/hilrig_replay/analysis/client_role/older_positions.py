"""Estimate of the time by which torques answer older positions than the basis of the client role without an echo.

The recorded basis is the newest state whose positions the controller could have: an upper bound of the state that the
torques answer, so the loop latency is a lower bound. How much older the answered positions are is estimated from the
torques. While the arm moves, each scan of the program changes the torques: it ended between two reads. A program that
writes its torques in the scan in which it reads the positions has read them up to one scan earlier; the mean interval
between the changes is at least a scan. If the program is faster than the reads, the rounding errors in the torques
(`feedback.rounding_gains`) show the polls that they answer, and narrow the estimate.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.feedback import RoundingGains
from hilrig_replay.io.columns import Rows

MIN_SCANS: Final = 20
MIN_CHANGE: Final = 0.005
"""Change of a torque, N·m or N, that shows a moving arm: each scan of the program then changes the torques."""
MAX_PERIOD_RATIO: Final = 3.0
"""Intervals longer than this many medians are pauses."""
MIN_DISTINCT_SHARE: Final = 0.5
"""Share of the scans with torques of their own."""
MAX_HELD_SHARE: Final = 0.05
"""Share of repeated torques up to which the program is faster than the reads."""


@dataclass(frozen=True, slots=True)
class OlderPositions:
    """Range of the mean time to add to the loop latency; ms."""

    low_ms: float
    high_ms: float

    def __str__(self) -> str:
        """The estimate as text."""
        return (
            f"estimate from the torques: on average they answer positions that are {self.low_ms:.0f} to "
            f"{self.high_ms:.0f} ms older than those of the loop latency"
        )


def older_positions(windows: Iterable[Rows], gains: RoundingGains, step_ns: int) -> OlderPositions | None:
    """Return the estimate; None: the torques do not show it.

    Args:
        windows: commands of parts of a run, fields as `COMMAND_DTYPE`.
        gains: gains of the rounding errors of the same parts.
        step_ns: step of the simulation, ns.
    """
    parts = []
    for window in windows:
        is_bound, safe = window["basis_is_bound"], window["safe"]
        parts.append(_Scans.of(window[is_bound & ~safe]))
    intervals_ns = np.concatenate([np.empty(0, np.int64), *(part.intervals_ns for part in parts)])
    if len(intervals_ns) < MIN_SCANS:
        return None
    longest_ns = MAX_PERIOD_RATIO * float(np.median(intervals_ns))
    scan_ns = float(intervals_ns[intervals_ns <= longest_ns].mean())
    older_ns = np.concatenate([part.older_ns(scan_ns, longest_ns) for part in parts])
    if not len(older_ns):
        return None
    low_ms, high_ms = (older_ns.mean(axis=0) / 1e6).tolist()
    if len(older_ns) - len(intervals_ns) <= MAX_HELD_SHARE * len(older_ns):
        high_ms = max(low_ms, min(high_ms, _largest_of_rounding_ms(gains, step_ns)))
    return OlderPositions(low_ms, high_ms)


@dataclass(frozen=True, slots=True)
class _Scans:
    """Scans of a program that the commands of one part show."""

    commands: Rows
    first: NDArray[np.int64]
    """Rows of the first commands with the torques of each scan, (n,)."""
    after: NDArray[np.int64]
    """The row after the last one, (n,)."""

    @classmethod
    def of(cls, commands: Rows) -> "_Scans":
        effort: NDArray[np.float64] = commands["effort"]
        change = np.abs(np.diff(effort, axis=0)).max(axis=1, initial=0.0)
        changed = np.flatnonzero(change > 0) + 1
        # Small changes are those of an arm that rests or turns: a scan may then have left the torques as they were.
        large = change[changed - 1] >= MIN_CHANGE
        usable = np.flatnonzero(large[:-1] & large[1:])
        first = changed[usable]
        # A program that switches between a few torques does not change them with each scan.
        if len(np.unique(commands["effort"][first], axis=0)) < MIN_DISTINCT_SHARE * len(first):
            usable = usable[:0]
        return cls(commands, changed[usable], changed[usable + 1])

    @property
    def intervals_ns(self) -> NDArray[np.int64]:
        """Time from each scan's torques to the next one's, ns, (n,)."""
        arrived_ns = self.commands["write_arrived_ns"]
        return np.asarray(arrived_ns[self.after] - arrived_ns[self.first])

    def older_ns(self, scan_ns: float, longest_ns: float) -> NDArray[np.float64]:
        """Bounds of the age of the positions against the basis, ns, (commands, 2), of scans up to a length."""
        served_ns, acknowledged_ns = self.commands["state_served_ns"], self.commands["positions_acknowledged_ns"]
        bounds = [np.empty((0, 2))]
        for first, after in zip(self.first[chosen := self.intervals_ns <= longest_ns], self.after[chosen], strict=True):
            # The read before still returned other torques: the scan ended later, and began at most one scan earlier.
            begun_ns = self.commands["read_sent_ns"][first - 1] - scan_ns
            oldest = np.searchsorted(acknowledged_ns, begun_ns, side="right") - 1
            if oldest >= 0:
                served = served_ns[first:after]
                bounds.append(np.stack((served - served_ns[first], served - served_ns[oldest]), axis=1))
        return np.concatenate(bounds)


def _largest_of_rounding_ms(gains: RoundingGains, step_ns: int) -> float:
    """Largest mean time that agrees with the rounding errors in the torques, ms; infinite: they do not show it."""
    first = gains.polls_behind
    if first is None:
        return math.inf
    joint = int(np.argmax(gains.statistics.max(axis=1)))
    values, older = gains.gains[joint], gains.older_steps
    # A derivative has gains of the opposite sign at older polls.
    shares = values * np.sign(values[first])
    shares[:first] = 0.0
    opposite = np.flatnonzero(shares[first:] <= 0)
    if len(opposite):
        shares[first + opposite[0] :] = 0.0
    total = float(shares.sum())
    mean_steps = float(shares @ older) / total
    variances = values**2 / np.maximum(gains.statistics[joint], 1e-9)
    deviation_steps = float(np.sqrt(((older - mean_steps) ** 2 * variances).sum())) / total
    # Within the time between two polls a scan of the program can't be located.
    return (mean_steps + float(np.diff(older).mean()) / 2 + 3 * deviation_steps) * step_ns / 1e6
