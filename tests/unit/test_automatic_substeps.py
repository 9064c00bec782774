"""Automatic sub-steps compared with the event-driven reference: accuracy, impacts, and independence of the rigs."""

import json
import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hilrig_sim.accuracy import accuracy_warnings, step_errors
from hilrig_sim.arm.model import ArmParameters, PartParameters, RigParameters, SceneParameters, StepParameters
from hilrig_sim.arm.stability import ERROR_BOUND, MAX_SUBSTEPS, base_substeps
from hilrig_sim.plant.hard_stops import first_arrival
from hilrig_sim.plant.limits import TOOL_CONTACT_FLAG
from hilrig_sim.plant.linear_joints import free_motion, move_between_stops
from hilrig_sim.plant.plant import Plant
from support.labs import hilrig
from support.reference_plant import ReferenceArm

ARM = ArmParameters()
NOTHING_BELOW = SceneParameters(table_height=-1.0)
FULL = 32.767
RIGS = 20


def rig(step_ns: int = 20_000_000, **sim: object) -> RigParameters:
    return RigParameters(sim=StepParameters(step_ns=step_ns, **sim), scene=NOTHING_BELOW)  # type: ignore[arg-type]


def part_below_the_tool(level: int = 0) -> PartParameters:
    """Return a part below the tool of a straight arm, on `level` others."""
    z = 0.03 * level - 0.045
    return PartParameters("abc"[level], "cylinder", (0.04, 0.04, 0.03), 0.2, True, "#808080", (0.6, 0.0, z), 0.0)


def random_efforts(random: np.random.Generator, count: int) -> np.ndarray:
    signs = random.choice((-FULL, FULL), (4, count))
    return np.where(random.random(count) < 0.5, signs, random.uniform(-FULL, FULL, (4, count)))


@pytest.mark.parametrize(("step_ns", "steps"), [(20_000_000, 12), (5_000_000, 10), (1_000_000, 6)])
def test_steps_and_impacts_equal_the_reference(step_ns: int, steps: int) -> None:
    random = np.random.default_rng(step_ns)
    plant, reference = Plant([rig(step_ns)] * RIGS), ReferenceArm(ARM)
    impacts = 0
    for step in range(20 + steps):
        effort, position, velocity = random_efforts(random, RIGS), plant.position.copy(), plant.velocity.copy()
        if step == 20 - 1 and step_ns < 20_000_000:
            # Arms near their stops, so that many of them are hit within a short step.
            plant.position[:2] = np.array([ARM.upper[:2]]).T - random.uniform(0, 0.02, (2, RIGS))
        events = list(plant.step(effort, np.zeros(RIGS, dtype=np.bool_)))
        if step < 20:
            continue
        for index in range(RIGS):
            q, v = reference.step(position[:, index], velocity[:, index], effort[:, index], step_ns * 1e-9)
            assert np.all(np.abs(plant.position[:, index] - q) < ERROR_BOUND)
            speed = max(np.abs(velocity[:2, index]).max(), np.abs(v[:2]).max(), 0.01)
            assert np.abs(plant.velocity[:2, index] - v[:2]).max() < 0.01 * speed
            np.testing.assert_allclose(plant.velocity[2:, index], v[2:], rtol=1e-6, atol=1e-6)
            found = sorted((hit.joint, hit.upper, hit.speed) for hit in events if hit.rig == index)
            expected = sorted(hit for hit in reference.impacts if hit[2] > 1e-3)
            assert [hit[:2] for hit in found if hit[2] > 1e-3] == [hit[:2] for hit in expected]
            np.testing.assert_allclose(
                [hit[2] for hit in found if hit[2] > 1e-3], [hit[2] for hit in expected], rtol=0.01, atol=0.01
            )
            impacts += len(expected)
    assert impacts > 10


