"""Closed-form motion of joints 3 and 4, which are linear and decoupled, with impacts at their stops.

Between its stops, such a joint is m q̈ = F - b q̇ with a constant F. Its speed is monotonic, so it reaches a stop either
before its turning point or after it. An impact is inelastic: the joint then stays at the stop if F pushes it outward,
and leaves it otherwise.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.plant.limits import any_true

Floats = NDArray[np.float64]

NEWTON_ITERATIONS: Final = 4
MAX_IMPACTS: Final = 3
"""Impacts within one step: at the first stop, after leaving it at the other one, where the joint then stays."""
_SERIES_BELOW: Final = 1e-3


class LinearMotion(NamedTuple):
    """Joints at the end of a step, and their first impacts; (K,) each."""

    position: Floats
    velocity: Floats
    side: Floats
    """+1 if the joint hit its upper stop, -1 if its lower stop, 0 without impact."""
    speed: Floats
    """Speed of this impact; rad/s or m/s."""


def free_motion(q: Floats, v: Floats, acceleration: Floats, rate: Floats, time: Floats) -> tuple[Floats, Floats]:
    """Return position and velocity after `time`, s, from q and v with q̈ = `acceleration` - `rate` q̇; (K,) each."""
    x = rate * time
    decay = np.expm1(-x)
    small = x < _SERIES_BELOW
    divisor = np.where(small, 1.0, x)
    first = np.where(small, 1 - x * (0.5 - x / 6), -decay / divisor)
    second = np.where(small, 0.5 - x * (1 / 6 - x / 24), (1 - first) / divisor)
    gained = acceleration * time
    return q + time * (v * first + gained * second), v + v * decay + gained * first


def move_between_stops(
    q: Floats, v: Floats, acceleration: Floats, rate: Floats, lower: Floats, upper: Floats, duration: Floats
) -> LinearMotion:
    """Move K joints for `duration`, s; the arguments are those of `free_motion`, and their stops; (K,) each."""
    left = duration.copy()
    q, v = np.minimum(np.maximum(q, lower), upper), v.copy()
    hit_side, hit_speed = np.zeros(q.size), np.zeros(q.size)
    for _ in range(MAX_IMPACTS):
        side = (q >= upper).astype(np.float64) - (q <= lower)
        hit = side * v > 0
        if any_true(hit):
            new = hit & (hit_side == 0)
            np.copyto(hit_side, side, where=new)
            np.copyto(hit_speed, np.abs(v), where=new)
            v[hit] = 0.0
        # A joint that is pushed against its stop stays there.
        moves = (left > 0) & ((v != 0) | (side * acceleration <= 0))
        some = moves.nonzero()[0]
        if not some.size:
            break
        moved = _next_impact(q[some], v[some], acceleration[some], rate[some], lower[some], upper[some], left[some])
        q[some], v[some], left[some] = moved
    return LinearMotion(q, v, hit_side, hit_speed)


def first_impact(
    q: Floats, v: Floats, acceleration: Floats, rate: Floats, lower: Floats, upper: Floats, duration: Floats
) -> tuple[Floats, Floats]:
    """Return `side` and `speed` of the first impact, as in `LinearMotion`; arguments as for `move_between_stops`."""
    q = np.minimum(np.maximum(q, lower), upper)
    end, velocity, _ = _next_impact(q, v, acceleration, rate, lower, upper, duration)
    side = (end >= upper).astype(np.float64) - (end <= lower)
    return np.where(side * velocity > 0, side, 0.0), np.abs(velocity)


def _next_impact(
    q: Floats, v: Floats, acceleration: Floats, rate: Floats, lower: Floats, upper: Floats, left: Floats
) -> tuple[Floats, Floats, Floats]:
    """Move joints to their next impact, or for the time `left`, s; return position, velocity and remaining time."""
    turns = v * acceleration < 0
    at_end, speed_at_end = free_motion(q, v, acceleration, rate, left)
    turn, at_turn, speed_at_turn = left, at_end, speed_at_end
    if any_true(turns):
        until = np.where(turns, -v / np.where(turns, acceleration, 1.0), np.inf)
        damped = turns & (rate > 0)
        until[damped] = np.log1p(rate[damped] * until[damped]) / rate[damped]
        turns &= until < left
        turn = np.minimum(until, left)
        at_turn, speed_at_turn = free_motion(q, v, acceleration, rate, turn)
    # Before its turning point, a joint moves in the direction of its speed, then in that of its acceleration.
    before = np.where(np.where(v != 0, v, acceleration) > 0, at_turn >= upper, at_turn <= lower)
    after = turns & ~before & np.where(acceleration > 0, at_end >= upper, at_end <= lower)
    reaches = before | after
    if not any_true(reaches):
        return at_end, speed_at_end, np.zeros(q.size)
    toward_upper = np.where(after | (v == 0), acceleration, v) > 0
    limit = np.where(toward_upper, upper, lower)
    low, high = np.where(after, turn, 0.0), np.where(after, left, turn)
    begin, end = np.where(after, at_turn, q), np.where(after, at_end, at_turn)
    speed = np.where(after, speed_at_turn, v)
    # Newton's method starts at the crossing of the parabola with this position, speed and end.
    span = high - low
    curvature = (end - begin - speed * span) / np.where(span > 0, span * span, 1.0)
    distance = limit - begin
    root = np.sqrt(np.maximum(speed * speed + 4 * curvature * distance, 0.0))
    divisor = speed + np.where(toward_upper, root, -root)
    time = np.where(reaches, low + 2 * distance / np.where(divisor == 0, np.inf, divisor), left)
    for _ in range(NEWTON_ITERATIONS):
        time = np.minimum(np.maximum(time, low), np.where(reaches, high, left))
        position, speed = free_motion(q, v, acceleration, rate, time)
        time = time - np.where(reaches & (speed != 0), (position - limit) / np.where(speed == 0, 1.0, speed), 0.0)
    return np.where(reaches, limit, at_end), np.where(reaches, speed, speed_at_end), left - time
