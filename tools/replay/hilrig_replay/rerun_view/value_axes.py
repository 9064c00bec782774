"""Ranges of the value axes: the viewer labels multiples of a power of ten, and few if these are not within the data.

A range is extended to the next label, so that each axis has two numbers at least. Numbers of similar width align the
time axes.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hilrig_replay.io.records import Records
from hilrig_replay.rerun_view import entity_paths as paths
from hilrig_sim.arm.joints import JOINT_SCALE

Range = tuple[float, float]

MIN_LABEL_SHARE: Final = 0.23
"""Smallest distance of two labels as a share of the axis; nearer labels are left out by the viewer."""
_MARGIN: Final = 0.06


def labeled_range(low: float, high: float) -> Range:
    """Smallest range that contains zero, all values from `low` to `high`, and a second label."""
    low, high = min(low, 0.0), max(high, 0.0)
    span = high - low
    if not (math.isfinite(span) and span > 0.0):
        return -1.0, 1.0
    step = 10.0 ** math.ceil(math.log10(MIN_LABEL_SHARE * span) - 1e-9)
    if -low > high:
        low = math.floor(low / step + 1e-9) * step
    else:
        high = math.ceil(high / step - 1e-9) * step
    margin = _MARGIN * (high - low)
    return low - margin, high + margin


class ValueRanges:
    """Ranges of the plots of runs, which are added block by block."""

    def __init__(self) -> None:
        self._extremes: dict[str, NDArray[np.float64]] = {}

    def add(self, records: Records) -> None:
        """Add the states and commands of a block."""
        self.extend(paths.POSITION, records.states["position"] * JOINT_SCALE)
        self.extend(paths.VELOCITY, records.states["velocity"] * JOINT_SCALE)
        self.extend(paths.EFFORT, records.states["effort"])
        self.extend(paths.EFFORT, records.commands["effort"])

    def extend(self, path: str, values: ArrayLike) -> None:
        """Add values to the plot with a path."""
        finite = np.asarray(values, np.float64)
        finite = finite[np.isfinite(finite)]
        if len(finite):
            both = np.append(self._extremes.get(path, np.empty(0)), (finite.min(), finite.max()))
            self._extremes[path] = np.array((both.min(), both.max()))

    def ranges(self) -> dict[str, Range]:
        """Range of each plot with values, by the path of its first entity."""
        return {path: labeled_range(*extremes.tolist()) for path, extremes in self._extremes.items()}
