"""The arm near a pose, at rest, as a linear system: exact in continuous time, and as a step of the simulation sees it.

At rest all that is quadratic in the velocities vanishes, and what gravity and the environment ask for is balanced by
a constant effort. What remains of (25)-(32), (38), (39) is M(q0) q̈ = τ - B q̇, with τ counted from that effort: each
joint is an integrator behind its friction, and joints 1 and 2 are coupled by the mass matrix.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.dynamics import mass_matrix
from hilrig_sim.arm.integrators import TABLEAUS
from hilrig_sim.arm.model import GRAVITY, ArmParameters, Vector4

Floats = NDArray[np.float64]

EXACT: Final = "exact"
"""Discretisation by the matrix exponential; else the name of one of the simulation's integrators."""


@dataclass(frozen=True, slots=True)
class LinearPlant:
    """ẋ = A x + B u, x = (q, q̇) less (pose, 0), u = τ less the effort that holds the pose; SI units."""

    a: Floats
    """(8, 8)."""
    b: Floats
    """(8, 4)."""
    pose: Vector4
    """rad, rad, m, rad."""
    holding: Vector4
    """Effort that holds the arm at the pose; N·m, N·m, N, N·m."""

    def discretise(self, step_s: float, method: str = EXACT, substeps: int = 1) -> tuple[Floats, Floats]:
        """Φ (8, 8) and Γ (8, 4) of x(k+1) = Φ x(k) + Γ u(k), u held over `step_s`.

        Args:
            step_s: length of the step, s.
            method: "exact", the matrix exponential of the arm with its friction; or an integrator of the simulation,
                whose stages applied to a linear system give the matrices that it really steps with.
            substeps: integration steps in a step, of an integrator.

        Raises:
            InputError: no such method.
        """
        if method == EXACT:
            whole = np.zeros((12, 12))
            whole[:8, :8], whole[:8, 8:] = self.a, self.b
            exponential = expm(whole * step_s)
            return exponential[:8, :8], exponential[:8, 8:]
        if method not in TABLEAUS:
            raise InputError(f"no discretisation is called {method!r}; there are {EXACT}, {', '.join(TABLEAUS)}")
        tableau, h = TABLEAUS[method], step_s / substeps
        stages: list[Floats] = []
        start = np.hstack([np.eye(8), np.zeros((8, 4))])
        for row in tableau.a:
            state = start + h * sum((w * k for w, k in zip(row, stages, strict=True)), np.zeros((8, 12)))
            stages.append(self.a @ state + np.hstack([np.zeros((8, 8)), self.b]))
        one = start + h * sum((w * k for w, k in zip(tableau.b, stages, strict=True)), np.zeros((8, 12)))
        phi, gamma = one[:, :8], one[:, 8:]
        total_phi, total_gamma = phi, gamma
        for _ in range(substeps - 1):
            total_phi, total_gamma = phi @ total_phi, phi @ total_gamma + gamma
        return total_phi, total_gamma


def holding_effort(arm: ArmParameters, payload: float = 0.0) -> Vector4:
    """Effort that keeps the arm where it is against gravity and the environment's wrench; N·m, N·m, N, N·m."""
    lift = arm.external_force_z - (arm.masses[2] + payload) * GRAVITY
    return (-arm.external_torque_z, -arm.external_torque_z, lift, -arm.external_torque_z)


def linearise(arm: ArmParameters, pose: Sequence[float], *, payload: float = 0.0, coupled: bool = True) -> LinearPlant:
    """The arm near `pose` (rad, rad, m, rad), at rest.

    Args:
        arm: its parameters.
        pose: q0, (4,), within the stops.
        payload: m4, what the magnet holds, kg.
        coupled: False takes the diagonal of M(q0) alone, each joint by itself as many controllers are designed.

    Raises:
        InputError: the pose is not within the stops, where the arm is not linear.
    """
    if len(pose) != 4:
        raise InputError(f"a pose has four joints, found {len(pose)} numbers")
    for name, low, value, high in zip(("theta1", "theta2", "d3", "theta4"), arm.lower, pose, arm.upper, strict=True):
        if not low < value < high:
            raise InputError(f"the pose's {name} = {value:g} is not between its stops, {low:g} and {high:g} (rad, m)")
    mass = mass_matrix(arm, pose[1], payload)
    if not coupled:
        mass = np.diag(np.diag(mass))
    inverse = np.linalg.inv(mass)
    a, b = np.zeros((8, 8)), np.zeros((8, 4))
    a[:4, 4:] = np.eye(4)
    a[4:, 4:] = -inverse @ np.diag(arm.friction)
    b[4:] = inverse
    first, second, third, fourth = map(float, pose)
    return LinearPlant(a, b, (first, second, third, fourth), holding_effort(arm, payload))
