"""Reduced closed-form dynamics of the arm, for any number of rigs at once.

Point masses at the distal ends (17)–(19), viscous friction (33)–(39), the wrench of the environment and a payload. With
w1 = θ̇1 and w2 = θ̇1 + θ̇2, the speeds of the two links in the world, equations (25)–(31) become

    I1·ẇ1 + p·ẇ2 = Q1,   Q1 = (τ1 − b1θ̇1) − (τ2 − b2θ̇2) + l2 l3 M sinθ2 · w2²
    p·ẇ1 + A22·ẇ2 = Q2,  Q2 = τ2 + n_z − b2θ̇2 − l2 l3 M sinθ2 · w1²

with I1 = l2²(m1+M), A22 = M l3², p = l2 l3 M cosθ2: the same model in fewer operations. Joints 3 and 4 are (32) and
decision 2 of docs/model-decisions.md.

Vectors are (rows, rigs), one row per quantity, so that each operation runs along contiguous memory, and the result of
a rig does not depend on the number of rigs. A step allocates no memory and uses no BLAS: its sums depend on the shape.
Operands have the same shape where that is cheap: for small arrays, broadcasting doubles the time of a numpy operation.
No result overlaps an operand: numpy would copy an array of one element first, and the step of a single rig would take
50 % longer.
"""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.model import GRAVITY, ArmParameters

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

STAGE_ROWS: Final = 5
"""Number of quantities that the right-hand side depends on: four joint velocities and θ2."""


class StageViews(NamedTuple):
    """Views of the state of a stage and its rates, created once: slicing in the step would double its time."""

    velocity: Floats
    v1: Floats
    v2: Floats
    theta2: Floats
    a1: Floats
    a2: Floats
    a34: Floats
    theta2_rate: Floats


def stage_views(state: Floats, rates: Floats) -> StageViews:
    """Return views of a stage: `state`, (5, N), has rows θ̇1, θ̇2, ḋ3, θ̇4, θ2; `rates`, (5, N), their derivatives."""
    return StageViews(state[:4], state[0], state[1], state[4], rates[0], rates[1], rates[2:4], rates[4])


class _Coefficients(NamedTuple):
    """Coefficients of the equations of the two links."""

    coupling_twice: Floats
    """l2 l3 M, for cosθ2 and for sinθ2, (2, N)."""
    inertia: Floats
    """A22 and I1, (2, N)."""
    product: Floats
    """I1 A22, (N,)."""
    p_where_held: Floats | None = None
    """Added to p = l2 l3 M cosθ2 where a joint is held, (N,)."""