@pytest.mark.parametrize("substeps", ["auto", 1, 4])
def test_joint_that_leaves_its_stop_in_the_step_is_reported(substeps: int | str) -> None:
    # Joint 2 hits its stop after 4 ms, and is pulled back by the effort.
    plant, reference = Plant([rig(substeps=substeps)]), ReferenceArm(ARM)
    position, velocity = (0.3, ARM.upper[1] - 0.02, 0.1, 0.0), (0.0, 5.0, 0.0, 0.0)
    effort = np.array([0.0, -12.0, -4.9, 0.0])
    plant.set_state(0, position, velocity)
    events = [
        (hit.joint, hit.upper, hit.speed) for hit in plant.step(effort[:, np.newaxis], np.zeros(1, dtype=np.bool_))
    ]
    reference.step(np.array(position), np.array(velocity), effort, 0.02)
    ((joint, upper, speed),) = reference.impacts
    assert plant.position[1, 0] < ARM.upper[1]
    assert [event[:2] for event in events] == [(joint, upper)] == [(2, True)]
    assert events[0][2] == pytest.approx(speed, rel=0.01 if substeps != 1 else 0.1)


@pytest.mark.parametrize("substeps", ["auto", 1])
@pytest.mark.parametrize(
    ("joint", "side", "stop"), [(2, 1, ARM.upper[2]), (2, -1, 0.0), (3, 1, ARM.upper[3]), (2, 1, ARM.l1 + 0.03)]
)
def test_linear_joint_that_leaves_its_stop_is_reported(joint: int, side: int, stop: float, substeps: int | str) -> None:
    # The joint is near its stop, or the tool above a part, and turns outside within the step.
    scene = SceneParameters(parts=(part_below_the_tool(),)) if stop == ARM.l1 + 0.03 else NOTHING_BELOW
    plant, reference = Plant([replace(rig(substeps=substeps), scene=scene)]), ReferenceArm(ARM)
    rate, force, distance = (0.4, 20.0, 0.0005) if joint == 2 else (4.0, 3.0, 0.005)
    q, v, effort = np.array([0.0, 0.0, 0.1, 0.0]), np.zeros(4), np.array([0.0, 0.0, -4.9, 0.0])
    q[joint], v[joint] = stop - side * distance, side * rate
    effort[joint] -= side * force
    plant.set_state(0, q, v)
    events = plant.step(effort[:, np.newaxis], np.zeros(1, dtype=np.bool_))
    found = [(hit.joint, hit.upper, hit.speed) for hit in events]
    q, _ = reference.step(q, v, effort, 0.02, stop if joint == 2 and side > 0 else None)
    ((number, upper, speed),) = reference.impacts
    assert (q[joint] - stop) * side < -1e-6
    assert found == [(0 if scene.parts else number, upper, pytest.approx(speed, rel=1e-6))]
    assert plant.limit_flags == [0]
    if substeps == "auto":
        assert plant.position[joint, 0] == pytest.approx(q[joint], abs=1e-7)
    assert not list(plant.step(effort[:, np.newaxis], np.zeros(1, dtype=np.bool_)))


@pytest.mark.parametrize("substeps", ["auto", 1, 4])
def test_impact_of_a_joint_that_starts_at_rest_has_its_speed(substeps: int | str) -> None:
    plant, reference = Plant([rig(substeps=substeps)]), ReferenceArm(ARM)
    q, effort = np.array([0.0, 0.0, 0.1995, 0.0]), np.array([0.0, 0.0, 10.0, 0.0])
    plant.set_state(0, q, np.zeros(4))
    (hit,) = plant.step(effort[:, np.newaxis], np.zeros(1, dtype=np.bool_))
    reference.step(q, np.zeros(4), effort, 0.02)
    ((_, _, speed),) = reference.impacts
    assert hit.speed == pytest.approx(speed, rel=1e-6)


