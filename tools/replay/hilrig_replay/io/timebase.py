"""The time of a run: seconds from its first state, for rows that were stamped by different clocks."""

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows


class Timebase:
    """Places rows on one axis.

    States, and what is made of them, go by the simulation's monotonic clock; across a restart of the simulation, which
    begins a new clock, the wall clock carries over. All else goes by the wall clock.
    """

    def __init__(self) -> None:
        self.start_wall_ns = 0
        """The first state on the wall clock, ns since 1970-01-01 UTC; 0: none has come."""
        self.origin_ns = 0
        """What counts as time zero, ns from the first state: moved to align runs with each other."""
        self._offsets: dict[int, int] = {}
        self._anchor: tuple[int, int] = (0, 0)

    def note(self, states: Rows) -> None:
        """Take in states, fields as `columns.STATE`, before their time is asked for."""
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
                self._offsets[incarnation] = int(row["wall_ns"]) - self.start_wall_ns - int(row["sampled_ns"])
        self._anchor = (int(states["wall_ns"][-1]), int(states["step"][-1]))

    def time_ns(self, rows: Rows) -> NDArray[np.int64]:
        """When the rows were sent, shape as `rows`: ns from the run's first state."""
        names = rows.dtype.names or ()
        if "sampled_ns" not in names:
            return np.asarray(rows["wall_ns"] - self.start_wall_ns - self.origin_ns)
        times = rows["sampled_ns"].copy()
        incarnations = rows["incarnation"]
        for incarnation, offset in self._offsets.items():
            times[incarnations == incarnation] += offset
        return np.asarray(times - self.origin_ns)

    def steps(self, rows: Rows, step_ns: int) -> NDArray[np.int64]:
        """The simulation's step at the time of rows, shape as `rows`; where they don't say it, by the wall clock."""
        wall_ns, step = self._anchor
        by_clock = np.maximum(step + (rows["wall_ns"] - wall_ns) // step_ns, 0)
        if "step" not in (rows.dtype.names or ()):
            return np.asarray(by_clock)
        said = rows["step"].astype(np.int64)
        return np.asarray(np.where(said > 0, said, by_clock))
