"""Share of the network in the stage *controller*, bounded by TCP's own measurements.

The stage contains one round trip over the network and the computation of the controller. The smallest round-trip time
that TCP has measured on a connection is a proven lower bound of the network's part. The smoothed round-trip time is no
bound: a peer delays its acknowledgments until its next request, so it contains the time of the controller.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilrig_replay.io.records import Records


@dataclass(frozen=True, slots=True)
class NetworkShare:
    """Bounds of the parts of *controller*, and retransmissions."""

    min_ms: float | None
    """Lower bound of the network's part; None: not measured."""
    controller_max_ms: float | None
    """Upper bound of the controller's part, of the median of *controller*; None: not measured, or no samples."""
    retransmissions: int
    """TCP segments that the edge sent again."""

    def __str__(self) -> str:
        """The bounds as text."""
        parts = []
        if self.min_ms is not None:
            parts.append(f"network ≥ {_text_ms(self.min_ms)}")
        if self.controller_max_ms is not None:
            parts.append(f"controller ≤ {_text_ms(self.controller_max_ms)}")
        if self.retransmissions:
            parts.append(f"{self.retransmissions} TCP retransmission{'s' * (self.retransmissions > 1)}")
        return ", ".join(parts)


def network_share(windows: Sequence[Records], controller_p50_ms: float | None) -> NetworkShare | None:
    """Share of the network in a run; None: no TCP figures of a connection that wrote are recorded.

    Args:
        windows: parts of the run.
        controller_p50_ms: median of the stage *controller*; None: no samples.
    """
    writers = np.unique(np.concatenate([window.commands["controller"] for window in windows]))
    figures = np.concatenate([window.connections for window in windows])
    figures = figures[np.isin(figures["controller"], writers)]
    if not len(figures):
        return None
    measured_us = figures["min_rtt_us"][figures["min_rtt_us"] > 0]
    # A bound of each connection is one of all of them.
    min_ms = int(measured_us.min()) / 1e3 if len(measured_us) else None
    controller_max_ms = None if controller_p50_ms is None or min_ms is None else max(controller_p50_ms - min_ms, 0.0)
    by_connection = [figures[figures["controller"] == code] for code in np.unique(figures["controller"])]
    retransmissions = sum(int(rows["retransmissions"].max()) for rows in by_connection)
    return NetworkShare(min_ms, controller_max_ms, retransmissions)


def _text_ms(value_ms: float) -> str:
    return f"{value_ms:.1f} ms" if value_ms >= 1 else f"{value_ms:.2f} ms"
