"""General recursive Newton–Euler algorithm, (5)–(16): the reference for tests of the reduced model.

The chain may have any masses, centers of mass and inertia tensors. The outward pass computes velocities and
accelerations from the base to the tool, the inward pass forces and moments back to the base. It is written for clarity,
one arm at a time; the simulation uses `dynamics`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hilrig_sim.arm.model import GRAVITY, ArmParameters

Floats = NDArray[np.float64]

_Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Link:
    """A link and its joint. At joint position 0 its frame is parallel to that of its parent."""

    prismatic: bool
    """Prismatic joint; else revolute."""
    axis: Floats
    """Unit vector of the joint axis, link frame, (3,)."""
    origin: Floats
    """Origin of the link frame in the parent frame at joint position 0, m, (3,)."""
    mass: float
    """kg."""
    center: Floats
    """Center of mass, link frame, m, (3,)."""
    inertia: Floats
    """Inertia tensor about the center of mass, link frame, kg·m², (3, 3)."""
    drive_inertia: float = 0.0
    """Inertia of the joint's drive, which moves with this joint only; kg·m² or kg."""
    friction: float = 0.0
    """Viscous friction, N·m·s or N·s/m, (33)–(39)."""


@dataclass(frozen=True, slots=True)
class Wrench:
    """Wrench of the environment on the tool, at the origin of the last link, in world axes."""

    force: Floats = field(default_factory=lambda: np.zeros(3))
    """N, (3,)."""
    moment: Floats = field(default_factory=lambda: np.zeros(3))
    """N·m, (3,)."""


def scara_links(arm: ArmParameters, payload: float = 0.0) -> tuple[Link, ...]:
    """Return the links: point masses at the distal ends, (17)–(19); the inertia of joint 4 belongs to its drive."""
    m1, m2, m3 = arm.masses
    nothing = np.zeros((3, 3))
    b1, b2, b3, b4 = arm.friction
    return (
        Link(False, _Z, np.array([0.0, 0.0, arm.l1]), m1, np.array([arm.l2, 0.0, 0.0]), nothing, friction=b1),
        Link(False, _Z, np.array([arm.l2, 0.0, 0.0]), m2, np.array([arm.l3, 0.0, 0.0]), nothing, friction=b2),
        Link(True, -_Z, np.array([arm.l3, 0.0, 0.0]), m3, np.zeros(3), nothing, friction=b3),
        Link(False, _Z, np.zeros(3), payload, np.zeros(3), nothing, drive_inertia=arm.j4, friction=b4),
    )


def scara_wrench(arm: ArmParameters) -> Wrench:
    """Return the constant wrench of the arm: f_z along and n_z about world z."""
    return Wrench(arm.external_force_z * _Z, arm.external_torque_z * _Z)


def inverse_dynamics(
    links: Sequence[Link],
    position: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    wrench: Wrench | None = None,
    gravity: float = GRAVITY,
) -> Floats:
    """Return the efforts for a motion, (5)–(16).

    Args:
        links: the chain, n of them, base first.
        position: joint positions q, rad or m, (n,).
        velocity: q̇, (n,).
        acceleration: q̈, (n,).
        wrench: wrench of the environment on the tool; None: none.
        gravity: gravitational acceleration, along negative world z, m/s².

    Returns:
        Joint efforts, N·m or N, (n,).
    """
    q, qd, qdd = (np.asarray(values, dtype=np.float64) for values in (position, velocity, acceleration))
    omega, omega_dot = np.zeros(3), np.zeros(3)
    # Gravity is modeled as an upward acceleration of the base, (20).
    origin_acceleration = np.array([0.0, 0.0, gravity])
    world_from_link = np.eye(3)
    outward: list[tuple[Floats, Floats, Floats, Floats]] = []
    for link, value, rate, second in zip(links, q, qd, qdd, strict=True):
        rotation = np.eye(3) if link.prismatic else _rotation(link.axis, value)
        offset = link.origin + (link.axis * value if link.prismatic else 0.0)
        into = rotation.T
        # (7), (12): acceleration of the new origin as a point of the parent.
        moved = _cross(omega_dot, offset) + _cross(omega, _cross(omega, offset)) + origin_acceleration
        origin_acceleration = into @ moved
        omega, omega_dot = into @ omega, into @ omega_dot
        if link.prismatic:
            # (11), (12).
            origin_acceleration = origin_acceleration + 2 * _cross(omega, link.axis * rate) + link.axis * second
        else:
            # (5), (6).
            omega_dot = omega_dot + _cross(omega, link.axis * rate) + link.axis * second
            omega = omega + link.axis * rate
        # (8)–(10).
        center_acceleration = (
            _cross(omega_dot, link.center) + _cross(omega, _cross(omega, link.center)) + origin_acceleration
        )
        force = link.mass * center_acceleration
        moment = link.inertia @ omega_dot + _cross(omega, link.inertia @ omega)
        world_from_link = world_from_link @ rotation
        outward.append((rotation, offset, force, moment))
    # Reaction of the tool on the environment.
    wrench = wrench or Wrench()
    carried_force, carried_moment = -(world_from_link.T @ wrench.force), -(world_from_link.T @ wrench.moment)
    efforts = np.zeros(len(links))
    for index in range(len(links) - 1, -1, -1):
        link = links[index]
        rotation, offset, force, moment = outward[index]
        # (13), (14): about this link's origin, in its axes.
        here_force = carried_force + force
        here_moment = moment + carried_moment + _cross(link.center, force)
        # (15), (16), with drive inertia and friction of the joint.
        along = here_force if link.prismatic else here_moment
        efforts[index] = along @ link.axis + link.drive_inertia * qdd[index] + link.friction * qd[index]
        # To the parent's origin and axes.
        carried_force = rotation @ here_force
        carried_moment = rotation @ here_moment + _cross(offset, carried_force)
    return efforts


def mass_matrix(links: Sequence[Link], position: ArrayLike) -> Floats:
    """Return the mass matrix M(q), (n, n): its columns are the efforts of unit accelerations, at rest, no gravity."""
    n = len(links)
    still = np.zeros(n)
    columns = [inverse_dynamics(links, position, still, unit, gravity=0.0) for unit in np.eye(n)]
    return np.array(columns).T


def forward_dynamics(
    links: Sequence[Link],
    position: ArrayLike,
    velocity: ArrayLike,
    effort: ArrayLike,
    wrench: Wrench | None = None,
    gravity: float = GRAVITY,
) -> Floats:
    """Return the joint accelerations q̈, (n,), under efforts τ, (n,): M q̈ = τ − inverse dynamics at q̈ = 0."""
    bias = inverse_dynamics(links, position, velocity, np.zeros(len(links)), wrench, gravity)
    driving = np.asarray(effort, dtype=np.float64) - bias
    return np.asarray(np.linalg.solve(mass_matrix(links, position), driving), dtype=np.float64)


def _rotation(axis: Floats, angle: float) -> Floats:
    """Rodrigues' formula, (3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross))


def _cross(a: Floats, b: Floats) -> Floats:
    """Return a × b, (3,); several times as fast as `np.cross` for single vectors."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
