"""Fixed step of an explicit Runge–Kutta method for N rigs, without memory allocation.

The right-hand side depends on the joint velocities and θ2 only, so the stages have these five quantities, and the
positions are weighted sums of the stage velocities: the same method with fewer rows. Each sum over stages is one
product and one reduction along the first axis, whose order of additions is the same for any number of rigs.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.dynamics import STAGE_ROWS, ReducedDynamics, StageViews, stage_views
from hilrig_sim.arm.integrators import Tableau

Floats = NDArray[np.float64]


MAX_RIGS_WITH_OWN_WEIGHTS: Final = 64
"""Up to this number of rigs, each has its own copy of the weights, which saves the cost of broadcasting."""


@cache
def _packed(tableau: Tableau) -> tuple[Floats, Floats]:
    """Return the weights of all sums of a step, (terms, 1, 1): a constant part and a part per second of step length.

    First the weights of the stages and of the end state, each preceded by the weight 1 of the start state; then those
    of the position increment and of its error.
    """
    led = [(1.0, row) for row in (*tableau.a[1:], tableau.b)]
    bare = [tableau.b, tableau.error_weights]
    one = [value for lead, row in led for value in (lead, *(0.0 for _ in row))] + [0.0 for row in bare for _ in row]
    scaled = [value for _, row in led for value in (0.0, *row)] + [value for row in bare for value in row]
    return np.array(one)[:, np.newaxis, np.newaxis], np.array(scaled)[:, np.newaxis, np.newaxis]


@dataclass(frozen=True, slots=True)
class _Sum:
    """A weighted sum over stages; `values`, `weights` and `products` are (terms, 5, N), or broadcast to it."""

    values: Floats
    weights: Floats
    products: Floats
    first: Floats
    second: Floats | None = None

    def into(self, out: Floats, multiply: Any = np.multiply, add: Any = np.add, total: Any = np.add.reduce) -> None:
        multiply(self.values, self.weights, self.products)
        if self.second is None:
            out[:] = self.first
        elif len(self.products) == 2:
            add(self.first, self.second, out)
        else:
            total(self.products, 0, None, out)


class FixedStep:
    """Integrates `dynamics` over a step of `length`, s: one number, or one per rig, (N,)."""

    def __init__(self, dynamics: ReducedDynamics, tableau: Tableau, length: float | Floats) -> None:
        count, stages = dynamics.count, tableau.stages
        self.dynamics = dynamics
        lengths = np.asarray(length, dtype=np.float64)
        # Slot 0 is the state at the start of the step, slot i the rates of stage i.
        self._slots = np.zeros((1 + stages, STAGE_ROWS, count))
        self._states = np.zeros((stages, STAGE_ROWS, count))
        self._products = np.empty((1 + stages, STAGE_ROWS, count))
        self._drive = np.empty((4, count))
        self._start = self._slots[0]
        self._start_velocity, self._start_theta2 = self._start[:4], self._start[4]
        self._first = self._states[0]
        self._result = np.empty((STAGE_ROWS, count))
        self._result4 = self._result[:4]

        self._one, self._scaled = _packed(tableau)
        rows = STAGE_ROWS if count <= MAX_RIGS_WITH_OWN_WEIGHTS else 1
        columns = count if count <= MAX_RIGS_WITH_OWN_WEIGHTS else lengths.size
        self._table = table = np.empty((len(self._one), rows, columns))
        self.set_length(length)
        used = 0

        def terms(number: int, values: Floats) -> _Sum:
            nonlocal used
            used += number
            products = self._products[:number]
            return _Sum(values[:number], table[used - number : used], products, *products[:2])

        self._stages: list[StageViews] = [stage_views(self._states[i], self._slots[1 + i]) for i in range(stages)]
        self._following = [(terms(1 + i, self._slots), self._states[i], self._stages[i]) for i in range(1, stages)]
        self._end = terms(1 + stages, self._slots)
        self._quadrature = terms(stages, self._states)
        self._error = terms(stages, self._states) if tableau.embedded else None

    def set_length(self, length: float | Floats) -> None:
        """Change the length of the step, s; it has as many numbers as that of the constructor."""
        self._table[:] = self._one + self._scaled * np.asarray(length, dtype=np.float64).reshape(1, -1)

    def advance(self, position: Floats, velocity: Floats, effort: Floats, error: Floats | None = None) -> None:
        """Advance `position` and `velocity`, (4, N), by one step with constant `effort`, (4, N).

        `error`, (4, N), receives the embedded error estimate of the position, if the method has one.
        """
        rates, drive, result, result4 = self.dynamics.rates, self._drive, self._result, self._result4
        self.dynamics.drive(effort, drive)
        self._start_velocity[:] = velocity
        self._start_theta2[:] = position[1]
        self._first[:] = self._start
        rates(self._stages[0], drive)
        for terms, state, stage in self._following:
            terms.into(state)
            rates(stage, drive)
        self._quadrature.into(result)
        np.add(position, result4, position)
        if error is not None and self._error is not None:
            self._error.into(result)
            error[:] = result4
        self._end.into(result)
        velocity[:] = result4

    def accelerations(self, position: Floats, velocity: Floats, effort: Floats) -> Floats:
        """Return the joint accelerations, (4, N), of a state and effort, (4, N) each; valid until the next call."""
        self.dynamics.drive(effort, self._drive)
        self._states[0, :4] = velocity
        self._states[0, 4] = position[1]
        self.dynamics.rates(self._stages[0], self._drive)
        return self._slots[1, :4]