@pytest.mark.parametrize("step_ns", [20_000_000, 5_000_000, 1_000_000])
@pytest.mark.parametrize("stacked", [0, 1, 2, 3])
def test_quill_lands_at_the_time_of_the_reference(step_ns: int, stacked: int) -> None:
    parts = tuple(part_below_the_tool(level) for level in range(stacked))
    scene = SceneParameters(parts=parts)
    plant = Plant([replace(rig(step_ns), scene=scene)])
    upper3 = ARM.l1 + 0.06 - 0.03 * stacked
    q, v = np.array([0.0, 0.0, upper3 - 0.03, 0.0]), np.zeros(4)
    plant.set_state(0, q, v)
    effort, reference = np.array([0.0, 0.0, 3.0, 0.0]), ReferenceArm(ARM)
    hits: list[tuple[int, float]] = []
    expected: list[tuple[int, float]] = []
    for _ in range(round(0.12e9 / step_ns)):
        events = plant.step(effort[:, np.newaxis], np.zeros(1, dtype=np.bool_))
        hits += [(event.joint, event.speed) for event in events]
        q, v = reference.step(q, v, effort, step_ns * 1e-9, upper3)
        expected += [(0, speed) for _, _, speed in reference.impacts]
        np.testing.assert_allclose(plant.position[2, 0], q[2], atol=1e-8)
        np.testing.assert_allclose(plant.velocity[2, 0], v[2], atol=1e-6)
    assert len(hits) == len(expected) == 1
    assert hits[0] == (0, pytest.approx(expected[0][1], rel=1e-6))


