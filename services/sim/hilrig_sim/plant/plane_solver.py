"""Adaptive integration of joints 1 and 2: accuracy, impacts at their stops, and stops that cease to push.

`PlaneSolver.solve` repeats an integration step for those rigs that need more than one step of the Runge–Kutta method.
Each rig proceeds at its own pace: an attempt is accepted, or repeated with a shorter length because its error estimate
is too large, a joint reaches a stop, or a held joint leaves its stop. All operations are element-wise, so the result of
a rig does not depend on the others.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.dynamics import ReducedDynamics
from hilrig_sim.arm.integrators import Tableau
from hilrig_sim.arm.model import ArmParameters
from hilrig_sim.arm.stability import MAX_SUBSTEPS
from hilrig_sim.arm.stepping import FixedStep
from hilrig_sim.plant.hard_stops import first_arrival, stop_outward

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

STEP_TOLERANCE: Final = (math.radians(0.01), math.radians(0.01), 0.01e-3, math.radians(0.01))
"""Largest accepted error estimate of each joint in an integration step: 0.01° or 0.01 mm; rad, rad, m, rad. The error
is smaller than the embedded estimate, except for the fastest motions, where it can be three times as large."""
MAX_ATTEMPTS: Final = 4 * MAX_SUBSTEPS
ARRIVAL_TOLERANCE_RAD: Final = 1e-6
"""A joint that is this near to a stop and moves toward it has reached it, rad."""
_NONE_HELD: Final = np.zeros((2, 1), dtype=np.bool_)
SHORTEST_FRACTION: Final = 1 / 1024
"""Shortest integration step for the sake of accuracy, as a fraction of the duration."""


class Impact(NamedTuple):
    """An impact of a joint at a stop."""

    rig: int
    joint: int
    """0 to 3."""
    upper: bool
    speed: float
    """rad/s or m/s."""


class PlaneSolver:
    """Integrates joints 1 and 2 of rigs of a plant over a duration."""

    def __init__(
        self,
        arms: Sequence[ArmParameters],
        dynamics: ReducedDynamics,
        tableau: Tableau,
        lower: Floats,
        upper: Floats,
        longest_turn: Floats,
        step: float,
    ) -> None:
        """Initialize for N rigs.

        Args:
            arms: of the rigs.
            dynamics: of the rigs.
            tableau: of the Runge–Kutta method.
            lower: lower stops of joints 1 and 2, rad, (2, N).
            upper: upper stops, (2, N).
            longest_turn: largest turn of joint 2 in an integration step, rad; infinity: not limited, (N,).
            step: length of a step of the loop, s.
        """
        self._longest_turn = longest_turn
        # Shorter ones could exceed the largest number of integration steps.
        self._shortest_with_limit = 2 * step / MAX_SUBSTEPS
        self._turn_limited = bool(np.isfinite(longest_turn).any())
        self._arm = arms[0]
        self._dynamics = dynamics
        self._tableau = tableau
        self._lower, self._upper = lower, upper
        self._hits: list[Impact] = []
        self._steppers: dict[int, FixedStep] = {}
        """A stepper for each power of two."""

    def solve(
        self, rigs: Ints, position: Floats, velocity: Floats, effort: Floats, duration: Floats, used: Ints
    ) -> tuple[Floats, Ints, list[Impact]]:
        """Advance `position` and `velocity`, (4, K), of K rigs by `duration`, s, (K,), with constant `effort`, (4, K).

        Rows 2 and 3 are unchanged. `used`, (K,): number of integration steps so far in this step of the loop.

        Returns:
            Sum of the absolute error estimates, rad, (2, K); number of integration steps, (K,); impacts.
        """
        count = rigs.size
        lower, upper = self._lower[:, rigs], self._upper[:, rigs]
        left, pace, planned = duration.copy(), duration.copy(), np.zeros(count)
        errors, steps = np.zeros((2, count)), np.zeros(count, dtype=np.int64)
        impacts: list[Impact] = []
        leaving = np.zeros((2, count), dtype=np.bool_)
        """Held joints that are free after the planned attempt."""
        freed = np.zeros((2, count), dtype=np.bool_)
        active = np.flatnonzero(left > 0)
        for attempt in range(MAX_ATTEMPTS):
            if not active.size:
                break
            # The last rig fills the unused columns of the stepper.
            at = np.concatenate([active, np.full((1 << (active.size - 1).bit_length()) - active.size, active[-1])])
            stepper = self._stepper(at.size)
            dynamics = stepper.dynamics
            dynamics.select(self._dynamics, rigs[at])
            q0, v0, low, high, acting = position[:, at], velocity[:, at], lower[:, at], upper[:, at], effort[:, at]
            side = _sides(q0, v0, low, high)
            held = _NONE_HELD
            if side.any():
                held, rates0 = self._contacts(stepper, q0, v0, low, high, acting, side, freed[:, at])
                for rig, joint, is_upper, speed in self._hits:
                    if rig < active.size:
                        impacts.append(Impact(int(rigs[at[rig]]), joint, is_upper, speed))
                position[:2, active], velocity[:2, active] = q0[:2, : active.size], v0[:2, : active.size]
            # A rig that reaches its bound makes the rest in one integration step.
            last = (used[at] + steps[at] >= MAX_SUBSTEPS - 1) | (attempt == MAX_ATTEMPTS - 1)
            length = np.where(planned[at] > 0, planned[at], np.minimum(pace[at], left[at]))
            length = np.where(last, left[at], length)
            stepper.set_length(length)
            q1, v1, error = q0.copy(), v0.copy(), np.zeros_like(q0)
            stepper.advance(q1, v1, acting, error)
            dynamics.release()
            error = np.abs(error[:2])
            worst = np.maximum(error[0], error[1])
            inaccurate = ~(worst <= STEP_TOLERANCE[0]) & (length > SHORTEST_FRACTION * duration[at])
            shorter = 0.9 * np.sqrt(np.sqrt(STEP_TOLERANCE[0] / np.maximum(worst, 1e-12)))
            if self._turn_limited:
                turn = length * np.maximum(np.abs(v0[1]), np.abs(v1[1])) / self._longest_turn[rigs[at]]
                inaccurate |= (turn > 1) & (length > self._shortest_with_limit)
                shorter = np.minimum(shorter, 0.9 / np.maximum(turn, 1.0))
            # An arrival at a stop within the attempt.
            beyond = np.maximum(q1[:2] - high, low - q1[:2])
            reach = q0[:2] + 2 * length * v0[:2]
            near = (v0[:2] * v1[:2] < 0) & ((reach > high) | (reach < low))
            near = (near | (beyond > ARRIVAL_TOLERANCE_RAD)) & ~(np.abs(beyond) <= ARRIVAL_TOLERANCE_RAD)
            arrival = np.full(near.shape, np.inf)
            if near.any():
                rests = held | ((side != 0) & (v0[:2] == 0))
                arrival[near & rests & (beyond > ARRIVAL_TOLERANCE_RAD)] = 0.5
                near &= ~rests
                joint, column = near.nonzero()
                time = length[column]
                arrival[joint, column] = first_arrival(
                    q0[joint, column],
                    q1[joint, column],
                    time * v0[joint, column],
                    time * v1[joint, column],
                    low[joint, column],
                    high[joint, column],
                )
            # A stop that ceases to push within the attempt.
            cut, loss = arrival, arrival
            if held is not _NONE_HELD and held.any():
                rates1 = stepper.accelerations(q1, v1, acting)
                pushed = np.where(held, side, 0.0)
                mass = dynamics.mass_matrix_12(q1[1])
                pushing = stop_outward(rates1[0], rates1[1], pushed[0], pushed[1], mass)[2:]
                lost = held & ~np.array(pushing) & ~leaving[:, at]
                before, after = side * rates0, side * rates1[:2]
                linear = (before > 0) & (after < 0)
                fraction = np.where(linear, before / np.where(linear, before - after, 1.0), 0.5)
                loss = np.where(lost, np.minimum(np.maximum(fraction, 0.01), 0.99), np.inf)
                cut = np.minimum(arrival, loss)
            cut = np.minimum(cut[0], cut[1])
            shorter = np.minimum(np.maximum(shorter, 0.2), 0.7)
            cut = np.where(inaccurate, np.where(worst < np.inf, shorter, 0.2), cut)
            cut = np.where(last, np.inf, cut)
            accepted = (cut >= 1)[: active.size]
            again = active[~accepted]
            column = np.flatnonzero(~accepted)
            planned[again] = cut[column] * length[column]
            pace[again] = np.where(inaccurate[column], planned[again], pace[again])
            if loss is not arrival:
                leaving[:, again] = (loss[:, column] == cut[column]) & ~inaccurate[column]
            done, column = active[accepted], np.flatnonzero(accepted)
            position[:2, done], velocity[:2, done] = q1[:2, column], v1[:2, column]
            left[done] = np.where(length[column] == left[done], 0.0, left[done] - length[column])
            errors[:, done] += error[:, column]
            steps[done] += 1
            planned[done] = 0.0
            freed[:, done], leaving[:, done] = leaving[:, done], False
            grows = (worst[column] < STEP_TOLERANCE[0] / 16) & (length[column] >= pace[done])
            pace[done] = np.where(grows, 2 * pace[done], pace[done])
            active = active[left[active] > 0]
        np.clip(position[:2], lower, upper, out=position[:2])
        return errors, steps, impacts

    def _contacts(
        self,
        stepper: FixedStep,
        q: Floats,
        v: Floats,
        low: Floats,
        high: Floats,
        effort: Floats,
        side: Floats,
        freed: Bools,
    ) -> tuple[Bools, Floats]:
        """Apply impacts to joints at their stops, and hold those that are pushed against them.

        Returns:
            The held joints, and the accelerations of joints 1 and 2 without their stops, (2, K) each.
        """
        dynamics = stepper.dynamics
        np.copyto(q[:2], np.where(side > 0, high, low), where=side != 0)
        mass = dynamics.mass_matrix_12(q[1])
        outward = side * v[:2] > 0
        self._hits.clear()
        if outward.any():
            for joint, column in np.argwhere(outward).tolist():
                self._hits.append(Impact(column, joint, bool(side[joint, column] > 0), abs(float(v[joint, column]))))
            v[0], v[1], _, _ = stop_outward(v[0], v[1], side[0], side[1], mass)
        rates = stepper.accelerations(q, v, effort)[:2]
        settles = (side * v[:2] < 0) & (v[:2] ** 2 < 2 * ARRIVAL_TOLERANCE_RAD * side * rates)
        if settles.any():
            _settle(v, settles, side, mass)
            rates = stepper.accelerations(q, v, effort)[:2]
        rates = rates.copy()
        resting = np.where((v[:2] == 0) & ~freed, side, 0.0)
        held = np.array(stop_outward(rates[0], rates[1], resting[0], resting[1], mass)[2:])
        dynamics.hold(held[0], held[1], q[1])
        return held, rates

    def _stepper(self, size: int) -> FixedStep:
        if size not in self._steppers:
            self._steppers[size] = FixedStep(ReducedDynamics([self._arm] * size), self._tableau, np.zeros(size))
        return self._steppers[size]


def _settle(velocity: Floats, settles: Bools, side: Floats, mass: tuple[Floats, Floats, Floats]) -> None:
    """Stop joints 1 and 2 that would return to their stop at once: impacts in a corner follow each other ever faster.

    The impulse is that of an impact, so this adds no energy; a joint that rests at its stop stays there.
    """
    alpha, a12, a22 = mass
    moves = (velocity[:2] != 0) | (side == 0)
    v1, v2 = velocity[0].copy(), velocity[1].copy()
    velocity[1] += np.where(settles[0] & moves[1], a12 / a22 * v1, 0.0)
    velocity[0] += np.where(settles[1] & moves[0], a12 / alpha * v2, 0.0)
    velocity[:2][settles] = 0.0


def _sides(position: Floats, velocity: Floats, lower: Floats, upper: Floats) -> Floats:
    """Return +1 where joints 1 and 2 are at their upper stops or arrive there, -1 at their lower stops, else 0."""
    q, v = position[:2], velocity[:2]
    at_upper = (q >= upper) | ((q >= upper - ARRIVAL_TOLERANCE_RAD) & (v > 0))
    at_lower = (q <= lower) | ((q <= lower + ARRIVAL_TOLERANCE_RAD) & (v < 0))
    return at_upper.astype(np.float64) - at_lower
