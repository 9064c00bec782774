"""Common time axis of a run: seconds from its first state, for rows with timestamps of different clocks."""

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows


class Timebase:
    """Maps the timestamps of rows to one time axis.

    States, and rows derived from them, are placed by the monotonic clock of the simulation. A restart of the simulation
    starts a new clock, which is aligned by the wall clock. All other rows are placed by the wall clock.
    """

    def __init__(self) -> None:
        self.start_wall_ns = 0
        """Wall-clock time of the first state, ns since 1970-01-01 UTC; 0: no state was added."""
        self.origin_ns = 0
        """Time zero of the axis, ns from the first state; changed to align runs."""
        self._offsets: dict[int, int] = {}
        self._anchor: tuple[int, int] = (0, 0)

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
                self._offsets[incarnation] = int(row["wall_ns"]) - self.start_wall_ns - int(row["sampled_ns"])
        self._anchor = (int(states["wall_ns"][-1]), int(states["step"][-1]))

    def time_ns(self, rows: Rows) -> NDArray[np.int64]:
        """Times at which the rows were sent, ns from the first state of the run, shape as `rows`."""
        names = rows.dtype.names or ()
        if "sampled_ns" not in names:
            return np.asarray(rows["wall_ns"] - self.start_wall_ns - self.origin_ns)
        times = rows["sampled_ns"].copy()
        incarnations = rows["incarnation"]
        for incarnation, offset in self._offsets.items():
            times[incarnations == incarnation] += offset
        return np.asarray(times - self.origin_ns)

    def steps(self, rows: Rows, step_ns: int) -> NDArray[np.int64]:
        """Simulation step of each row, shape as `rows`; estimated from the wall clock if a row has no step."""
        wall_ns, step = self._anchor
        estimated = np.maximum(step + (rows["wall_ns"] - wall_ns) // step_ns, 0)
        if "step" not in (rows.dtype.names or ()):
            return np.asarray(estimated)
        recorded = rows["step"].astype(np.int64)
        return np.asarray(np.where(recorded > 0, recorded, estimated))