@cache
def dragged(step_ns: int) -> tuple[np.ndarray, int]:
    """Return d3, m, of a tool that is dragged over the edge of a part, and the limit flags after the first step."""
    plant = Plant([replace(rig(step_ns), scene=SceneParameters(parts=(part_below_the_tool(),)))])
    plant.set_state(0, (0.0, 0.0, ARM.l1 + 0.03, 0.0), (0.0, 0.0, 0.0, 0.0))
    effort = np.array([[6.0], [2.0], [10.0], [0.0]])
    heights, first = [], plant.limit_flags[0]
    for _ in range(160_000_000 // step_ns):
        plant.step(effort, np.zeros(1, dtype=np.bool_))
        heights.append(plant.position[2, 0])
    return np.array(heights), first


@pytest.mark.parametrize("step_ns", [20_000_000, 5_000_000, 1_000_000])
def test_tool_falls_from_an_edge_when_it_leaves_it(step_ns: int) -> None:
    found, flags = dragged(step_ns)
    fine, _ = dragged(250_000)
    every = step_ns // 250_000
    np.testing.assert_allclose(found, fine[every - 1 :: every], atol=2e-5)
    assert flags & TOOL_CONTACT_FLAG
    assert found[0] == ARM.l1 + 0.03
    assert found[-1] > 0.19


def test_hours_of_random_torque_do_not_diverge() -> None:
    # 250 rigs for 1.6 s; the benchmark makes ten hours.
    random = np.random.default_rng(3)
    plant = Plant([rig()] * 250)
    for _ in range(80):
        plant.step(random_efforts(random, 250), np.zeros(250, dtype=np.bool_))
        assert np.abs(plant.velocity[:2]).max() < 40
        assert plant.substeps.max() < MAX_SUBSTEPS
        assert not plant.is_inaccurate()


def test_slow_motion_needs_two_substeps_fast_motion_more() -> None:
    random = np.random.default_rng(4)
    plant = Plant([rig()] * 50)
    for _ in range(100):
        effort = random_efforts(random, 50)
        effort[:, :25] *= 0.03
        plant.step(effort, np.zeros(50, dtype=np.bool_))
        assert np.all(plant.substeps[:25] == 2)
    assert plant.substeps[25:].max() >= 3
    assert np.all(plant.error[:2, :25] > 0)


def test_arms_of_different_stiffness_are_independent() -> None:
    arms = [ARM, replace(ARM, masses=(0.2, 0.2, 0.2)), replace(ARM, masses=(4.0, 4.0, 2.0)), ARM]
    rigs = [replace(rig(), arm=arm) for arm in arms]
    together, alone = Plant(rigs), [Plant([one]) for one in rigs]
    assert len(set(together.substeps.tolist())) > 2
    random = np.random.default_rng(5)
    for _ in range(100):
        effort = random_efforts(random, len(rigs))
        together.step(effort, np.zeros(len(rigs), dtype=np.bool_))
        for index, plant in enumerate(alone):
            plant.step(effort[:, index : index + 1].copy(), np.zeros(1, dtype=np.bool_))
            for mine, shared in (
                (plant.position, together.position),
                (plant.velocity, together.velocity),
                (plant.error, together.error),
                (plant.substeps[np.newaxis], together.substeps[np.newaxis]),
            ):
                np.testing.assert_array_equal(mine[:, 0], shared[:, index])


def test_bound_of_substeps_ends_a_step_and_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hilrig_sim.plant.plane_solver.MAX_SUBSTEPS", 3)
    light = replace(rig(), arm=replace(ARM, masses=(0.1, 0.05, 0.05), friction=(0.1, 0.1, 5.0, 0.05)))
    plant, inaccurate = Plant([light] * 20), 0
    random = np.random.default_rng(6)
    with np.errstate(all="ignore"):
        for _ in range(50):
            plant.step(random_efforts(random, 20), np.zeros(20, dtype=np.bool_))
            assert plant.substeps.max() <= 4
            inaccurate += plant.is_inaccurate()
    assert inaccurate


def test_free_motion_equals_the_exponential_solution() -> None:
    for rate in (0.0, 1e-6, 1e-3, 0.5, 40.0):
        q, v = free_motion(*(np.array([value]) for value in (0.1, 2.0, -3.0, rate, 0.3)))
        if rate < 1e-3:
            assert q[0] == pytest.approx(0.1 + 2.0 * 0.3 - 1.5 * 0.09, abs=1e-4)
            continue
        decay, final = np.exp(-rate * 0.3), -3.0 / rate
        assert v[0] == pytest.approx(final + (2.0 - final) * decay, rel=1e-9)
        assert q[0] == pytest.approx(0.1 + final * 0.3 + (2.0 - final) * (1 - decay) / rate, rel=1e-9)


def test_linear_joint_hits_a_stop_and_leaves_it_within_a_step() -> None:
    # It rises for 40 ms, meets the stop after a part of that, and is pulled back from rest.
    motion = move_between_stops(*(np.array([value]) for value in (0.0, 1.0, -25.0, 0.0, -1.0, 0.015, 0.06)))
    arrival = (1.0 - np.sqrt(1.0 - 2 * 25.0 * 0.015)) / 25.0
    assert motion.side[0] == 1.0
    assert motion.speed[0] == pytest.approx(1.0 - 25.0 * arrival, rel=1e-9)
    assert motion.position[0] == pytest.approx(0.015 - 12.5 * (0.06 - arrival) ** 2, rel=1e-9)
    assert motion.velocity[0] == pytest.approx(-25.0 * (0.06 - arrival), rel=1e-9)


def test_first_arrival_is_found_on_the_way_out_and_back() -> None:
    # q = 0.1 + s - 2 s² rises to 0.225 at s = 1/4 and falls to -0.9.
    start, end, rates = np.full(3, 0.1), np.full(3, -0.9), (np.full(3, 1.0), np.full(3, -3.0))
    lower, upper = np.array([-5.0, -0.5, -5.0]), np.array([0.2, 5.0, 5.0])
    found = first_arrival(start, end, *rates, lower, upper)
    assert found[0] == pytest.approx((1 - np.sqrt(1 - 8 * 0.1)) / 4, rel=1e-6)
    assert found[1] == pytest.approx((1 + np.sqrt(1 + 8 * 0.6)) / 4, rel=1e-6)
    assert found[2] == np.inf


def arm_of(masses: tuple[float, float, float], friction: tuple[float, float]) -> ArmParameters:
    return replace(ARM, masses=masses, friction=(*friction, 5.0, 0.05))


@pytest.mark.parametrize(
    ("masses", "friction"),
    [((0.22, 0.85, 0.47), (0.38, 0.52)), ((0.11, 0.02, 0.085), (0.21, 0.26)), ((1.3, 0.01, 0.16), (0.54, 0.13))],
)
def test_fast_arms_are_resolved(masses: tuple[float, float, float], friction: tuple[float, float]) -> None:
    # Errors of up to 2° whose estimates are below 0.02°, unless the turn of joint 2 in an integration step is limited.
    fast = replace(rig(), arm=arm_of(masses, friction))
    limits = np.array(ERROR_BOUND)[:, np.newaxis]
    largest = 0.0
    for plant, _, error in step_errors(fast, np.random.default_rng(8)):
        assert (error < limits).all()
        largest = max(largest, np.abs(plant.velocity[1]).max())
    assert largest > 25
    old = replace(fast, sim=replace(fast.sim, plant_version=2))
    assert any((error > limits).any() for *_, error in step_errors(old, np.random.default_rng(8)))


@pytest.mark.parametrize("number", range(int(os.environ.get("HILRIG_RANDOM_ARMS", "3"))))
def test_inaccurate_steps_of_an_arm_are_reported(number: int) -> None:
    random = np.random.default_rng(number)
    arm = arm_of(tuple(10 ** random.uniform(-2, 0.3, 3)), tuple(10 ** random.uniform(-1, 0.6, 2)))
    stiffest = replace(rig(int(random.choice((20_000_000, 5_000_000)))), arm=arm)
    while base_substeps(stiffest.arm, stiffest.sim) > MAX_SUBSTEPS:
        b1, b2, b3, b4 = stiffest.arm.friction
        stiffest = replace(stiffest, arm=replace(arm, friction=(0.5 * b1, 0.5 * b2, 0.5 * b3, 0.5 * b4)))
    limits, reference = np.array(ERROR_BOUND)[:, np.newaxis], ReferenceArm(stiffest.arm)
    before, is_silent = None, False
    for plant, efforts, error in step_errors(stiffest, random):
        is_silent |= bool(((error > limits).any(axis=0) & (np.abs(plant.error) <= limits).all(axis=0)).any())
        if before is not None:
            # The trial measures the distance from the reference.
            worst = int(error[:2].max(axis=0).argmax())
            position, velocity = before
            q, _ = reference.step(position[:, worst], velocity[:, worst], efforts[:, worst], stiffest.sim.step)
            distance = np.abs(plant.position[:, worst] - q)
            np.testing.assert_allclose(error[:2, worst], distance[:2], rtol=0.1, atol=np.radians(0.01))
        before = plant.position.copy(), plant.velocity.copy()
    assert not is_silent or list(accuracy_warnings({"a": stiffest}))


def test_arm_that_automatic_substeps_cannot_resolve_is_reported() -> None:
    whip = replace(rig(), arm=arm_of((0.014, 0.8, 0.024), (0.4, 0.32)))
    (warning,) = accuracy_warnings({"a": whip})
    assert warning.startswith("a: at the largest torques ")
    assert warning.endswith("; use a shorter sim.step_ms")


def test_check_warns_of_arms_that_one_step_cannot_integrate() -> None:
    def rigs(substeps: int | str) -> dict[str, RigParameters]:
        return {name: rig(substeps=substeps) for name in ("a", "b")}

    assert not list(accuracy_warnings(rigs("auto")))
    (warning,) = accuracy_warnings(rigs(1))
    assert warning.startswith("a and 1 more: at the largest torques ")
    assert 'set sim.substeps = "auto"' in warning


def test_check_prints_its_warnings_as_json_too(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text("sim.substeps = 1\n")
    done = hilrig("check", tmp_path / "lab.toml", "--json")
    (warning,) = json.loads(done.stdout)["warnings"]
    assert (done.returncode, done.stderr) == (0, "")
    assert 'set sim.substeps = "auto"' in warning
