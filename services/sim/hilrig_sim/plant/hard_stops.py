"""Hard stops: an inelastic impact stops a joint at its limit, and a joint pressed against its stop stays there.

An impulse acts on the stopped joint alone and couples into the others through the mass matrix (docs/model.md,
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
    cubic = start_rate + end_rate - 2 * distance
    square = 3 * distance - 2 * start_rate - end_rate
    fraction = np.clip((limit - start) / np.where(distance == 0, 1.0, distance), 0.0, 1.0)
    for _ in range(NEWTON_ITERATIONS):
        value = ((cubic * fraction + square) * fraction + start_rate) * fraction + start - limit
        slope = (3 * cubic * fraction + 2 * square) * fraction + start_rate
        fraction = np.clip(
            fraction - np.where(slope * distance > 0, value / np.where(slope == 0, 1.0, slope), 0.0), 0.0, 1.0
        )
    return fraction
