"""LQR with delay compensation: an observer on what was served, the model run ahead over the measured loop latency.

A predictor in the manner of Smith (1957), in state space: at a poll the served position is d polls old by the time
its torque acts. The observer estimates the state then, the controller's own last d commands bring it to the time when
the new one will act, and the state feedback of the undelayed loop is applied there. d is the loop latency that the
extended map shows, in polls, so a loop that slows down is met as it does.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.controllers import LawController, Measured
from hilrig_study.theory.linear import LinearPlant

Floats = NDArray[np.float64]
Vector4 = tuple[float, float, float, float]

POSITION_SCALE: Final = np.array([np.radians(1.0), np.radians(1.0), 1e-3, np.radians(1.0)])
"""An error that weighs 1: 1° or 1 mm."""
VELOCITY_SCALE: Final = 10 * POSITION_SCALE
MOST_LATENCY_S: Final = 0.3
"""Loop latencies up to this are compensated; of longer ones, so much."""


class PredictiveLqr(LawController):
    """See the module. Memory: the estimate (8 rows), and the last commands (4 rows each), newest first."""

    def __init__(
        self,
        plant: LinearPlant,
        period_s: float,
        effort_weight: Floats | Sequence[float] | float = 1.0,
        *,
        assumed_latency_s: float | None = None,
        compensate: bool = True,
    ) -> None:
        """Design at a pose.

        Args:
            plant: the arm near the pose.
            period_s: of the polls, s.
            effort_weight: what (1 N·m)² costs beside (1°)²; one number, or one a run, (N,).
            assumed_latency_s: takes this loop latency instead of the measured one.
            compensate: False feeds the estimate back as it is, for comparison.

        Raises:
            InputError: a weight is not positive.
        """
        weights = np.atleast_1d(np.asarray(effort_weight, dtype=np.float64))
        if not (np.isfinite(weights).all() and (weights > 0).all()):
            raise InputError("the effort's weight must be a positive number")
        self._phi, self._gamma = plant.discretise(period_s)
        gains = {weight: _feedback(self._phi, self._gamma, weight) for weight in set(weights.tolist())}
        self._feedback = np.stack([gains[weight] for weight in weights.tolist()], axis=2)
        """K, (4, 8, N) or (4, 8, 1)."""
        self._observer = _observer(self._phi, self._gamma)
        self._pose, self._holding = np.array(plant.pose)[:, np.newaxis], np.array(plant.holding)[:, np.newaxis]
        self._period_s = period_s
        self._most = max(1, round(MOST_LATENCY_S / period_s))
        self._assumed = None if assumed_latency_s is None else round(assumed_latency_s / period_s)
        self._compensate = compensate

    def start(self, runs: int) -> Floats:
        """As `LawController`; the estimate is NaN until a position has been seen."""
        return np.vstack([np.full((8, runs), np.nan), np.zeros((4 * (self._most + 1), runs))])

    def law(self, memory: Floats, measured: Measured) -> tuple[Floats, Floats]:
        """As `LawController`."""
        runs = memory.shape[1]
        commands = memory[8:].reshape(self._most + 1, 4, runs)
        delay = self._delay(measured, runs)
        position = measured.position - self._pose
        new = np.isnan(memory[0])
        estimate = np.where(new, np.concatenate([position, np.zeros((4, runs))]), memory[:8])
        acted = np.take_along_axis(commands, np.broadcast_to(delay, (1, 4, runs)), axis=0)[0]
        expected = product(self._phi, estimate) + product(self._gamma, acted)
        corrected = expected + product(self._observer, position - expected[:4])
        estimate = np.where(new, estimate, corrected)
        ahead = estimate
        if self._compensate:
            for age in range(int(delay.max(initial=0)), 0, -1):
                moved = product(self._phi, ahead) + product(self._gamma, commands[age - 1])
                ahead = np.where(delay >= age, moved, ahead)
        goal = np.concatenate([measured.goal - self._pose, np.zeros((4, runs))])
        command = np.add.reduce(self._feedback * (goal - ahead)[np.newaxis], axis=1)
        kept = np.concatenate([command[np.newaxis], commands[:-1]]).reshape(-1, runs)
        return command + self._holding, np.concatenate([estimate, kept])

    def _delay(self, measured: Measured, runs: int) -> NDArray[np.int64]:
        """Loop latency in polls, (N,), at least one: a state can't be answered within its own step."""
        if self._assumed is not None:
            return np.full(runs, min(max(self._assumed, 1), self._most), dtype=np.int64)
        polls = np.rint(measured.latency_s / self._period_s).astype(np.int64)
        return np.asarray(np.clip(polls, 1, self._most), dtype=np.int64)


def product(matrix: Floats, columns: Floats) -> Floats:
    """matrix @ columns, summed in an order that does not depend on the number of columns, as BLAS's does."""
    total = matrix[:, :1] * columns[0]
    for index in range(1, columns.shape[0]):
        total = total + matrix[:, index : index + 1] * columns[index]
    return np.asarray(total, dtype=np.float64)


def _feedback(phi: Floats, gamma: Floats, effort_weight: float) -> Floats:
    q = np.diag(np.concatenate([POSITION_SCALE, VELOCITY_SCALE]) ** -2.0)
    r = np.eye(4) * effort_weight
    p = solve_discrete_are(phi, gamma, q, r)
    return np.asarray(np.linalg.solve(r + gamma.T @ p @ gamma, gamma.T @ p @ phi), dtype=np.float64)


def _observer(phi: Floats, gamma: Floats) -> Floats:
    """Steady-state Kalman gain, (8, 4): disturbing efforts of 0.1 N·m, positions good to a tenth of a degree."""
    process = gamma @ gamma.T * 0.01 + np.eye(8) * 1e-12
    noise = np.diag((0.1 * POSITION_SCALE) ** 2)
    see = np.hstack([np.eye(4), np.zeros((4, 4))])
    p = solve_discrete_are(phi.T, see.T, process, noise)
    return np.asarray(np.linalg.solve(see @ p @ see.T + noise, see @ p).T, dtype=np.float64)
