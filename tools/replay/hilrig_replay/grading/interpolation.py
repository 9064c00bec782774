"""Motion of the tool between two states: cubic interpolation by poses and velocities.

The states of a run are 20 ms apart, in which a quick tool moves several centimeters. Goals are evaluated on the
interpolated motion, so that a crossing between two states is found.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESOLUTION_S: Final = 0.001
"""Longest time between two interpolated states, s."""
LONGEST_INTERVAL_S: Final = 0.1
"""Two states that are farther apart are a gap in the recording, which is not interpolated."""


class Interpolation:
    """Interpolates the states of a run, which are added block by block; the result does not depend on the blocks."""

    def __init__(self) -> None:
        self._last: tuple[Floats, Floats, Floats] | None = None

    def add(self, time_s: Floats, pose: Floats, velocity: Floats) -> tuple[Floats, Floats]:
        """Return times, (m,), and poses, (m, 4), of these states and of the motion before each of them.

        Args:
            time_s: increasing, (n,).
            pose: x, y, z, m, and yaw, rad, (n, 4).
            velocity: their derivatives, (n, 4).
        """
        if not len(time_s):
            return time_s, pose
        first = [(time_s[:1], pose[:1])] if self._last is None else []
        if self._last is not None:
            parts = zip(self._last, (time_s, pose, velocity), strict=True)
            time_s, pose, velocity = (np.concatenate((last, now)) for last, now in parts)
        self._last = (time_s[-1:].copy(), pose[-1:].copy(), velocity[-1:].copy())
        interval = np.diff(time_s)
        if not len(interval):
            return first[0]
        close = (interval > 0) & (interval <= LONGEST_INTERVAL_S)
        number = np.where(close, np.maximum(1, np.ceil(interval / RESOLUTION_S - 1e-6)), 1).astype(np.int64)
        row = np.repeat(np.arange(len(interval)), number)
        # Fractions of each interval: 1/n, 2/n, …, 1.
        count_before = np.concatenate(([0], np.cumsum(number)[:-1]))
        part = (np.arange(len(row)) - count_before[row] + 1) / number[row]
        times = time_s[row] + part * interval[row]
        s = part[:, np.newaxis]
        length = interval[row][:, np.newaxis]
        poses = (
            (1 + 2 * s) * (1 - s) ** 2 * pose[row]
            + s * (1 - s) ** 2 * length * velocity[row]
            + s**2 * (3 - 2 * s) * pose[row + 1]
            + s**2 * (s - 1) * length * velocity[row + 1]
        )
        ends = part == 1
        times[ends], poses[ends] = time_s[1:], pose[1:]
        if first:
            return np.concatenate((first[0][0], times)), np.concatenate((first[0][1], poses))
        return times, poses


def yaw_error(yaw: Floats, target_deg: float) -> Floats:
    """Return the distance of angles from a target, modulo a full turn, rad."""
    return np.asarray(np.abs(np.angle(np.exp(1j * (yaw - math.radians(target_deg))))))
