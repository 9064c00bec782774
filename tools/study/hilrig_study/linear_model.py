"""Linear model of the arm at rest near a pose: in continuous time, and discretized exactly or by an integrator.

At rest the terms that are quadratic in the velocities vanish, and a constant effort balances gravity and the external
wrench. Equations (25)-(32), (38), (39) reduce to M(q0) q̈ = τ - B q̇, where τ is relative to that effort: each joint is
an integrator with viscous friction, and the mass matrix couples joints 1 and 2.
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
from hilrig_sim.arm.joints import JOINT_NAMES
from hilrig_sim.arm.model import GRAVITY, ArmParameters, Vector4

Floats = NDArray[np.float64]

EXACT: Final = "exact"
"""Method name of discretization by the matrix exponential; the other names are the simulation's integrators."""


@dataclass(frozen=True, slots=True)
class LinearPlant:
    """ẋ = A x + B u with x = (q, q̇) - (pose, 0) and u = τ - holding effort; SI units."""

    a: Floats
    """(8, 8)."""
    b: Floats
    """(8, 4)."""
    pose: Vector4
    """rad, rad, m, rad."""
    holding: Vector4
    """Effort that holds the arm at the pose; N·m, N·m, N, N·m."""

    def discretize(self, step_s: float, method: str = EXACT, substeps: int = 1) -> tuple[Floats, Floats]:
        """Return Φ (8, 8) and Γ (8, 4) of x(k+1) = Φ x(k) + Γ u(k), with u held constant over `step_s`.

        Args:
            step_s: length of the step, s.
            method: "exact" for the matrix exponential, or the name of an integrator of the simulation. The integrator's
                stages applied to the linear system give the matrices that the simulation effectively steps with.
            substeps: integration steps per step; used by integrators only.

        Raises:
            InputError: the method is unknown.
        """
        if method == EXACT:
            block = np.zeros((12, 12))
            block[:8, :8], block[:8, 8:] = self.a, self.b
            exponential = expm(block * step_s)
            return exponential[:8, :8], exponential[:8, 8:]
        if method not in TABLEAUS:
            raise InputError(
                f"unknown discretization method {method!r}: expected one of {EXACT}, {', '.join(TABLEAUS)}"
            )
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


def holding_effort(arm: ArmParameters) -> Vector4:
    """Return the effort that balances gravity and the external wrench at rest; N·m, N·m, N, N·m."""
    lift = arm.external_force_z - arm.masses[2] * GRAVITY
    return (-arm.external_torque_z, -arm.external_torque_z, lift, -arm.external_torque_z)


def linearize(arm: ArmParameters, pose: Sequence[float]) -> LinearPlant:
    """Linearize the arm without a part at rest at q0 = `pose`, (4,), between the stops; rad, rad, m, rad.

    Raises:
        InputError: the pose is at or beyond a stop, where the arm is not linear.
    """
    if len(pose) != 4:
        raise InputError(f"pose: expected four joint positions, got {len(pose)}")
    for name, low, value, high in zip(JOINT_NAMES, arm.lower, pose, arm.upper, strict=True):
        if not low < value < high:
            raise InputError(f"pose: {name} must be between its stops {low:g} and {high:g} (rad or m), got {value:g}")
    inverse = np.linalg.inv(mass_matrix(arm, pose[1]))
    a, b = np.zeros((8, 8)), np.zeros((8, 4))
    a[:4, 4:] = np.eye(4)
    a[4:, 4:] = -inverse @ np.diag(arm.friction)
    b[4:] = inverse
    first, second, third, fourth = map(float, pose)
    return LinearPlant(a, b, (first, second, third, fourth), holding_effort(arm))


def fixed_order_product(matrix: Floats, columns: Floats) -> Floats:
    """Return matrix @ columns, summed in an order that, unlike BLAS's, does not depend on the number of columns."""
    total = matrix[:, :1] * columns[0]
    for index in range(1, columns.shape[0]):
        total = total + matrix[:, index : index + 1] * columns[index]
    return np.asarray(total, dtype=np.float64)
