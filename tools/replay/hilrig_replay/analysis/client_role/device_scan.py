"""Scan time of a controller that is a Modbus server, measured with its echo register.

Each change of the echo is one scan of the program, unless several scans see the same positions. A scan ended between
reads: the newest one with the echo before it, and the one that returned it. If the program is slower than the cycle of
the edge, no scan is missed, and its period is the mean interval between the changes; otherwise the cycle is a bound.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from hilrig_replay.io.columns import Rows

MIN_SCANS: Final = 20
MIN_STALE_SHARE: Final = 0.05
"""Share of the changes before which an old echo was read, from which on the program is slower than the cycle."""
MAX_PERIOD_RATIO: Final = 3.0
"""Intervals longer than this many medians are pauses."""


@dataclass(frozen=True, slots=True)
class DeviceScan:
    """Scan time of the controller's program; ms."""

    scan_ms: float
    """Mean scan time, or an upper bound."""
    error_ms: float
    """Largest error of the mean; 0 for a bound."""
    is_bound: bool
    """Whether the program is faster than the cycle of the edge, so that `scan_ms` is a bound."""
    pickup_ms: tuple[float, float]
    """Bounds of the median time from the acknowledged positions to the torques that answer them in the registers."""

    def __str__(self) -> str:
        """The scan as text."""
        low, high = self.pickup_ms
        pickup = f"torques {low:.1f} to {high:.1f} ms after the positions"
        if self.is_bound:
            return f"scan of the controller's program ≤ {self.scan_ms:.1f} ms, {pickup}"
        return f"scan of the controller's program {self.scan_ms:.1f} ± {self.error_ms:.1f} ms, {pickup}"


def device_scan(commands: Rows) -> DeviceScan | None:
    """Return the scan time that the commands of a run show, fields as `COMMAND_DTYPE`; None: no echo, or too few."""
    was_read, is_bound = commands["read_sent_ns"] > 0, commands["basis_is_bound"]
    scans = commands[was_read & ~is_bound]
    if len(scans) < MIN_SCANS:
        return None
    latest_ns = scans["write_arrived_ns"]
    stale_ns = scans["stale_read_sent_ns"]
    earliest_ns = np.maximum(stale_ns, scans["state_served_ns"])
    interval_ns = np.diff(latest_ns)
    # Windows of a short run overlap.
    regular = (interval_ns > 0) & (interval_ns <= MAX_PERIOD_RATIO * np.median(interval_ns))
    period_ns = float(interval_ns[regular].mean())
    acknowledged_ns = scans["positions_acknowledged_ns"]
    low_ns, high_ns = np.median(np.maximum(earliest_ns - acknowledged_ns, 0)), np.median(latest_ns - acknowledged_ns)
    pickup_ms = float(low_ns) / 1e6, float(high_ns) / 1e6
    if (stale_ns > 0).mean() < MIN_STALE_SHARE:
        return DeviceScan(period_ns / 1e6, 0.0, True, pickup_ms)
    width_ns = float((latest_ns - earliest_ns).max())
    return DeviceScan(period_ns / 1e6, width_ns / int(regular.sum()) / 1e6, False, pickup_ms)
