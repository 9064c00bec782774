"""Hard stops: an inelastic impact stops a joint at its limit, and a joint pressed onto its stop stays there.

An impulse acts on the stopped joint alone and couples into the others through the mass matrix (docs/model.md,
decision 4). Where joints 1 and 2 are both at stops, each may push, but none may pull: this is a linear
complementarity problem in two unknowns, and its solution is the velocity nearest to the one before, measured by
kinetic energy, that leaves no joint moving outwards. So an impact never adds energy.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

NEWTON_TURNS: Final = 5

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def stop_outward(
    rate1: Floats, rate2: Floats, side1: Floats, side2: Floats, mass: tuple[Floats, Floats, Floats]
) -> tuple[Floats, Floats, Bools, Bools]:
    """Take the outward motion from joints 1 and 2 that are at a stop.

    The same law holds for velocities (an impact) and for accelerations (a joint that is held).

    Args:
        rate1: velocity or acceleration of joint 1, (N,).
        rate2: the same of joint 2.
        side1: +1 where joint 1 is at its upper stop, -1 at its lower, 0 at none.
        side2: the same of joint 2.
        mass: elements α, a12, a22 of the mass matrix of joints 1 and 2, (N,) each.

    Returns:
        Both rates afterwards, and where each stop pushes.
    """
    alpha, a12, a22 = mass
    out1, out2 = side1 * rate1 > 0, side2 * rate2 > 0
    # With one joint stopped, the other takes up its share: the impulse is along one axis of M⁻¹.
    rate2_if_1 = rate2 + a12 / a22 * rate1
    rate1_if_2 = rate1 + a12 / alpha * rate2
    only1 = out1 & (side2 * rate2_if_1 <= 0)
    only2 = out2 & (side1 * rate1_if_2 <= 0) & ~only1
    both = (out1 | out2) & ~only1 & ~only2
    after1 = np.where(only1 | both, 0.0, np.where(only2, rate1_if_2, rate1))
    after2 = np.where(only2 | both, 0.0, np.where(only1, rate2_if_1, rate2))
    return after1, after2, only1 | both, only2 | both


def crossing(start: Floats, end: Floats, start_rate: Floats, end_rate: Floats, limit: Floats) -> Floats:
    """Share of a step, 0…1, after which a joint first reaches `limit`, from its cubic Hermite interpolant; all (N,).

    The rates are those at the two ends times the step's length. Newton's method, begun where a straight line would
    cross, is at rounding after a few turns; where the interpolant bends away it stays within the step all the same.
    """
    way = end - start
    cubic = start_rate + end_rate - 2 * way
    square = 3 * way - 2 * start_rate - end_rate
    share = np.clip((limit - start) / np.where(way == 0, 1.0, way), 0.0, 1.0)
    for _ in range(NEWTON_TURNS):
        value = ((cubic * share + square) * share + start_rate) * share + start - limit
        slope = (3 * cubic * share + 2 * square) * share + start_rate
        share = np.clip(share - np.where(slope * way > 0, value / np.where(slope == 0, 1.0, slope), 0.0), 0.0, 1.0)
    return share
