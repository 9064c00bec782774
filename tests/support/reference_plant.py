"""Event-driven reference of the arm: scipy's DOP853 with root finding for impacts and for stops that cease to push.

Independent of the plant: equations (25)–(39) with the mass matrix, and the stops as a complementarity problem that is
solved by trying each set of pushing stops.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hilrig_sim.arm.model import GRAVITY, ArmParameters

RTOL, ATOL = 1e-10, 1e-12


@dataclass
class _Event:
    """A zero of a function of the state that ends an integration: an impact at a limit, or a released joint."""

    function: Callable[[np.ndarray], float]
    direction: float
    joint: int
    limit: float | None = None
    terminal: bool = True

    def __call__(self, _: float, y: np.ndarray) -> float:
        return self.function(y)


class ReferenceArm:
    """One arm, advanced by steps with constant efforts."""

    def __init__(self, arm: ArmParameters, payload: float = 0.0) -> None:
        self.arm, self.payload = arm, payload
        self.impacts: list[tuple[int, bool, float]] = []
        """Joint 1 to 4, whether the stop is the upper one, and speed of each impact of the last step."""

    def mass(self, theta2: float) -> np.ndarray:
        """Mass matrix of joints 1 and 2."""
        arm = self.arm
        total = arm.masses[1] + arm.masses[2] + self.payload
        c = total * np.cos(theta2) * arm.l2 * arm.l3
        a11, a12, a22 = arm.l2**2 * (arm.masses[0] + total) + c, c + total * arm.l3**2, total * arm.l3**2
        return np.array([[a11 + a12, a12], [a12, a22]])

    def plane_force(self, q: np.ndarray, v: np.ndarray, effort: np.ndarray) -> np.ndarray:
        """τ - k of joints 1 and 2."""
        arm = self.arm
        s = np.sin(q[1]) * (arm.masses[1] + arm.masses[2] + self.payload) * arm.l2 * arm.l3
        k1 = -arm.external_torque_z - s * (2 * v[0] * v[1] + v[1] ** 2) + arm.friction[0] * v[0]
        k2 = -arm.external_torque_z + s * v[0] ** 2 + arm.friction[1] * v[1]
        return effort[:2] - np.array([k1, k2])

    def _accelerations(self, y: list[float], effort: list[float], held: tuple[int, ...]) -> tuple[float, float]:
        """Accelerations of joints 1 and 2 in the state (q1, q2, v1, v2): plain numbers, for speed."""
        arm, (_, theta2, v1, v2) = self.arm, y
        total = arm.masses[1] + arm.masses[2] + self.payload
        c, s = (total * arm.l2 * arm.l3 * f(theta2) for f in (math.cos, math.sin))
        a12, a22 = c + total * arm.l3**2, total * arm.l3**2
        alpha = arm.l2**2 * (arm.masses[0] + total) + c + a12
        f1 = effort[0] + arm.external_torque_z + s * (2 * v1 * v2 + v2**2) - arm.friction[0] * v1
        f2 = effort[1] + arm.external_torque_z - s * v1**2 - arm.friction[1] * v2
        if held:
            return (0.0, f2 / a22) if held == (0,) else (f1 / alpha, 0.0) if held == (1,) else (0.0, 0.0)
        determinant = alpha * a22 - a12 * a12
        return (a22 * f1 - a12 * f2) / determinant, (alpha * f2 - a12 * f1) / determinant

    def step(
        self, q: np.ndarray, v: np.ndarray, effort: np.ndarray, duration: float, upper3: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity, (4,) each, after `duration`; `upper3`: d3 of the surface below the tool."""
        self.impacts = []
        q, v = np.array(q, dtype=float), np.array(v, dtype=float)
        q[:2], v[:2] = self._plane(q[:2], v[:2], effort, duration)
        arm = self.arm
        mass3 = arm.masses[2] + self.payload
        force3 = effort[2] - arm.external_force_z + GRAVITY * mass3
        for joint, mass, force in ((2, mass3, force3), (3, arm.j4, effort[3] + arm.external_torque_z)):
            upper = arm.upper[joint] if joint == 3 or upper3 is None else upper3
            q[joint], v[joint] = self._linear(
                joint, q[joint], v[joint], force / mass, arm.friction[joint] / mass, upper, duration
            )
        return q, v

    def _linear(
        self, joint: int, q: float, v: float, c: float, rate: float, upper: float, left: float
    ) -> tuple[float, float]:
        lower = self.arm.lower[joint]
        while left > 0:
            side = int(q >= upper) - int(q <= lower)
            if side * v > 0:
                self.impacts.append((joint + 1, side > 0, abs(v)))
                v = 0.0
            if side and v == 0 and side * c > 0:
                return q, 0.0

            def position(t: float, start: tuple[float, float] = (q, v)) -> float:
                q, v = start
                if rate == 0:
                    return q + v * t + c / 2 * t * t
                return q + c / rate * t - (v - c / rate) * math.expm1(-rate * t) / rate

            # Up to a turning point and from it on, the position is monotonic, so no root is missed.
            turn = (-v / c if rate == 0 else math.log1p(-rate * v / c) / rate) if v * c < 0 else left
            until = min(turn, left)
            end = position(until)
            limit = upper if end > upper else lower if end < lower else None
            time = until if limit is None else brentq(lambda t, limit=limit: position(t) - limit, 0, until, xtol=1e-15)
            q = position(time) if limit is None else limit
            v = (
                0.0
                if limit is None and turn < left
                else c / rate + (v - c / rate) * math.exp(-rate * time)
                if rate
                else v + c * time
            )
            left -= time
        return q, v

    def _plane(self, q: np.ndarray, v: np.ndarray, effort: np.ndarray, left: float) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = np.array(self.arm.lower[:2]), np.array(self.arm.upper[:2])
        free, efforts = [False, False], effort.tolist()
        for _ in range(1000):
            # The impacts of two joints in a corner follow each other ever faster: they end with both at rest.
            for limit in (lower, upper):
                rests = (np.abs(q - limit) < 1e-8) & (np.abs(v) < 1e-3)
                q, v = np.where(rests, limit, q), np.where(rests, 0.0, v)
            side = (q >= upper).astype(float) - (q <= lower)
            for joint in np.flatnonzero(side * v > 1e-12):
                self.impacts.append((int(joint) + 1, bool(side[joint] > 0), abs(float(v[joint]))))
            v, _ = self._complementary(self.mass(q[1]), v, side)
            if left <= 0:
                return q, v
            v[(side != 0) & (np.abs(v) < 1e-12)] = 0.0
            resting = np.where((v == 0) & ~np.array(free), side, 0.0)
            acceleration = np.linalg.solve(self.mass(q[1]), self.plane_force(q, v, effort))
            _, held = self._complementary(self.mass(q[1]), acceleration, resting)
            free = [False, False]

            def reaction(y: np.ndarray, joint: int, held: tuple[int, ...] = held) -> float:
                m, f = self.mass(y[1]), self.plane_force(y[:2], y[2:], effort)
                return float(f[joint] - (m @ self._accelerations(y.tolist(), efforts, held))[joint])

            def release(y: np.ndarray, joint: int, sign: float) -> float:
                return sign * reaction(y, joint)

            def distance(y: np.ndarray, joint: int, limit: float) -> float:
                return float(y[joint]) - limit

            def derivatives(_: float, y: np.ndarray, held: tuple[int, ...] = held) -> list[float]:
                return [*y[2:].tolist(), *self._accelerations(y.tolist(), efforts, held)]

            events: list[_Event] = []
            for number in (0, 1):
                if number in held:
                    events.append(_Event(partial(release, joint=number, sign=side[number]), -1.0, number))
                else:
                    # A joint that starts at its stop must not be found there.
                    high, low = float(upper[number]), float(lower[number])
                    events.append(_Event(partial(distance, joint=number, limit=high + 1e-12), 1.0, number, high))
                    events.append(_Event(partial(distance, joint=number, limit=low - 1e-12), -1.0, number, low))
            run = solve_ivp(
                derivatives,
                (0, left),
                np.concatenate([q, v]),
                method="DOP853",
                rtol=RTOL,
                atol=ATOL,
                events=events,
                max_step=0.0005 if np.minimum(q - lower, upper - q).min() < 0.3 else np.inf,
            )
            q, v = run.y[:2, -1].copy(), run.y[2:, -1].copy()
            left = left - run.t[-1] if run.status == 1 else 0.0
            assert run.t_events is not None
            for found, event in zip(run.t_events, events, strict=True):
                if found.size and event.limit is not None:
                    q[event.joint] = event.limit
                elif found.size:
                    free[event.joint] = True
        raise AssertionError("the reference found no end of the step")

    @staticmethod
    def _complementary(mass: np.ndarray, rate: np.ndarray, side: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
        """Return the rates where stops push inward only and no joint moves outward, and the joints that they push."""
        contacts = [joint for joint in (0, 1) if side[joint]]
        for number in range(len(contacts) + 1):
            for chosen in itertools.combinations(contacts, number):
                push = np.zeros(2)
                if chosen:
                    inverse = np.linalg.inv(mass)
                    index = list(chosen)
                    push[index] = np.linalg.solve(inverse[np.ix_(index, index)], -rate[index])
                after = rate + np.linalg.solve(mass, push)
                after[list(chosen)] = 0.0
                if np.all(side * push <= 0) and np.all(side * after <= 1e-12):
                    return after, chosen
        raise AssertionError("no solution")
