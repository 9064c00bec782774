"""Tests of the dynamics against the independent engines MuJoCo and Pinocchio, with the generated URDF."""

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pinocchio
import pytest
from numpy.typing import NDArray

from hilrig_sim.arm import kinematics, newton_euler
from hilrig_sim.arm.dynamics import forward_dynamics
from hilrig_sim.arm.model import ArmParameters, RigParameters, SceneParameters, StepParameters
from hilrig_sim.arm.urdf import POINT_INERTIA, POINT_MASS, urdf
from hilrig_sim.plant.plant import Plant

Floats = NDArray[np.float64]
CASES = 300
TOLERANCE = 1e-7
NOTHING_BELOW = SceneParameters(table_height=-1.0)


def random_arm(rng: np.random.Generator) -> ArmParameters:
    return ArmParameters(
        l1=rng.uniform(0.1, 0.3),
        l2=rng.uniform(0.2, 0.5),
        l3=rng.uniform(0.2, 0.5),
        masses=tuple(rng.uniform(0.2, 3.0, 3)),
        j4=rng.uniform(0.002, 0.02),
        friction=tuple(rng.uniform(0.0, 4.0, 4)),
        external_force_z=rng.uniform(-5, 5),
        external_torque_z=rng.uniform(-1, 1),
    )


def random_state(rng: np.random.Generator, arm: ArmParameters) -> tuple[Floats, Floats, Floats]:
    position = rng.uniform(arm.lower, arm.upper)
    return position, rng.uniform(-4, 4, 4), rng.uniform(-10, 10, 4)


class MuJoCo:
    """Forward dynamics and tool pose by MuJoCo."""

    def __init__(self, arm: ArmParameters) -> None:
        self._arm = arm
        self.model = mujoco.MjModel.from_xml_string(urdf(RigParameters(arm=arm)))
        self.model.opt.gravity[:] = (0, 0, -9.81)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
        self.model.dof_armature[3] = arm.j4
        self._tool = self.model.body("tool").id
        self.data = mujoco.MjData(self.model)

    def hold(self, payload: float) -> None:
        self.model.body_mass[self._tool] = POINT_MASS + payload

    def acceleration(self, position: Floats, velocity: Floats, effort: Floats) -> Floats:
        self.data.qpos[:], self.data.qvel[:], self.data.qfrc_applied[:] = position, velocity, effort
        self.data.xfrc_applied[self._tool] = (0, 0, self._arm.external_force_z, 0, 0, self._arm.external_torque_z)
        mujoco.mj_forward(self.model, self.data)
        return np.array(self.data.qacc)

    def tool(self, position: Floats) -> tuple[Floats, Floats]:
        self.data.qpos[:] = position
        mujoco.mj_forward(self.model, self.data)
        return np.array(self.data.xpos[self._tool]), np.array(self.data.xmat[self._tool]).reshape(3, 3)


class Pinocchio:
    """Forward dynamics, tool pose and Jacobian by Pinocchio."""

    def __init__(self, arm: ArmParameters) -> None:
        self._arm = arm
        self.model: Any = pinocchio.buildModelFromXML(urdf(RigParameters(arm=arm)))
        self.model.armature = np.array([0.0, 0.0, 0.0, arm.j4])
        self.data = self.model.createData()

    def hold(self, payload: float) -> None:
        empty = self.model.inertias[4]
        self.model.inertias[4] = pinocchio.Inertia(POINT_MASS + payload, empty.lever, empty.inertia)

    def acceleration(self, position: Floats, velocity: Floats, effort: Floats) -> Floats:
        pinocchio.forwardKinematics(self.model, self.data, position)
        pose = self.data.oMi[4]
        world = pinocchio.Force(
            np.array([0, 0, self._arm.external_force_z]), np.array([0, 0, self._arm.external_torque_z])
        )
        outside = [pinocchio.Force.Zero() for _ in range(5)]
        outside[4] = pinocchio.SE3(pose.rotation, np.zeros(3)).actInv(world)
        driven = effort - np.array(self._arm.friction) * velocity
        return np.array(pinocchio.aba(self.model, self.data, position, velocity, driven, outside))

    def tool(self, position: Floats) -> tuple[Floats, Floats]:
        pinocchio.forwardKinematics(self.model, self.data, position)
        return self.data.oMi[4].translation.copy(), self.data.oMi[4].rotation.copy()

    def jacobian(self, position: Floats) -> Floats:
        pinocchio.forwardKinematics(self.model, self.data, position)
        jacobian = pinocchio.computeJointJacobian(self.model, self.data, position, 4)
        rotation = self.data.oMi[4].rotation
        return np.vstack([rotation @ jacobian[:3], (rotation @ jacobian[3:])[2:]])


