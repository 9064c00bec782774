"""Picks, drops and stacks compared with an event-driven reference, at steps of 20, 5 and 1 ms."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from hilrig_sim.arm import kinematics
from hilrig_sim.arm.model import (
    GRAVITY,
    ArmParameters,
    PartParameters,
    RigParameters,
    SceneParameters,
    StepParameters,
    TrayParameters,
)
from hilrig_sim.plant.limits import PlantEventKind
from hilrig_sim.plant.plant import Plant
from hilrig_sim.plant.world import NO_PART
from support.reference_plant import ReferenceArm

ARM = ArmParameters()
TABLE, HEIGHT, RADIUS, MASS = -0.06, 0.03, 0.02, 0.2
STEPS = pytest.mark.parametrize("step_ns", [20_000_000, 5_000_000, 1_000_000])
ON, OFF = np.array([True]), np.array([False])
REST = np.array([[0.0], [0.0], [-ARM.masses[2] * GRAVITY], [0.0]])


def part(name: str, x: float, y: float, bottom: float) -> PartParameters:
    size = (2 * RADIUS, 2 * RADIUS, HEIGHT)
    return PartParameters(name, "cylinder", size, MASS, True, "#808080", (x, y, bottom + HEIGHT / 2), 0.0)


def rig(step_ns: int, *parts: PartParameters, trays: tuple[TrayParameters, ...] = ()) -> RigParameters:
    return RigParameters(sim=StepParameters(step_ns=step_ns), scene=SceneParameters(parts=parts, trays=trays))


def advance(plant: Plant, reference: ReferenceArm, effort: np.ndarray, magnet: np.ndarray, duration: float) -> None:
    """Advance both, and compare the states of the arm after each step of the plant."""
    step = plant.rigs[0].sim.step_ns * 1e-9
    q, v = plant.position[:, 0].copy(), plant.velocity[:, 0].copy()
    for _ in range(round(duration / step)):
        plant.step(effort[:, np.newaxis], magnet)
        q, v = reference.step(q, v, effort, step)
        np.testing.assert_allclose(plant.position[:, 0], q, atol=5e-5)
        np.testing.assert_allclose(plant.velocity[:, 0], v, atol=0.005 * np.abs(v).max())


@STEPS
def test_arm_that_picks_and_releases_in_motion(step_ns: int) -> None:
    plant = Plant([rig(step_ns, part("a", 0.3, 0.1, TABLE))])
    start = kinematics.inverse(ARM, (0.305, 0.1, TABLE + HEIGHT + 0.002, 0.0))[0]
    v = np.array([1.5, -2.0, -0.4, 2.0])
    plant.set_state(0, start, v)
    empty, loaded, effort = ReferenceArm(ARM), ReferenceArm(ARM, MASS), np.array([3.0, -2.0, -9.0, 0.1])
    # The part is at rest: the impulse acts on both, so the momentum of the loaded arm is that of the empty one.
    v[:2] = np.linalg.solve(loaded.mass(start[1]), empty.mass(start[1]) @ v[:2])
    v[2] *= ARM.masses[2] / (ARM.masses[2] + MASS)
    events = list(plant.step(effort[:, np.newaxis], ON))
    assert [event.kind for event in events] == [PlantEventKind.PART_PICKED]
    q, v = loaded.step(np.array(start), v, effort, step_ns * 1e-9)
    np.testing.assert_allclose(plant.position[:, 0], q, atol=5e-5)
    np.testing.assert_allclose(plant.velocity[:, 0], v, atol=0.005 * np.abs(v).max())
    advance(plant, loaded, effort, ON, 0.06)
    # A released part takes its momentum along: the speed of the arm is continuous.
    advance(plant, empty, effort, OFF, 0.06)
    assert plant.world.held[0] == NO_PART


@dataclass
class Surface:
    """A horizontal surface: a disc of a radius, or, with half a side, a square along the axes."""

    x: float
    y: float
    top: float
    radius: float = 0.0
    half_side: float = 0.0

    def is_below(self, x: float, y: float) -> bool:
        if self.radius:
            return math.hypot(x - self.x, y - self.y) < self.radius + RADIUS
        beyond = [max(0.0, abs(d) - self.half_side) for d in (x - self.x, y - self.y)]
        return math.hypot(*beyond) < RADIUS


def landing(at: np.ndarray, velocity: np.ndarray, surfaces: list[Surface]) -> tuple[float, np.ndarray]:
    """Return time and place, (3,), of the bottom of a falling part where it first meets a surface from above."""
    found = []
    for surface in surfaces:
        root = velocity[2] ** 2 + 2 * GRAVITY * (at[2] - surface.top)
        if root >= 0:
            time = (velocity[2] + math.sqrt(root)) / GRAVITY
            x, y = at[:2] + velocity[:2] * time
            if surface.is_below(x, y):
                found.append((time, np.array([x, y, surface.top])))
    return min(found, key=lambda one: one[0])


def center_and_velocity(plant: Plant, grip: float) -> tuple[np.ndarray, np.ndarray]:
    """Return center and velocity, (3,), of a part held at the distance `grip` from the tool along its x axis."""
    (t1, t2, d3, t4), (v1, v2, v3, v4) = plant.position[:, 0], plant.velocity[:, 0]
    arms = ((ARM.l2, t1, v1), (ARM.l3, t1 + t2, v1 + v2), (grip, t1 + t2 + t4, v1 + v2 + v4))
    center, velocity = np.array([0.0, 0.0, ARM.l1 - d3 - HEIGHT / 2]), np.array([0.0, 0.0, -v3])
    for length, angle, speed in arms:
        toward = np.array([math.cos(angle), math.sin(angle), 0.0])
        center += length * toward
        velocity += length * speed * np.array([-toward[1], toward[0], 0.0])
    return center, velocity


TABLE_TOP = Surface(0.0, 0.0, TABLE, half_side=10.0)


@STEPS
@pytest.mark.parametrize("target", ["table", "tray", "part", "stack of two", "stack of three", "beyond a part"])
def test_part_released_in_motion_lands_on(target: str, step_ns: int) -> None:
    grip, release = 0.008, 0.12
    q, v = kinematics.inverse(ARM, (0.45, -0.1, release, 0.3))[0], (1.2, 0.8, -0.5, 1.0)

    def released(*parts: PartParameters, trays: tuple[TrayParameters, ...] = ()) -> Plant:
        plant = Plant([rig(step_ns, part("a", 0.0, 0.4, TABLE), *parts, trays=trays)])
        plant.set_state(0, q, v)
        center, _ = center_and_velocity(plant, grip)
        poses = [(*center, 0.0), *((*one.position, one.yaw) for one in parts)]
        plant.set_state(0, q, v, poses, 0)
        return plant

    center, velocity = center_and_velocity(released(), grip)
    bottom = center - (0, 0, HEIGHT / 2)
    stacked = {"part": 1, "stack of two": 2, "stack of three": 3}.get(target, 0)
    surfaces = [TABLE_TOP]
    parts: tuple[PartParameters, ...] = ()
    trays: tuple[TrayParameters, ...] = ()
    if target == "tray":
        _, (x, y, _) = landing(bottom, velocity, [Surface(0, 0, TABLE + 0.008, half_side=10.0)])
        trays = (TrayParameters("tray", (0.1, 0.1, 0.008), (x, y, TABLE), 0.0, "#404040", ((x, y, TABLE + 0.008),)),)
        surfaces.append(Surface(x, y, TABLE + 0.008, half_side=0.05))
    elif stacked:
        _, (x, y, _) = landing(bottom, velocity, [Surface(0, 0, TABLE + stacked * HEIGHT, half_side=10.0)])
        x += 0.01
        parts = tuple(part("bcd"[level], x, y, TABLE + level * HEIGHT) for level in range(stacked))
        surfaces += [Surface(x, y, TABLE + level * HEIGHT + HEIGHT, RADIUS) for level in range(stacked)]
    elif target == "beyond a part":
        # It is above the part while its bottom is above the top of the part, and lands on the table beside it.
        _, (x, y, _) = landing(bottom, velocity, [TABLE_TOP])
        x, y = np.array([x, y]) - 0.075 * velocity[:2] / math.hypot(*velocity[:2])
        parts = (part("b", x, y, TABLE),)
        surfaces.append(Surface(x, y, TABLE + HEIGHT, RADIUS))
    time, place = landing(bottom, velocity, surfaces)
    assert place[2] == {"tray": TABLE + 0.008}.get(target, TABLE + stacked * HEIGHT)
    plant, step = released(*parts, trays=trays), step_ns * 1e-9
    for number in range(1, round(time / step) + 3):
        plant.step(REST, OFF)
        world, now = plant.world, number * step
        found = np.array([world.x[0, 0], world.y[0, 0], world.z[0, 0] - HEIGHT / 2])
        expected = bottom + velocity * now - (0, 0, GRAVITY / 2 * now**2) if now < time else place
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert not any(values[0, 0] for values in plant.world.velocity)
    assert plant.world.at_rest(0)


@STEPS
@pytest.mark.parametrize("stacked", [1, 2, 3])
def test_held_part_lands_on_a_stack_at_the_time_of_the_reference(stacked: int, step_ns: int) -> None:
    parts = [part("bcd"[level], 0.5, 0.0, TABLE + level * HEIGHT) for level in range(stacked)]
    plant = Plant([rig(step_ns, part("a", 0.0, 0.4, TABLE), *parts)])
    top = TABLE + stacked * HEIGHT
    start = top + HEIGHT + 0.02
    q, v = np.array(kinematics.inverse(ARM, (0.51, 0.0, start, 0.0))[0]), np.zeros(4)
    poses = [(0.51, 0.0, start - HEIGHT / 2, 0.0), *((*one.position, one.yaw) for one in parts)]
    plant.set_state(0, q, v, poses, 0)
    reference, effort = ReferenceArm(ARM, MASS), np.zeros(4)
    hits: list[tuple[int, float]] = []
    expected = []
    for _ in range(round(0.12e9 / step_ns)):
        hits += [(event.joint, event.speed) for event in plant.step(effort[:, np.newaxis], ON)]
        q, v = reference.step(q, v, effort, step_ns * 1e-9, ARM.l1 - top - HEIGHT)
        expected += [(0, pytest.approx(speed, rel=1e-6)) for _, _, speed in reference.impacts]
        np.testing.assert_allclose(plant.position[2, 0], q[2], atol=1e-8)
        assert plant.world.z[0, 0] == pytest.approx(ARM.l1 - q[2] - HEIGHT / 2, abs=1e-8)
    assert hits == expected
    assert len(hits) == 1


@STEPS
@pytest.mark.parametrize("order", ["ab", "ba", "abc", "cba", "bca"])
def test_stack_falls_freely_when_its_lowest_part_is_picked(order: str, step_ns: int) -> None:
    # "a" is the lowest part; the arm holds it and is then elsewhere.
    parts = [part(name, 0.3, 0.1, TABLE + "abc".index(name) * HEIGHT) for name in order]
    plant = Plant([rig(step_ns, *parts)])
    held, step = order.index("a"), step_ns * 1e-9
    start = kinematics.inverse(ARM, (0.3, 0.1, TABLE + HEIGHT, 0.0))[0]
    plant.set_state(0, start, np.zeros(4))
    away = np.array([[0.0], [0.0], [-(ARM.masses[2] + MASS) * GRAVITY], [0.0]])
    plant.world.pick(np.array([0]), plant.tool(np.array([0])))
    assert plant.world.held[0] == held
    plant.position[0, 0] += 0.5
    plant._refresh_derived_state()
    for number in range(1, round(0.12 / step)):
        plant.step(away, ON)
        for row, name in enumerate(order):
            if name != "a":
                level = "abc".index(name)
                fallen = min(HEIGHT, GRAVITY / 2 * (number * step) ** 2)
                assert plant.world.z[row, 0] == pytest.approx(TABLE + (level + 0.5) * HEIGHT - fallen, abs=1e-9)
    assert plant.world.at_rest(0)
    assert not plant.world.falling
