"""Unit tests of the plant: energy balance, hard stops, independence of the rigs, reproducibility."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.dynamics import ReducedDynamics, mass_matrix
from hilrig_sim.arm.model import GRAVITY, ArmParameters, RigParameters, SceneParameters, StepParameters
from hilrig_sim.plant.hard_stops import stop_outward
from hilrig_sim.plant.limits import PlantEventKind
from hilrig_sim.plant.plant import Plant
from support.recordings import PARAMETERS

ARM = ArmParameters()
# No object below the tool: the quill has its own stops only.
BARE = RigParameters(scene=SceneParameters(table_height=-1.0))
OFF = np.zeros(1, dtype=np.bool_)

speeds = st.tuples(*[st.floats(-6, 6)] * 4)
efforts = st.tuples(*[st.floats(-32.767, 32.767)] * 4)
joints = st.tuples(*(st.floats(low, high) for low, high in zip(ARM.lower, ARM.upper, strict=True)))
masses = st.tuples(*[st.floats(0.05, 5.0)] * 3)


def plant_at(
    position: tuple[float, ...], velocity: tuple[float, ...], rig: RigParameters = BARE, step_ns: int = 20_000_000
) -> Plant:
    plant = Plant([replace(rig, sim=StepParameters(step_ns=step_ns))])
    plant.set_state(0, position, velocity)
    return plant


def energy(plant: Plant) -> float:
    kinetic = plant.dynamics.kinetic_energy(plant.position[1], plant.velocity)[0]
    mass3 = (plant.dynamics.m3 + plant.dynamics.payload)[0]
    return float(kinetic - mass3 * GRAVITY * plant.position[2, 0])


@given(st.floats(-3, 3), masses, st.floats(0, 2.8), st.floats(0.05, 1), st.floats(0.05, 1))
def test_mass_matrix_is_symmetric_and_positive_definite(
    theta2: float, m: tuple[float, float, float], payload: float, l2: float, l3: float
) -> None:
    matrix = mass_matrix(ArmParameters(masses=m, l2=l2, l3=l3), theta2, payload)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert np.all(np.linalg.eigvalsh(matrix) > 0)


@pytest.mark.parametrize("payload", [0.0, 1.2])
def test_energy_balance_with_work_and_friction(payload: float) -> None:
    arm = replace(ARM, friction=(0.4, 0.3, 2.0, 0.02), external_force_z=1.0, external_torque_z=0.1)
    plant = plant_at((-1.0, 0.5, 0.10, 0.0), (0.5, -0.5, 0.0, 1.0), replace(BARE, arm=arm), step_ns=1_000_000)
    plant.dynamics.set_payload(np.array([payload]))
    effort = np.array([[1.5], [-0.8], [-3.8 - payload * GRAVITY], [0.02]])
    drive = effort[:, 0] + np.array([0.1, 0.1, -1.0, 0.1])
    friction = np.array(arm.friction)
    begin, worked = energy(plant), 0.0
    for _ in range(400):
        before_q, before_v = plant.position[:, 0].copy(), plant.velocity[:, 0].copy()
        plant.step(effort, OFF)
        after_v = plant.velocity[:, 0]
        lost = friction * (before_v**2 + before_v * after_v + after_v**2) / 3 * 0.001
        worked += float(drive @ (plant.position[:, 0] - before_q) - lost.sum())
    assert not any(plant.limit_flags)
    assert abs(energy(plant) - begin) > 0.05
    assert energy(plant) - begin == pytest.approx(worked, abs=1e-5)


@given(joints, speeds, st.tuples(*[st.sampled_from([-1.0, 0.0, 1.0])] * 2), st.floats(0, 2))
def test_impact_adds_no_energy_and_leaves_no_outward_motion(
    position: tuple[float, ...], velocity: tuple[float, ...], side: tuple[float, float], payload: float
) -> None:
    dynamics = ReducedDynamics.of(ARM, payload)
    theta2, v = np.array([position[1]]), np.array([velocity]).T
    before = dynamics.kinetic_energy(theta2, v)[0]
    side1, side2 = np.array([side[0]]), np.array([side[1]])
    mass = dynamics.mass_matrix_12(theta2)
    v1, v2, pushed1, pushed2 = stop_outward(v[0], v[1], side1, side2, mass)
    after = v.copy()
    after[0], after[1] = v1, v2
    assert dynamics.kinetic_energy(theta2, after)[0] <= before * (1 + 1e-12)
    assert side[0] * v1[0] <= 1e-12
    assert side[1] * v2[0] <= 1e-12
    # A stop pushes inward only: the change of momentum is along each stop that pushes.
    alpha, a12, a22 = (element[0] for element in mass)
    push = np.array([[alpha, a12], [a12, a22]]) @ (after[:2, 0] - v[:2, 0])
    for j, pushed in ((0, pushed1[0]), (1, pushed2[0])):
        assert push[j] * side[j] <= 1e-9
        assert pushed or abs(push[j]) <= 1e-9


@settings(max_examples=40)
@given(joints, speeds, st.lists(efforts, min_size=1, max_size=6))
def test_no_joint_is_ever_outside_its_limits(
    position: tuple[float, ...], velocity: tuple[float, ...], sequence: list[tuple[float, ...]]
) -> None:
    plant = plant_at(position, velocity)
    for effort in sequence:
        for _ in range(20):
            plant.step(np.array([effort]).T, OFF)
            assert np.all(plant.position[:, 0] >= ARM.lower)
            assert np.all(plant.position[:, 0] <= ARM.upper)
            assert np.all(np.isfinite(plant.velocity))


@settings(max_examples=20)
@given(joints, speeds)
def test_energy_never_increases_without_efforts(position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
    plant = plant_at(position, velocity, step_ns=1_000_000)
    effort = np.zeros((4, 1))
    last = energy(plant)
    for _ in range(300):
        plant.step(effort, OFF)
        now = energy(plant)
        assert now <= last + 1e-6 * (1 + abs(last))
        last = now


def test_joint_stops_at_its_limit_with_event_and_speed() -> None:
    plant = plant_at((2.2, 0.0, 0.1, 0.0), (0.0, 0.0, 0.0, 0.0))
    effort = np.array([[8.0], [0.0], [-0.5 * GRAVITY], [0.0]])
    hits = [event for _ in range(60) for event in tuple(plant.step(effort, OFF))]
    first = next(hit for hit in hits if hit.joint == 1)
    assert (first.kind, first.upper) == (PlantEventKind.LIMIT_HIT, True)
    assert first.speed > 0.1
    assert plant.position[0, 0] == ARM.upper[0]
    assert plant.velocity[0, 0] == 0.0
    assert plant.limit_flags[0] & (1 << 4)
    assert sum(hit.joint == 1 for hit in hits) == 1


def test_joint_at_stop_stays_and_the_other_moves_alone() -> None:
    plant = plant_at((ARM.upper[0], 0.3, 0.1, 0.0), (0.0, 0.0, 0.0, 0.0))
    effort = np.array([[20.0], [0.4], [-0.5 * GRAVITY], [0.0]])
    for _ in range(50):
        plant.step(effort, OFF)
        assert plant.position[0, 0] == ARM.upper[0]
    # a22 θ̈2 = τ2 − b2 θ̇2: with joint 1 held, link 2 is a pendulum without gravity.
    a22 = (ARM.masses[1] + ARM.masses[2]) * ARM.l3**2
    t, b = 1.0, ARM.friction[1]
    expected = 0.3 + 0.4 / b * (t - a22 / b * (1 - np.exp(-b * t / a22)))
    assert plant.position[1, 0] == pytest.approx(expected, abs=1e-6)


def test_joint_leaves_its_stop_under_inward_effort() -> None:
    plant = plant_at((ARM.upper[0], ARM.lower[1], 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    for _ in range(10):
        plant.step(np.array([[-2.0], [2.0], [-5.5], [0.0]]), OFF)
    assert plant.position[0, 0] < ARM.upper[0] - 0.01
    assert plant.position[1, 0] > ARM.lower[1] + 0.01
    assert plant.limit_flags[0] == 1 << 2


def test_impact_time_hardly_depends_on_the_step() -> None:
    def after(step_ns: int) -> np.ndarray:
        plant = plant_at((2.0, 1.0, 0.1, 0.0), (2.5, -1.0, 0.0, 0.0), step_ns=step_ns)
        effort = np.array([[6.0], [0.5], [-0.5 * GRAVITY], [0.0]])
        for _ in range(400_000_000 // step_ns):
            plant.step(effort, OFF)
        assert plant.limit_flags[0] & (1 << 4)
        return plant.position[:2, 0]

    np.testing.assert_allclose(after(20_000_000), after(500_000), atol=2e-3)


@pytest.mark.parametrize("count", [2, 7, 64, 65, 300])
def test_trajectory_is_bit_identical_for_any_number_of_rigs(count: int) -> None:
    rng = np.random.default_rng(count)
    rigs = [
        replace(
            PARAMETERS,
            arm=replace(ARM, masses=tuple(rng.uniform(0.9, 1.5, 3)), friction=tuple(rng.uniform(0.05, 1.5, 4))),
        )
        for _ in range(count)
    ]
    together = Plant(rigs)
    watched = [0, count // 2, count - 1]
    alone = [Plant([rigs[index]]) for index in watched]
    for step in range(75):
        if step % 25 == 0:
            effort = rng.uniform(-6, 6, (4, count))
        effort[2] = rng.uniform(-9, 3)
        magnet = rng.random(count) < 0.5
        together.step(effort, magnet)
        for plant, index in zip(alone, watched, strict=True):
            plant.step(effort[:, index : index + 1].copy(), magnet[index : index + 1])
            for mine, shared in (
                (plant.position, together.position),
                (plant.velocity, together.velocity),
                (plant.error, together.error),
                (plant.world.z, together.world.z),
            ):
                np.testing.assert_array_equal(mine[:, 0], shared[:, index])
            assert plant.limit_flags[0] == together.limit_flags[index]


def test_same_steps_are_bit_identical() -> None:
    def run() -> bytes:
        plant = Plant([PARAMETERS])
        for step in range(300):
            plant.step(np.array([[np.sin(step / 20)], [np.cos(step / 15)], [-5.0], [0.01]]), OFF)
        return plant.position.tobytes() + plant.velocity.tobytes()

    assert run() == run()


def test_substeps_equal_shorter_steps() -> None:
    def after(step_ns: int, substeps: int, steps: int) -> np.ndarray:
        plant = Plant([replace(BARE, sim=StepParameters(step_ns=step_ns, substeps=substeps))])
        for _ in range(steps):
            plant.step(np.array([[1.0], [-0.5], [-4.9], [0.02]]), OFF)
        return plant.position

    np.testing.assert_array_equal(after(20_000_000, 4, 25), after(5_000_000, 1, 100))


def test_quill_without_effort_falls_to_its_stop() -> None:
    plant = plant_at((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    for _ in range(60):
        plant.step(np.zeros((4, 1)), OFF)
    assert plant.position[2, 0] == ARM.upper[2]
    assert plant.limit_flags[0] == 1 << 6


def test_rigs_with_different_steps_are_rejected() -> None:
    with pytest.raises(InputError, match="must have the same step"):
        Plant([BARE, replace(BARE, sim=StepParameters(step_ns=10_000_000))])
    with pytest.raises(InputError, match="at least one rig"):
        Plant([])
