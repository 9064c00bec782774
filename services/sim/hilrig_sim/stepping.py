"""One fixed step of an explicit Runge–Kutta method for N rigs, with nothing allocated.

Only the joint velocities and θ2 enter the right-hand side, so the stages are taken for these five quantities, and the
positions are sums of the stages' velocities: the same method on fewer rows. Each sum over stages is one product and
one reduction along the first axis, whose order of additions is the same for any number of rigs.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.dynamics import STAGE_ROWS, ReducedDynamics, StageViews, stage_views
from hilrig_sim.integrators import Tableau

Floats = NDArray[np.float64]


class FixedStep:
    """Steps `dynamics` by `length`: seconds, one number or one for each rig, (N,)."""

    def __init__(self, dynamics: ReducedDynamics, tableau: Tableau, length: float | Floats) -> None:
        count, stages = dynamics.count, tableau.stages
        self._dynamics = dynamics
        lengths = np.broadcast_to(np.asarray(length, dtype=np.float64), (count,)) if np.ndim(length) else length
        # Slot 0 holds the state at the step's start, slot i the rates of stage i.
        self._slots = np.zeros((1 + stages, STAGE_ROWS, count))
        self._states = np.zeros((stages, STAGE_ROWS, count))
        self._products = np.empty((1 + stages, STAGE_ROWS, count))
        self._drive = np.empty((4, count))
        self._start_velocity, self._start_theta2 = self._slots[0, :4], self._slots[0, 4]
        self._first = self._states[0]
        self._start = self._slots[0]

        def coefficients(weights: tuple[float, ...]) -> Floats:
            scaled = [np.asarray(w * lengths) * np.ones(count if np.ndim(lengths) else 1) for w in weights]
            return np.array(scaled)[:, np.newaxis, :]

        def with_start(weights: tuple[float, ...]) -> Floats:
            scaled = coefficients(weights)
            return np.concatenate([np.ones((1, 1, scaled.shape[2])), scaled])

        self._stages: list[StageViews] = [stage_views(self._states[i], self._slots[1 + i]) for i in range(stages)]
        self._combinations = [
            (self._slots[: 1 + i], with_start(tableau.a[i]), self._products[: 1 + i], self._states[i])
            for i in range(1, stages)
        ]
        self._final = (self._slots[:, :4], with_start(tableau.b), self._products[:, :4])
        velocities, products = self._states[:, :4], self._products[:stages, :4]
        self._quadrature = (velocities, coefficients(tableau.b), products)
        self._error = (velocities, coefficients(tableau.error_weights), products) if tableau.embedded else None
        self._change = np.empty((4, count))

    def advance(
        self,
        position: Floats,
        velocity: Floats,
        effort: Floats,
        error: Floats | None = None,
        multiply: Any = np.multiply,
        add: Any = np.add,
        total: Any = np.add.reduce,
    ) -> None:
        """Move `position` and `velocity`, (4, N), on by one step under constant `effort`, (4, N).

        `error`, (4, N), gets the embedded estimate of the position's error; a method without one leaves it.
        """
        dynamics, drive = self._dynamics, self._drive
        dynamics.drive(effort, drive)
        self._start_velocity[:] = velocity
        self._start_theta2[:] = position[1]
        self._first[:] = self._start
        rates = dynamics.rates
        stages = self._stages
        rates(stages[0], drive)
        following = iter(stages)
        next(following)
        for (slots, weights, products, state), stage in zip(self._combinations, following, strict=True):
            multiply(slots, weights, out=products)
            total(products, axis=0, out=state)
            rates(stage, drive)
        values, weights, products = self._quadrature
        multiply(values, weights, out=products)
        total(products, axis=0, out=self._change)
        add(position, self._change, out=position)
        if error is not None and self._error is not None:
            values, weights, products = self._error
            multiply(values, weights, out=products)
            total(products, axis=0, out=error)
        values, weights, products = self._final
        multiply(values, weights, out=products)
        total(products, axis=0, out=velocity)

    def accelerations(self, position: Floats, velocity: Floats, effort: Floats) -> Floats:
        """Joint accelerations, (4, N), at a state and under an effort, (4, N) each; valid until the next call."""
        self._dynamics.drive(effort, self._drive)
        self._states[0, :4] = velocity
        self._states[0, 4] = position[1]
        self._dynamics.rates(self._stages[0], self._drive)
        return self._slots[1, :4]