@pytest.mark.parametrize("engine", [MuJoCo, Pinocchio])
def test_both_dynamics_models_equal_the_engine(engine: type[MuJoCo] | type[Pinocchio]) -> None:
    rng = np.random.default_rng(20211209)
    worst_reduced = worst_general = 0.0
    for case in range(CASES):
        if case % 10 == 0:
            arm = random_arm(rng)
            peer = engine(arm)
        payload = rng.uniform(0, 2)
        peer.hold(payload)
        position, velocity, effort = random_state(rng, arm)
        expected = peer.acceleration(position, velocity, effort)
        scale = np.linalg.norm(expected)
        reduced = forward_dynamics(arm, position, velocity, effort, payload)
        links, wrench = newton_euler.scara_links(arm, payload), newton_euler.scara_wrench(arm)
        general = newton_euler.forward_dynamics(links, position, velocity, effort, wrench)
        worst_reduced = max(worst_reduced, float(np.linalg.norm(reduced - expected) / scale))
        worst_general = max(worst_general, float(np.linalg.norm(general - expected) / scale))
    assert worst_reduced <= TOLERANCE
    assert worst_general <= TOLERANCE


def plant_on_a_stop(rng: np.random.Generator, joint: int, step_ns: int) -> tuple[Plant, Any, Floats]:
    """Return a plant with payload and joint 1 or 2 at its upper stop, its Pinocchio model, and an effort."""
    arm, payload = replace(random_arm(rng), external_force_z=0.0, external_torque_z=0.0), rng.uniform(0, 2)
    peer = Pinocchio(arm)
    peer.hold(payload)
    position, velocity, effort = random_state(rng, arm)
    position[joint] = arm.upper[joint]
    plant = Plant([RigParameters(arm=arm, sim=StepParameters(step_ns=step_ns), scene=NOTHING_BELOW)])
    plant.set_state(0, position, velocity)
    plant.dynamics.set_payload(np.array([payload]))
    return plant, peer, effort


@pytest.mark.parametrize("joint", [0, 1])
def test_impact_at_stop_equals_pinocchio_impulse_dynamics(joint: int) -> None:
    rng = np.random.default_rng(1914)
    for _ in range(50):
        plant, peer, effort = plant_on_a_stop(rng, joint, step_ns=1)
        before = plant.velocity[:, 0]
        before[joint] = abs(before[joint])
        along = np.eye(4)[joint : joint + 1]
        expected = pinocchio.impulseDynamics(peer.model, peer.data, plant.position[:, 0], before, along, 0.0, 0.0)
        plant.step(effort[:, np.newaxis], np.array([False]))
        np.testing.assert_allclose(plant.velocity[:, 0], expected, atol=1e-4)


