"""Common time axis of a run: seconds from its first state, for rows with timestamps of different clocks."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows

MIN_CLOCK_STEP_NS: Final = 50_000_000
"""Smallest change of the difference of two clocks that is a step of the wall clock, as in the recorder."""
MAX_BEFORE_START_NS: Final = 10_000_000_000
"""Longest time from the first row of a run to its first state."""
STEP_TOLERANCE_NS: Final = 100_000_000
"""A step is noticed at the next row of its service, which may be later than a row of another service."""
MAX_STEPS: Final = 100
"""Up to this number of steps, each of them is considered for each row."""


class Timebase:
    """Maps the timestamps of rows to one time axis.

    States, and rows derived from them, are placed by the monotonic clock of the simulation. A restart of the simulation
    starts a new clock, which is aligned by the wall clock. All other rows are placed by the wall clock. If it was set
    during the run, they are placed by the edge's monotonic clock, or by the wall clock without its steps.
    """

    def __init__(self) -> None:
        self.start_wall_ns = 0
        """Wall-clock time of the first state, ns since 1970-01-01 UTC; 0: no state was added."""
        self.origin_ns = 0
        """Time zero of the axis, ns from the first state; changed to align runs."""
        self._offsets: dict[int, int] = {}
        self._anchor: tuple[int, int] = (0, 0)
        self._sim_clock, self._edge_clock = _WallClock(), _WallClock()
        self._edge_base_ns = 0
        """Wall clock without steps minus monotonic clock of the edge."""

    def update_commands(self, commands: Rows) -> None:
        """Add commands, fields as `columns.COMMAND_DTYPE`, after the states of their block."""
        if len(commands) and not self._edge_base_ns and self.start_wall_ns:
            (first,) = self._sim_clock.without_steps(commands["wall_ns"][:1]).tolist()
            self._edge_base_ns = _int64(first - int(commands["sent_ns"][0]))
        self._edge_clock.update(commands["wall_ns"], commands["sent_ns"], self.start_wall_ns)

    def update(self, states: Rows) -> None:
        """Add states, fields as `columns.STATE_DTYPE`; required before their times are computed."""
        if not len(states):
            return
        if not self.start_wall_ns:
            self.start_wall_ns = int(states["wall_ns"][0])
        incarnations = states["incarnation"]
        changes = np.flatnonzero(np.diff(incarnations) != 0) + 1
        for at in (0, *changes.tolist()):
            row = states[at]
            incarnation = int(row["incarnation"])
            if incarnation not in self._offsets:
                axis_ns = int(row["wall_ns"]) - self.start_wall_ns - self._sim_clock.step_ns
                self._offsets[incarnation] = _int64(axis_ns - int(row["sampled_ns"]))
        self._sim_clock.update(states["wall_ns"], states["sampled_ns"], self.start_wall_ns)
        self._anchor = (int(states["wall_ns"][-1]), _int64(int(states["step"][-1])))

    @property
    def has_clock_steps(self) -> bool:
        """Whether a wall clock was set in the rows that were added."""
        return self._sim_clock.has_steps or self._edge_clock.has_steps

    def time_ns(self, rows: Rows) -> NDArray[np.int64]:
        """Times at which the rows were sent, ns from the first state of the run, shape as `rows`."""
        names = rows.dtype.names or ()
        if "sampled_ns" not in names:
            return np.asarray(self._wall_ns(rows) - self.start_wall_ns - self.origin_ns)
        if len(self._offsets) == 1:
            return np.asarray(rows["sampled_ns"] + _int64(next(iter(self._offsets.values())) - self.origin_ns))
        found, place = np.unique(rows["incarnation"], return_inverse=True)
        offsets = np.array([self._offsets.get(incarnation, 0) for incarnation in found.tolist()], np.int64)
        return np.asarray(rows["sampled_ns"] + offsets[place] - self.origin_ns)

    def steps(self, rows: Rows, step_ns: int) -> NDArray[np.int64]:
        """Simulation step of each row, shape as `rows`; estimated from the wall clock if a row has no step."""
        wall_ns, step = self._anchor
        anchor_ns = _int64(wall_ns - self._sim_clock.step_ns)
        estimated = np.maximum(step + (self._wall_ns(rows) - anchor_ns) // step_ns, 0)
        if "step" not in (rows.dtype.names or ()):
            return np.asarray(estimated)
        recorded = rows["step"].astype(np.int64)
        return np.asarray(np.where(recorded > 0, recorded, estimated))

    def _wall_ns(self, rows: Rows) -> NDArray[np.int64]:
        """Wall-clock times of rows without the steps of the clock."""
        names = rows.dtype.names or ()
        if not self.has_clock_steps:
            return np.asarray(rows["wall_ns"])
        for field in ("sent_ns", "arrived_ns"):
            if field in names and self._edge_base_ns:
                return np.asarray(rows[field] + self._edge_base_ns)
        clock = self._sim_clock if self._sim_clock.has_steps else self._edge_clock
        return clock.without_steps(rows["wall_ns"])


class _WallClock:
    """The steps of a wall clock, found by a monotonic clock of the same host."""

    def __init__(self) -> None:
        self.step_ns = 0
        """Sum of the steps."""
        self._start_ns = 0
        self._last: tuple[int, int] | None = None
        self._newest_ns = -(1 << 63)
        self._begins: list[int] = []
        """Time on the axis of each step, ns."""
        self._sums = [0]
        """Sum of the steps before the first step, and after each."""

    @property
    def has_steps(self) -> bool:
        """Whether the clock was set."""
        return bool(self._begins)

    def update(self, wall_ns: NDArray[np.int64], monotonic_ns: NDArray[np.int64], start_ns: int) -> None:
        """Add times of both clocks in consecutive rows; a part of the run that was added before is ignored."""
        added = monotonic_ns > self._newest_ns
        wall_ns, monotonic_ns = wall_ns[added], monotonic_ns[added]
        if not len(wall_ns):
            return
        self._start_ns = start_ns
        last_wall, last_monotonic = self._last or (int(wall_ns[0]), int(monotonic_ns[0]))
        passed_wall = np.diff(wall_ns, prepend=last_wall)
        passed = np.diff(monotonic_ns, prepend=last_monotonic)
        jumps = passed_wall - passed
        # If the monotonic time changes more, it is another clock: the service was restarted on another host.
        is_step = (np.abs(jumps) > MIN_CLOCK_STEP_NS) & (np.abs(passed) < np.abs(jumps))
        for at in np.flatnonzero(is_step).tolist():
            self.step_ns += int(jumps[at])
            self._begins.append(int(wall_ns[at]) - start_ns - self.step_ns)
            self._sums.append(self.step_ns)
        self._last = int(wall_ns[-1]), int(monotonic_ns[-1])
        self._newest_ns = int(monotonic_ns.max())

    def without_steps(self, wall_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Wall-clock times without the steps, for rows in the order in which they were sent."""
        if not self._begins:
            return np.asarray(wall_ns)
        begins = [-MAX_BEFORE_START_NS, *self._begins, 1 << 63]
        corrected = np.empty(len(wall_ns), np.int64)
        current = 0
        for row, wall in enumerate(wall_ns.tolist()):

            def rank(number: int, wall: int = wall, current: int = current) -> tuple[int, bool, int]:
                axis_ns = wall - self._start_ns - self._sums[number]
                # The row belongs to the time between two steps in which this sum was in force.
                outside_ns = max(begins[number] - axis_ns, axis_ns - begins[number + 1], 0)
                # Of several, that of the row before, or the next later one.
                return outside_ns // STEP_TOLERANCE_NS, number < current, number

            # A damaged or forged run may have a step at each row: only the nearest ones are tried then.
            few = len(self._sums) <= MAX_STEPS
            tried = range(len(self._sums)) if few else range(max(0, current - 2), min(len(self._sums), current + 3))
            current = min(tried, key=rank)
            corrected[row] = _int64(wall - self._sums[current])
        return corrected


def _int64(number: int) -> int:
    """A number in the range of the arrays; differences of impossible timestamps exceed it."""
    return max(-(1 << 63), min(number, (1 << 63) - 1))