class ReducedDynamics:
    """Reduced model of N rigs; the payload changes when a magnet picks or releases a part."""

    def __init__(self, arms: Sequence[ArmParameters]) -> None:
        count = len(arms)
        self.count = count
        self.l2 = np.array([arm.l2 for arm in arms])
        self.l3 = np.array([arm.l3 for arm in arms])
        self.m1, self.m2, self.m3 = (np.array([arm.masses[i] for arm in arms]) for i in range(3))
        self.j4 = np.array([arm.j4 for arm in arms])
        self.friction = np.array([arm.friction for arm in arms]).T.copy()
        self.force_z = np.array([arm.external_force_z for arm in arms])
        self.torque_z = np.array([arm.external_torque_z for arm in arms])
        # Quantities that depend on the payload.
        self._coupling_twice = np.empty((2, count))
        self.coupling = self._coupling_twice[0]
        """l2 l3 M, kg·m², (N,)."""
        self.inertia = np.empty((2, count))
        """A22 = M l3², I1 = l2²(m1+M): each is a factor of the other link's equation."""
        self._a22, self._i1 = self.inertia
        self._free = _Coefficients(self._coupling_twice, self.inertia, np.empty(count))
        self._inverse34 = np.empty((2, count))
        self._offset = np.empty((4, count))
        """Forces and torques of environment and gravity."""
        self._acting = self._holding = self._free
        self._held_key = b""
        """Arguments that `_holding` was computed for; a joint stays pressed against a stop for many steps."""
        # Scratch memory of one evaluation.
        self._force = np.empty((4, count))
        self._force1, self._force2, self._force34 = self._force[0], self._force[1], self._force[2:4]
        self._cos_sin = np.empty((2, count))
        self._cos, self._sin = self._cos_sin
        self._w2 = np.empty(count)
        self._w1_squared, self._w2_squared = np.empty(count), np.empty(count)
        self._pull1, self._pull2 = np.empty(count), np.empty(count)
        self._between = np.empty(count)
        self._q = np.empty((2, count))
        self._q1, self._q2 = self._q
        self._own = np.empty((2, count))
        self._cross = np.empty((2, count))
        self._cross1, self._cross2 = self._cross
        self._numerator = np.empty((2, count))
        self._numerator1, self._numerator2 = self._numerator
        self._p_held = np.empty(count)
        self._p_squared = np.empty(count)
        self._determinant = np.empty(count)
        self._w2_rate = np.empty(count)
        self.set_payload(np.zeros(count))

    @classmethod
    def of(cls, arm: ArmParameters, payload: float = 0.0) -> Self:
        """Return the model of a single rig with a payload, kg."""
        model = cls([arm])
        model.set_payload(np.array([payload]))
        return model

    def select(self, source: "ReducedDynamics", rigs: Ints) -> None:
        """Take the quantities of the equations of motion from rigs of another model, (N,); no joint is held."""
        np.take(source.friction, rigs, 1, self.friction, "clip")
        np.take(source._coupling_twice, rigs, 1, self._coupling_twice, "clip")
        np.take(source.inertia, rigs, 1, self.inertia, "clip")
        np.take(source._free.product, rigs, 0, self._free.product, "clip")
        np.take(source._inverse34, rigs, 1, self._inverse34, "clip")
        np.take(source._offset, rigs, 1, self._offset, "clip")
        self._held_key = b""
        self.release()

    def set_payload(self, payload: Floats) -> None:
        """Set the mass of the held parts, m4 = `payload`, kg, (N,)."""
        mass = self.m2 + self.m3 + payload
        mass3 = self.m3 + payload
        self.payload = payload.copy()
        self._coupling_twice[:] = self.l2 * self.l3 * mass
        self._a22[:] = mass * self.l3 * self.l3
        self._i1[:] = self.l2 * self.l2 * (self.m1 + mass)
        np.multiply(self._a22, self._i1, out=self._free.product)
        self._held_key = b""
        self._inverse34[0] = 1.0 / mass3
        self._inverse34[1] = 1.0 / self.j4
        self._offset[0] = self.torque_z
        self._offset[1] = self.torque_z
        self._offset[2] = GRAVITY * mass3 - self.force_z
        self._offset[3] = self.torque_z

    def release(self) -> None:
        """Release all held joints."""
        self._acting = self._free

    def hold(self, held1: Bools, held2: Bools, theta2: Floats) -> None:
        """Hold joints 1 and 2 without acceleration where they are pressed against a stop, (N,) each, at θ2, (N,).

        The equations have the same form with other coefficients. With θ1 held, they reduce to A22·ẇ2 = Q2. With θ2
        held, both links rotate as one body, α θ̈1 = Q1 + Q2 with α = I1 + 2p + A22; θ2 and p are constant.
        """
        key = held1.tobytes() + held2.tobytes() + np.where(held2, theta2, 0.0).tobytes()
        if key != self._held_key:
            self._held_key = key
            self._holding = self._coefficients_where_held(held1, held2, theta2)
        self._acting = self._holding

    def _coefficients_where_held(self, held1: Bools, held2: Bools, theta2: Floats) -> "_Coefficients":
        only1, only2, both = held1 & ~held2, held2 & ~held1, held1 & held2
        any_held = held1 | held2
        alpha = self._i1 + 2 * (np.cos(theta2) * self.coupling) + self._a22
        # ẇ1 = (A Q1 - p Q2) / (product - p²), ẇ2 = (I Q2 - p Q1) / (product - p²), with A, I, p and product chosen such
        # that the acceleration of a held joint is exactly zero.
        inertia = np.where(only2, alpha, np.where(any_held, 0.0, self.inertia))
        inertia[1][only1] = 1.0
        coupling = self._coupling_twice.copy()
        coupling[0][any_held] = 0.0
        product = np.where(only2, 2 * (alpha * alpha), np.where(only1, self._a22, self._free.product))
        product[both] = 1.0
        return _Coefficients(coupling, inertia, product, np.where(only2, -alpha, 0.0))

    def drive(self, effort: Floats, out: Floats) -> None:
        """Compute the forces and torques that do not depend on the motion, (4, N), from the efforts, (4, N)."""
        np.add(effort, self._offset, out=out)

    def linear_coefficients(self, joint: Ints, rig: Ints, effort: Floats) -> tuple[Floats, Floats]:
        """Return c and r of q̈ = c - r q̇ for joints 3 and 4, `joint` 0 and 1, of rigs, (K,) each, (32)."""
        inverse, row = self._inverse34[joint, rig], joint + 2
        force = effort[row, rig] + self._offset[row, rig]
        return force * inverse, self.friction[row, rig] * inverse

    def rates(
        self,
        stage: StageViews,
        drive: Floats,
        # Default arguments are local names: module attributes would cost two lookups each, 130 times per step.
        add: Any = np.add,
        subtract: Any = np.subtract,
        multiply: Any = np.multiply,
        divide: Any = np.divide,
        cos: Any = np.cos,
        sin: Any = np.sin,
    ) -> None:
        """Compute the derivatives of a stage into its `rates`, (25)–(32), (38), (39); `drive` is (4, N)."""
        velocity, v1, v2, theta2, a1, a2, a34, theta2_rate = stage
        force, force1, force2, force34 = self._force, self._force1, self._force2, self._force34
        cos_sin, p, ps, q1, q2 = self._cos_sin, self._cos, self._sin, self._q1, self._q2
        coupling_twice, inertia, product, p_where_held = self._acting
        multiply(self.friction, velocity, force)
        subtract(drive, force, force)
        multiply(force34, self._inverse34, a34)
        cos(theta2, p)
        sin(theta2, ps)
        multiply(cos_sin, coupling_twice, cos_sin)
        if p_where_held is not None:
            p = add(p, p_where_held, self._p_held)
        w2, w2_squared, pull2 = self._w2, self._w2_squared, self._pull2
        add(v1, v2, w2)
        multiply(w2, w2, w2_squared)
        multiply(w2_squared, ps, pull2)
        w1_squared, pull1, between = self._w1_squared, self._pull1, self._between
        multiply(v1, v1, w1_squared)
        multiply(w1_squared, ps, pull1)
        subtract(force1, force2, between)
        add(between, pull2, q1)
        subtract(force2, pull1, q2)
        p_squared, determinant = self._p_squared, self._determinant
        multiply(p, p, p_squared)
        subtract(product, p_squared, determinant)
        own, cross, w2_rate = self._own, self._cross, self._w2_rate
        multiply(inertia, self._q, own)
        multiply(q2, p, self._cross1)
        multiply(q1, p, self._cross2)
        subtract(own, cross, self._numerator)
        divide(self._numerator1, determinant, a1)
        divide(self._numerator2, determinant, w2_rate)
        subtract(w2_rate, a1, a2)
        theta2_rate[:] = v2

    def mass_matrix_12(self, theta2: Floats) -> tuple[Floats, Floats, Floats]:
        """Return elements α = a11 + a12, a12, a22 of the mass matrix of joints 1 and 2, kg·m², (N,) each, (25)–(27)."""
        p = self.coupling * np.cos(theta2)
        return self._i1 + 2 * p + self._a22, p + self._a22, self._a22

    def kinetic_energy(self, theta2: Floats, velocity: Floats) -> Floats:
        """Return ½ q̇ᵀ M q̇ of each rig, J, (N,), from θ2, (N,), and the joint velocities, (4, N)."""
        alpha, a12, a22 = self.mass_matrix_12(theta2)
        v1, v2, v3, v4 = velocity
        plane = alpha * v1 * v1 + 2 * a12 * v1 * v2 + a22 * v2 * v2
        return np.asarray(0.5 * (plane + (self.m3 + self.payload) * v3 * v3 + self.j4 * v4 * v4))


def mass_matrix(arm: ArmParameters, theta2: float, payload: float = 0.0) -> Floats:
    """Return the mass matrix M(q), (4, 4); diagonal in kg·m², kg·m², kg, kg·m²."""
    alpha, a12, a22 = ReducedDynamics.of(arm, payload).mass_matrix_12(np.array([theta2]))
    matrix = np.zeros((4, 4))
    matrix[:2, :2] = [[alpha[0], a12[0]], [a12[0], a22[0]]]
    matrix[2, 2] = arm.masses[2] + payload
    matrix[3, 3] = arm.j4
    return matrix


def forward_dynamics(
    arm: ArmParameters, position: Floats, velocity: Floats, effort: Floats, payload: float = 0.0
) -> Floats:
    """Return the joint accelerations q̈, (4,), from position, velocity and effort, (4,) each, SI, away from stops."""
    model = ReducedDynamics.of(arm, payload)
    state = np.concatenate([velocity, position[1:2]])[:, np.newaxis]
    rates = np.empty_like(state)
    drive = np.empty((4, 1))
    model.drive(np.asarray(effort, dtype=np.float64)[:, np.newaxis], drive)
    model.rates(stage_views(state, rates), drive)
    return rates[:4, 0]