@pytest.mark.parametrize("joint", [0, 1])
def test_joint_pressed_at_stop_equals_locked_joint(joint: int) -> None:
    rng, step_ns, pressed = np.random.default_rng(1687), 100, 0
    for _ in range(50):
        plant, peer, effort = plant_on_a_stop(rng, joint, step_ns)
        position, velocity = plant.position[:, 0].copy(), plant.velocity[:, 0]
        velocity[joint], effort[joint] = 0.0, 60.0
        driven = effort - np.array(plant.rigs[0].arm.friction) * velocity
        free = pinocchio.aba(peer.model, peer.data, position, velocity, driven)
        if free[joint] <= 0:
            continue
        pressed += 1
        others = [one for one in range(4) if one != joint]
        locked = pinocchio.buildReducedModel(peer.model, [joint + 1], position)
        locked.armature = np.array(peer.model.armature)[others]
        before = velocity.copy()
        expected = pinocchio.aba(locked, locked.createData(), position[others], before[others], driven[others])
        plant.step(effort[:, np.newaxis], np.array([False]))
        assert plant.velocity[joint, 0] == 0.0
        found = (plant.velocity[others, 0] - before[others]) / (step_ns * 1e-9)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * float(np.abs(expected).max()))
    assert pressed > 30


def test_reduced_model_equals_recursion_with_point_masses() -> None:
    rng = np.random.default_rng(31)
    for _ in range(CASES):
        arm, payload = random_arm(rng), rng.uniform(0, 2)
        position, velocity, effort = random_state(rng, arm)
        links, wrench = newton_euler.scara_links(arm, payload), newton_euler.scara_wrench(arm)
        general = newton_euler.forward_dynamics(links, position, velocity, effort, wrench)
        np.testing.assert_allclose(
            forward_dynamics(arm, position, velocity, effort, payload), general, rtol=1e-9, atol=1e-9
        )


def test_recursion_with_any_inertia_equals_pinocchio() -> None:
    rng = np.random.default_rng(5)
    for case in range(CASES):
        if case % 10 == 0:
            arm = random_arm(rng)
            model = Pinocchio(arm).model
        links = []
        for index, link in enumerate(newton_euler.scara_links(arm)):
            root = rng.normal(size=(3, 3))
            mass, center, inertia = rng.uniform(0.1, 3), rng.normal(size=3) * 0.1, root @ root.T * 0.01
            links.append(replace(link, mass=mass, center=center, inertia=inertia, friction=0.0))
            model.inertias[index + 1] = pinocchio.Inertia(mass, center, inertia)
        position, velocity, _ = random_state(rng, arm)
        acceleration = rng.uniform(-10, 10, 4)
        expected = pinocchio.rnea(model, model.createData(), position, velocity, acceleration)
        found = newton_euler.inverse_dynamics(links, position, velocity, acceleration)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
        back = newton_euler.forward_dynamics(links, position, velocity, found)
        np.testing.assert_allclose(back, acceleration, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("engine", [MuJoCo, Pinocchio])
def test_tool_pose_equals_the_engine(engine: type[MuJoCo] | type[Pinocchio]) -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        arm = random_arm(rng)
        position, _, _ = random_state(rng, arm)
        x, y, z, yaw = kinematics.forward(arm, position)
        expected_position, rotation = engine(arm).tool(position)
        np.testing.assert_allclose((x, y, z), expected_position, atol=1e-12)
        expected = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
        np.testing.assert_allclose(rotation, expected, atol=1e-12)


def test_jacobian_equals_pinocchio() -> None:
    rng = np.random.default_rng(11)
    for _ in range(20):
        arm = random_arm(rng)
        position, _, _ = random_state(rng, arm)
        np.testing.assert_allclose(kinematics.jacobian(arm, position), Pinocchio(arm).jacobian(position), atol=1e-12)


def test_urdf_has_limits_friction_and_masses_of_the_arm() -> None:
    arm = ArmParameters()
    model = Pinocchio(arm).model
    np.testing.assert_allclose(model.lowerPositionLimit, arm.lower)
    np.testing.assert_allclose(model.upperPositionLimit, arm.upper)
    np.testing.assert_allclose(model.damping, arm.friction)
    assert [model.inertias[i].mass for i in (1, 2, 3, 4)] == [*arm.masses, POINT_MASS]
    assert POINT_INERTIA < 1e-6
