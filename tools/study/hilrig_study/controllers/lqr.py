"""LQR with delay compensation: a state observer and a model-based predictor over the measured loop latency.

State-space form of the Smith predictor (1957). A served position is d polls old when the torque computed from it acts.
The observer estimates the state at the time of the position, the last d commands propagate the estimate to the time at
which the new command acts, and the state feedback of the undelayed loop is applied to the result. d is the loop latency
in the extended register map, in polls, so the predictor adapts to a changing latency.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.control_laws import LawController, Measurement
from hilrig_study.linear_model import LinearPlant, fixed_order_product

Floats = NDArray[np.float64]

POSITION_SCALE: Final = np.array([np.radians(1.0), np.radians(1.0), 1e-3, np.radians(1.0)])
"""Position error of weight 1: 1° or 1 mm."""
VELOCITY_SCALE: Final = 10 * POSITION_SCALE
MAX_COMPENSATED_LATENCY_S: Final = 0.3
"""Upper limit of the compensated loop latency, s; a longer latency is compensated by this amount."""


class PredictiveLqr(LawController):
    """LQR with observer and predictor.

    Memory: the state estimate (8 rows) and the last commands (4 rows each), newest first.
    """

    def __init__(
        self,
        plant: LinearPlant,
        period_s: float,
        effort_weight: Floats | Sequence[float] | float = 1.0,
        *,
        compensate: bool = True,
    ) -> None:
        """Design the feedback and the observer at a pose.

        Args:
            plant: linear model of the arm near the pose.
            period_s: poll period, s.
            effort_weight: weight of (1 N·m)² relative to (1°)²: one number, or one per run, (N,).
            compensate: False applies the feedback to the estimate without prediction, for comparison.

        Raises:
            InputError: an effort weight is not positive.
        """
        weights = np.atleast_1d(np.asarray(effort_weight, dtype=np.float64))
        if not (np.isfinite(weights).all() and (weights > 0).all()):
            raise InputError(f"effort weight: must be a positive number, got {effort_weight}")
        self._phi, self._gamma = plant.discretize(period_s)
        gains = {weight: _feedback(self._phi, self._gamma, weight) for weight in set(weights.tolist())}
        self._feedback = np.stack([gains[weight] for weight in weights.tolist()], axis=2)
        """K, (4, 8, N) or (4, 8, 1)."""
        self._observer = _observer(self._phi, self._gamma)
        self._pose, self._holding = np.array(plant.pose)[:, np.newaxis], np.array(plant.holding)[:, np.newaxis]
        self._period_s = period_s
        self._max_delay = max(1, round(MAX_COMPENSATED_LATENCY_S / period_s))
        self._compensate = compensate

    def start(self, runs: int) -> Floats:
        """Implement `LawController.start`; the estimate is NaN until the first position is read."""
        return np.vstack([np.full((8, runs), np.nan), np.zeros((4 * (self._max_delay + 1), runs))])

    def law(self, memory: Floats, measured: Measurement) -> tuple[Floats, Floats]:
        """Implement `LawController.law`."""
        runs = memory.shape[1]
        commands = memory[8:].reshape(self._max_delay + 1, 4, runs)
        # A command acts at the tick after its state or later, so the loop latency is at least one poll.
        polls = np.rint(measured.latency_s / self._period_s).astype(np.int64)
        delay = np.clip(polls, 1, self._max_delay)
        position = measured.position - self._pose
        new = np.isnan(memory[0])
        estimate = np.where(new, np.concatenate([position, np.zeros((4, runs))]), memory[:8])
        delayed = np.take_along_axis(commands, np.broadcast_to(delay, (1, 4, runs)), axis=0)[0]
        expected = fixed_order_product(self._phi, estimate) + fixed_order_product(self._gamma, delayed)
        corrected = expected + fixed_order_product(self._observer, position - expected[:4])
        estimate = np.where(new, estimate, corrected)
        predicted = estimate
        if self._compensate:
            for age in range(int(delay.max(initial=0)), 0, -1):
                moved = fixed_order_product(self._phi, predicted) + fixed_order_product(self._gamma, commands[age - 1])
                predicted = np.where(delay >= age, moved, predicted)
        goal = np.concatenate([measured.goal - self._pose, np.zeros((4, runs))])
        command = np.add.reduce(self._feedback * (goal - predicted)[np.newaxis], axis=1)
        kept = np.concatenate([command[np.newaxis], commands[:-1]]).reshape(-1, runs)
        return command + self._holding, np.concatenate([estimate, kept])


def _feedback(phi: Floats, gamma: Floats, effort_weight: float) -> Floats:
    q = np.diag(np.concatenate([POSITION_SCALE, VELOCITY_SCALE]) ** -2.0)
    r = np.eye(4) * effort_weight
    p = solve_discrete_are(phi, gamma, q, r)
    return np.asarray(np.linalg.solve(r + gamma.T @ p @ gamma, gamma.T @ p @ phi), dtype=np.float64)


def _observer(phi: Floats, gamma: Floats) -> Floats:
    """Steady-state Kalman gain, (8, 4), for 0.1 N·m of process noise and 0.1° or 0.1 mm of measurement noise."""
    process = gamma @ gamma.T * 0.01 + np.eye(8) * 1e-12
    noise = np.diag((0.1 * POSITION_SCALE) ** 2)
    output = np.hstack([np.eye(4), np.zeros((4, 4))])
    p = solve_discrete_are(phi.T, output.T, process, noise)
    return np.asarray(np.linalg.solve(output @ p @ output.T + noise, output @ p).T, dtype=np.float64)
