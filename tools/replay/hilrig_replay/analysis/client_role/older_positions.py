"""Estimate of the time by which torques answer older positions than the bound of the client role without an echo.

The controller had newer positions than its program used. The torques contain the rounding errors of the positions that
they were computed from (`feedback.rounding_gains`); the gains of successive polls are the shares of the torques that
answer each.
"""

from dataclasses import dataclass

import numpy as np

from hilrig_replay.analysis.feedback import RoundingGains


@dataclass(frozen=True, slots=True)
class OlderPositions:
    """Time to add to the loop latency; ms."""

    mean_ms: float
    error_ms: float
    """Half of the time between two polls, by which a scan of the program can't be located, and twice the standard error
    of the gains."""

    def __str__(self) -> str:
        """The estimate as text."""
        return (
            f"estimate from the rounding errors in the torques: they answer positions that are {self.mean_ms:.0f} ± "
            f"{self.error_ms:.0f} ms older than the bound"
        )


def older_positions(gains: RoundingGains, step_ns: int) -> OlderPositions | None:
    """Return the estimate; None: the torques do not show it."""
    first = gains.polls_behind
    if first is None:
        return None
    joint = int(np.argmax(gains.statistics.max(axis=1)))
    # A derivative has gains of the opposite sign at older polls.
    shares = gains.gains[joint] * np.sign(gains.gains[joint, first])
    shares[:first] = 0.0
    opposite = np.flatnonzero(shares[first:] <= 0)
    if len(opposite):
        shares[first + opposite[0] :] = 0.0
    mean_steps = float(shares @ gains.older_steps / shares.sum())
    poll_steps = float(np.diff(gains.older_steps).mean())
    error_steps = poll_steps / 2 + 2 * mean_steps / np.sqrt(gains.statistics[joint].max())
    return OlderPositions(mean_steps * step_ns / 1e6, error_steps * step_ns / 1e6)
