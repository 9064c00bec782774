"""Hard stops: an inelastic impact stops a joint at its limit, and a joint pressed against its stop stays there.

An impulse acts on the stopped joint alone and couples into the others through the mass matrix (docs/model-decisions.md,
decision 4). If joints 1 and 2 are both at stops, each stop may push, but not pull: this is a linear
complementarity problem in two unknowns, and its solution is the velocity without outward motion that is nearest to the
velocity before, measured by kinetic energy. So an impact never adds energy.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

NEWTON_ITERATIONS: Final = 5

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def stop_outward(
    rate1: Floats, rate2: Floats, side1: Floats, side2: Floats, mass: tuple[Floats, Floats, Floats]
) -> tuple[Floats, Floats, Bools, Bools]:
    """Remove the outward motion of joints 1 and 2 at their stops.

    The same law applies to velocities (an impact) and to accelerations (a joint pressed against its stop).

    Args:
        rate1: velocity or acceleration of joint 1, (N,).
        rate2: the same of joint 2.
        side1: +1 where joint 1 is at its upper stop, -1 at its lower stop, else 0.
        side2: the same of joint 2.
        mass: elements α, a12, a22 of the mass matrix of joints 1 and 2, (N,) each.

    Returns:
        Both rates after the impact, and where each stop pushes.
    """
    alpha, a12, a22 = mass
    out1, out2 = side1 * rate1 > 0, side2 * rate2 > 0
    # If one joint is stopped, the other gets a fraction of its motion: the impulse is along one axis of M⁻¹.
    rate2_if_1 = rate2 + a12 / a22 * rate1
    rate1_if_2 = rate1 + a12 / alpha * rate2
    only1 = out1 & (side2 * rate2_if_1 <= 0)
    only2 = out2 & (side1 * rate1_if_2 <= 0) & ~only1
    both = (out1 | out2) & ~only1 & ~only2
    after1 = np.where(only1 | both, 0.0, np.where(only2, rate1_if_2, rate1))
    after2 = np.where(only2 | both, 0.0, np.where(only1, rate2_if_1, rate2))
    return after1, after2, only1 | both, only2 | both


def crossing(start: Floats, end: Floats, start_rate: Floats, end_rate: Floats, limit: Floats) -> Floats:
    """Return the fraction of a step, 0…1, after which a joint first reaches `limit`; all (N,).

    The motion is the cubic Hermite interpolant; the rates are those at the two ends times the step length. Newton's
    method starts at the crossing of a straight line and converges to rounding in a few iterations; the result is
    clipped to the step.
    """
    distance = end - start
    line = np.clip((limit - start) / np.where(distance == 0, 1.0, distance), 0.0, 1.0)
    return _crossing_from(line, start, end, start_rate, end_rate, limit)


def _crossing_from(
    fraction: Floats, start: Floats, end: Floats, start_rate: Floats, end_rate: Floats, limit: Floats
) -> Floats:
    """Return the crossing to which Newton's method converges from a fraction of the step."""
    distance = end - start
    cubic = start_rate + end_rate - 2 * distance
    square = 3 * distance - 2 * start_rate - end_rate
    for _ in range(NEWTON_ITERATIONS):
        value = ((cubic * fraction + square) * fraction + start_rate) * fraction + start - limit
        slope = (3 * cubic * fraction + 2 * square) * fraction + start_rate
        fraction = np.clip(
            fraction - np.where(slope * distance > 0, value / np.where(slope == 0, 1.0, slope), 0.0), 0.0, 1.0
        )
    return fraction


def first_arrival(
    start: Floats, end: Floats, start_rate: Floats, end_rate: Floats, lower: Floats, upper: Floats
) -> Floats:
    """Return the fraction of a step after which a joint first reaches a stop, also if it returns before the end.

    The arguments are those of `crossing`; the joint starts between its stops `lower` and `upper`.

    Returns:
        Fractions of the step; infinity where the joint reaches no stop.
    """
    # A joint that turns within the step may reach the stop that it moves toward first; else it may end beyond one.
    turns = start_rate * end_rate < 0
    turning = np.where(turns, _turning_point(start, end, start_rate, end_rate), 1.0)
    farthest = np.where(turns, hermite(start, end, start_rate, end_rate, turning), end)
    toward_upper = np.where(turns, start_rate > 0, end > start)
    limit = np.where(toward_upper, upper, lower)
    before = np.where(toward_upper, farthest > limit, farthest < limit)
    # The cubic up to its turning point is the interpolant with an end rate of zero.
    fraction = turning * crossing(start, farthest, turning * start_rate, np.where(turns, 0.0, end_rate), limit)
    # A joint that first moves away from a stop reaches it when it comes back: Newton's method starts at the end.
    back = np.where(toward_upper, lower, upper)
    after = turns & ~before & np.where(toward_upper, end < back, end > back)
    if after.any():
        returning = _crossing_from(np.ones_like(fraction), start, end, start_rate, end_rate, back)
        fraction = np.where(after, returning, fraction)
    return np.where(before | after, fraction, np.inf)


def hermite(start: Floats, end: Floats, start_rate: Floats, end_rate: Floats, fraction: Floats) -> Floats:
    """Return the cubic Hermite interpolant at a fraction of the step; the arguments are those of `crossing`."""
    distance = end - start
    cubic = start_rate + end_rate - 2 * distance
    square = 3 * distance - 2 * start_rate - end_rate
    return ((cubic * fraction + square) * fraction + start_rate) * fraction + start


def _turning_point(start: Floats, end: Floats, start_rate: Floats, end_rate: Floats) -> Floats:
    """Return the fraction of the step at which the rate of the cubic interpolant changes its sign."""
    distance = end - start
    cubic = 3 * (start_rate + end_rate - 2 * distance)
    square = 3 * distance - 2 * start_rate - end_rate
    root = np.sqrt(np.maximum(square * square - cubic * start_rate, 0.0))
    divisor = np.where(start_rate > 0, root, -root) - square
    fraction = start_rate / np.where(divisor == 0, np.inf, divisor)
    return np.asarray(np.clip(fraction, 0.0, 1.0))
