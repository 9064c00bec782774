"""Unit tests of the scene: picking, holding and releasing parts, and contact with parts, trays and table."""

from dataclasses import replace

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
from hilrig_sim.plant.limits import TOOL_CONTACT_FLAG, PlantEvent, PlantEventKind
from hilrig_sim.plant.plant import Plant
from hilrig_sim.plant.static_geometry import TABLE_ABOVE_GROUND_M
from hilrig_sim.plant.world import NO_PART

ARM = ArmParameters()
TABLE = -0.06
ON, OFF = np.array([True]), np.array([False])


def part(
    name: str, x: float, y: float, *, below: float = TABLE, mass: float = 0.2, iron: bool = True
) -> PartParameters:
    size = (0.04, 0.04, 0.03)
    return PartParameters(name, "cylinder", size, mass, iron, "#808080", (x, y, below + 0.015), 0.0)


TRAY = TrayParameters("tray", (0.1, 0.1, 0.008), (0.3, -0.2, TABLE), 0.3, "#404040", ((0.3, -0.2, TABLE + 0.008),))


def plant_over(x: float, y: float, z: float, *parts: PartParameters, arm: ArmParameters = ARM) -> Plant:
    """Return a rig with its tool at (x, y, z), in a scene of parts and the tray."""
    plant = Plant([RigParameters(arm=arm, scene=SceneParameters(parts=parts, trays=(TRAY,)))])
    move_to(plant, x, y, z)
    return plant


def move_to(plant: Plant, x: float, y: float, z: float) -> None:
    plant.set_state(0, kinematics.inverse(ARM, (x, y, z, 0.0))[0], np.zeros(4), None)


def hold(plant: Plant) -> np.ndarray:
    """Return the efforts that hold the quill and its part against gravity."""
    return np.array([[0.0], [0.0], [-(ARM.masses[2] + plant.world.payload()[0]) * GRAVITY], [0.0]])


def steps(plant: Plant, count: int, effort: np.ndarray, magnet: np.ndarray) -> list[PlantEvent]:
    return [event for _ in range(count) for event in tuple(plant.step(effort, magnet))]


def test_magnet_picks_part_within_reach_with_its_mass() -> None:
    plant = plant_over(0.3, 0.1, TABLE + 0.034, part("a", 0.308, 0.1))
    (event,) = steps(plant, 1, hold(plant), ON)
    assert (event.kind, event.part) == (PlantEventKind.PART_PICKED, 0)
    assert plant.world.held[0] == 0
    assert plant.dynamics.payload[0] == 0.2
    later = steps(plant, 50, hold(plant), ON)
    assert PlantEventKind.PART_DROPPED not in {event.kind for event in later}
    assert abs(plant.velocity[2, 0]) < 0.02


@pytest.mark.parametrize(
    ("x", "z", "iron"),
    [(0.3 + 0.0151, TABLE + 0.03, True), (0.3, TABLE + 0.03 + 0.0052, True), (0.3, TABLE + 0.03, False)],
    ids=["too far aside", "too high", "not magnetic"],
)
def test_magnet_picks_no_other_part(x: float, z: float, iron: bool) -> None:
    plant = plant_over(0.3, 0.1, z, part("a", x, 0.1, iron=iron))
    assert steps(plant, 1, hold(plant), ON) == []
    assert plant.world.held[0] == NO_PART


def test_magnet_picks_the_nearer_of_two_parts() -> None:
    thin = [replace(part(name, x, 0.1), size=(0.01, 0.01, 0.03)) for name, x in (("a", 0.312), ("b", 0.292))]
    plant = plant_over(0.3, 0.1, TABLE + 0.03, *thin)
    steps(plant, 1, hold(plant), ON)
    assert plant.world.held[0] == 1


def test_held_part_moves_and_rotates_with_the_tool() -> None:
    plant = plant_over(0.3, 0.1, TABLE + 0.03, part("a", 0.308, 0.105))
    # The tool is rotated when it picks the part: 8 mm and 5 mm are along the world axes.
    plant.position[3, 0] += 0.7
    steps(plant, 1, hold(plant), ON)
    effort = hold(plant)
    effort[:, 0] += (2.0, -1.0, -2.0, 0.05)
    for _ in range(40):
        plant.step(effort, ON)
        x, y, z, yaw = plant.tool(np.array([0]))[:, 0]
        world = plant.world
        c, s = np.cos(yaw - 0.7), np.sin(yaw - 0.7)
        assert world.x[0, 0] == pytest.approx(x + 0.008 * c - 0.005 * s, abs=1e-12)
        assert world.y[0, 0] == pytest.approx(y + 0.008 * s + 0.005 * c, abs=1e-12)
        assert world.yaw[0, 0] == pytest.approx(yaw - 0.7, abs=1e-12)
        assert world.z[0, 0] == pytest.approx(z - 0.015, abs=1e-12)
    assert abs(yaw - 0.7) > 0.1


@pytest.mark.parametrize("table_m", [1.3, 1.0], ids=["table everywhere", "table with an edge"])
@pytest.mark.parametrize("tray", [False, True], ids=["on the table", "on a tray"])
def test_tip_inside_a_part_holds_it_at_its_height(table_m: float, tray: bool) -> None:
    base = TABLE + (0.008 if tray else 0.0)
    scene = SceneParameters(
        parts=(part("a", 0.3, -0.2, below=base),), trays=(TRAY,) if tray else (), table_size=(table_m, table_m)
    )
    plant = Plant([RigParameters(scene=scene)])
    move_to(plant, 0.3, -0.2, base + 0.026)
    d3 = plant.position[2, 0]
    (event, *_) = steps(plant, 1, hold(plant), ON)
    assert event.kind is PlantEventKind.PART_PICKED
    # The part is not pressed into the surface below, the quill is not pushed up, and it does not move further down.
    pressed = hold(plant)
    pressed[2] += 8.0
    for _ in range(60):
        plant.step(pressed, ON)
        assert plant.position[2, 0] == pytest.approx(d3, abs=1e-8)
        assert plant.world.z[0, 0] - 0.015 == pytest.approx(base, abs=1e-8)
    # A plant restored from the recorded pose is bit-identical.
    world, again = plant.world, Plant([RigParameters(scene=scene)])
    pose = (float(world.x[0, 0]), float(world.y[0, 0]), float(world.z[0, 0]), float(world.yaw[0, 0]))
    again.set_state(0, plant.position[:, 0], plant.velocity[:, 0], [pose], held=0)
    lifted = hold(plant)
    lifted[2] -= 1.0
    for effort in (pressed, lifted):
        for _ in range(20):
            plant.step(effort, ON)
            again.step(effort, ON)
            np.testing.assert_array_equal(again.position, plant.position)
    assert plant.tool(np.array([0]))[2, 0] - world.z[0, 0] == pytest.approx(0.011, abs=1e-8)
    assert world.z[0, 0] - 0.015 > base + 0.01
    steps(plant, 60, hold(plant), OFF)
    assert world.z[0, 0] - 0.015 == pytest.approx(base, abs=1e-8)


def test_picking_conserves_momentum_and_reduces_energy() -> None:
    plant = plant_over(0.3, 0.1, TABLE + 0.03, part("a", 0.3, 0.1, mass=1.0))
    plant.velocity[:, 0] = 0.8, -0.5, -0.3, 0.7
    before = plant.dynamics.kinetic_energy(plant.position[1], plant.velocity)[0]
    alpha, a12, a22 = (element[0] for element in plant.dynamics.mass_matrix_12(plant.position[1]))
    momentum = np.array([[alpha, a12], [a12, a22]]) @ plant.velocity[:2, 0]
    plant._switched[:] = True
    plant._switch_magnets(ON)
    alpha, a12, a22 = (element[0] for element in plant.dynamics.mass_matrix_12(plant.position[1]))
    np.testing.assert_allclose(np.array([[alpha, a12], [a12, a22]]) @ plant.velocity[:2, 0], momentum, atol=1e-12)
    after = plant.dynamics.kinetic_energy(plant.position[1], plant.velocity)[0]
    assert after < 0.95 * before
    # Joint 3 is decoupled; the part is a point mass on the axis of joint 4.
    assert plant.velocity[2, 0] == pytest.approx(-0.3 * ARM.masses[2] / (ARM.masses[2] + 1.0))
    assert plant.velocity[3, 0] == 0.7


def test_released_part_falls_freely_onto_the_table() -> None:
    plant = plant_over(0.3, 0.1, TABLE + 0.03, part("a", 0.3, 0.1))
    steps(plant, 1, hold(plant), ON)
    move_up(plant, 0.15)
    height = plant.world.z[0, 0]
    dropped = steps(plant, 1, hold(plant), OFF)
    assert [event.kind for event in dropped] == [PlantEventKind.PART_DROPPED]
    assert plant.dynamics.payload[0] == 0.0
    assert plant.world.z[0, 0] == pytest.approx(height - 0.5 * GRAVITY * 0.02**2)
    heights = []
    for _ in range(30):
        plant.step(hold(plant), OFF)
        heights.append(plant.world.z[0, 0])
    free = [height - 0.5 * GRAVITY * (0.02 * (step + 2)) ** 2 for step in range(30)]
    assert sum(z > TABLE + 0.015 for z in free) > 5
    assert heights == pytest.approx([max(z, TABLE + 0.015) for z in free], abs=1e-12)
    assert plant.world.at_rest(0)
    assert not plant.world.moving[0]


def move_up(plant: Plant, height: float) -> None:
    """Move tool and held part up without simulating a motion."""
    plant.position[2, 0] -= height
    plant._refresh_derived_state()
    rigs = np.array([0])
    plant.world.move_held_parts(rigs, plant.tool(rigs))


@pytest.mark.parametrize(
    ("x", "y", "support"),
    [(0.3, -0.2, TABLE + 0.008), (0.42, 0.15, TABLE + 0.03), (0.42, 0.185, TABLE + 0.03), (0.2, 0.25, TABLE)],
    ids=["tray", "part", "edge of a part", "table"],
)
def test_released_part_rests_on_the_surface_below_it(x: float, y: float, support: float) -> None:
    plant = plant_over(0.3, 0.1, TABLE + 0.03, part("a", 0.3, 0.1), part("b", 0.42, 0.15))
    steps(plant, 1, hold(plant), ON)
    plant.position[:, 0] = kinematics.inverse(ARM, (x, y, 0.1, 0.0))[0]
    move_up(plant, 0.0)
    steps(plant, 40, hold(plant), OFF)
    assert plant.world.z[0, 0] == pytest.approx(support + 0.015, abs=1e-9)
    assert plant.world.at_rest(0)


@pytest.mark.parametrize("order", ["abc", "cba", "bca"])
def test_stack_falls_when_its_lowest_part_is_picked(order: str) -> None:
    places = {"a": 0.06, "b": 0.03, "c": 0.0}
    stack = [part(name, 0.3, 0.1, below=TABLE + places[name], iron=name == "c") for name in order]
    plant = plant_over(0.3, 0.112, TABLE + 0.03, *stack)
    steps(plant, 1, hold(plant), ON)
    assert plant.world.held[0] == order.index("c")
    plant.position[0, 0] += 0.5
    plant._refresh_derived_state()
    steps(plant, 60, hold(plant), ON)
    bottoms = {name: plant.world.z[row, 0] - 0.015 - TABLE for row, name in enumerate(order)}
    assert (bottoms["b"], bottoms["a"]) == pytest.approx((0.0, 0.03), abs=1e-9)
    assert plant.world.at_rest(0)
    assert not plant.world.falling


def test_part_on_a_picked_part_falls() -> None:
    lower, upper = part("lower", 0.30, 0.1), part("upper", 0.33, 0.1, below=TABLE + 0.03, iron=False)
    # The tool is above the lower part only: the upper part does not cover its center.
    plant = plant_over(0.30, 0.1, TABLE + 0.03, replace(lower, size=(0.05, 0.05, 0.03)), upper)
    assert plant.world.at_rest(0)
    steps(plant, 1, hold(plant), ON)
    assert plant.world.held[0] == 0
    move_up(plant, 0.1)
    steps(plant, 20, hold(plant), ON)
    assert plant.world.z[1, 0] == pytest.approx(TABLE + 0.015, abs=1e-9)


def test_part_released_beside_the_table_lies_on_the_floor() -> None:
    scene = SceneParameters(parts=(part("a", 0.3, 0.1),), table_size=(0.7, 0.7))
    plant = Plant([RigParameters(scene=scene)])
    move_to(plant, 0.3, 0.1, TABLE + 0.03)
    steps(plant, 1, hold(plant), ON)
    plant.position[:, 0] = kinematics.inverse(ARM, (0.1, 0.5, 0.1, 0.0))[0]
    move_up(plant, 0.0)
    steps(plant, 60, hold(plant), OFF)
    assert plant.world.z[0, 0] == pytest.approx(TABLE - TABLE_ABOVE_GROUND_M + 0.015, abs=1e-9)


@pytest.mark.parametrize(
    ("x", "y", "stops_at"),
    [(0.3, -0.2, TABLE + 0.008), (0.42, 0.15, TABLE + 0.03), (0.2, 0.25, TABLE)],
    ids=["tray", "part", "table"],
)
def test_tool_stops_on_the_surface_below_it(x: float, y: float, stops_at: float) -> None:
    plant = plant_over(x, y, 0.1, part("b", 0.42, 0.15))
    events = steps(plant, 60, np.zeros((4, 1)), OFF)
    (hit,) = [event for event in events if event.kind is PlantEventKind.LIMIT_HIT]
    assert (hit.joint, hit.upper) == (0, True)
    assert hit.speed > 0.3
    assert plant.tool(np.array([0]))[2, 0] == pytest.approx(stops_at, abs=1e-12)
    assert plant.limit_flags[0] == TOOL_CONTACT_FLAG
    assert plant.velocity[2, 0] == 0.0


def test_held_part_stops_the_tool_at_its_height() -> None:
    plant = plant_over(0.3, 0.1, TABLE + 0.03, part("a", 0.3, 0.1), part("b", 0.42, 0.15))
    steps(plant, 1, hold(plant), ON)
    plant.position[:, 0] = kinematics.inverse(ARM, (0.45, 0.15, 0.08, 0.0))[0]
    move_up(plant, 0.0)
    steps(plant, 60, np.zeros((4, 1)), ON)
    assert plant.tool(np.array([0]))[2, 0] == pytest.approx(TABLE + 0.06, abs=1e-12)
    assert plant.world.z[0, 0] == pytest.approx(TABLE + 0.045, abs=1e-12)


def test_tool_and_parts_are_never_below_the_table() -> None:
    rng = np.random.default_rng(8)
    parts = [part("a", 0.3, 0.1), part("b", 0.42, 0.15), part("c", 0.2, 0.3)]
    plant = plant_over(0.3, 0.1, TABLE + 0.03, *parts)
    for step in range(1500):
        if step % 30 == 0:
            effort, magnet = rng.uniform((-4, -4, -14, -0.1), (4, 4, 6, 0.1))[:, np.newaxis], rng.random(1) < 0.7
        plant.step(effort, magnet)
        assert plant.tool(np.array([0]))[2, 0] >= TABLE - 1e-12
        assert np.all(plant.world.z[:, 0] - 0.015 >= TABLE - 1e-12)


def test_reset_moves_arm_and_parts_to_the_start() -> None:
    plant = plant_over(0.3, 0.1, TABLE + 0.03, part("a", 0.3, 0.1))
    steps(plant, 10, hold(plant) + 1.0, ON)
    plant.reset(0)
    assert plant.world.held[0] == NO_PART
    assert plant.dynamics.payload[0] == 0.0
    np.testing.assert_array_equal(plant.position[:, 0], ARM.start)
    np.testing.assert_allclose((plant.world.x[0, 0], plant.world.y[0, 0]), (0.3, 0.1))
    assert plant.world.moving[0]


def test_rig_without_parts_and_trays_has_a_table() -> None:
    plant = Plant([RigParameters()])
    steps(plant, 60, np.zeros((4, 1)), ON)
    assert plant.tool(np.array([0]))[2, 0] == pytest.approx(TABLE, abs=1e-12)


def thrown(step_ns: int, release_m: float, *, version: int = 2) -> tuple[Plant, np.ndarray]:
    """Return a rig that has released a part in motion, and the velocity of the part at that time, (3,)."""
    sim = StepParameters(step_ns=step_ns, plant_version=version)
    item = replace(part("a", 0.5, 0.0), position=(0.5, 0.0, release_m - 0.015))
    plant = Plant([RigParameters(sim=sim, scene=SceneParameters(parts=(item,)))])
    start = kinematics.inverse(ARM, (0.5, 0.0, release_m, 0.0))[0]
    plant.set_state(0, start, np.zeros(4), [(0.51, 0.0, release_m - 0.015, 0.0)], 0)
    for _ in range(round(0.1e9 / step_ns)):
        plant.step(np.array([[4.0], [1.0], [-8.0], [0.5]]), ON)
    before = np.array([plant.world.x[0, 0], plant.world.y[0, 0], plant.world.z[0, 0]])
    ahead = Plant([RigParameters(sim=StepParameters(step_ns=10_000), scene=SceneParameters(parts=(item,)))])
    pose = (*before, float(plant.world.yaw[0, 0]))
    ahead.set_state(0, plant.position[:, 0], plant.velocity[:, 0], [pose], 0)
    ahead.step(np.array([[4.0], [1.0], [-8.0], [0.5]]), ON)
    after = np.array([ahead.world.x[0, 0], ahead.world.y[0, 0], ahead.world.z[0, 0]])
    return plant, (after - before) / 1e-5


@pytest.mark.parametrize("step_ns", [20_000_000, 5_000_000, 1_000_000])
def test_released_part_flies_ballistically_and_stays(step_ns: int) -> None:
    plant, velocity = thrown(step_ns, 0.08)
    start = np.array([plant.world.x[0, 0], plant.world.y[0, 0], plant.world.z[0, 0]])
    assert np.hypot(*velocity[:2]) > 0.2
    height = start[2] - 0.015 - TABLE
    flight = (velocity[2] + np.sqrt(velocity[2] ** 2 + 2 * GRAVITY * height)) / GRAVITY
    plant.step(hold(plant), OFF)
    moving = np.array([values[0, 0] for values in plant.world.velocity])
    step = step_ns * 1e-9
    np.testing.assert_allclose(moving, velocity - (0, 0, GRAVITY * step), rtol=1e-3, atol=1e-3)
    for _ in range(round(flight / step) + 3):
        plant.step(hold(plant), OFF)
    landed = np.array([plant.world.x[0, 0], plant.world.y[0, 0]])
    np.testing.assert_allclose(landed, start[:2] + velocity[:2] * flight, atol=1e-5 + 1e-3 * flight)
    assert plant.world.z[0, 0] == TABLE + 0.015
    assert not any(values[0, 0] for values in plant.world.velocity)
    assert plant.world.at_rest(0)


def test_part_thrown_over_the_edge_falls_to_the_ground() -> None:
    table = SceneParameters(table_size=(1.0, 1.0), parts=(part("a", 0.45, 0.0),))
    plant = Plant([RigParameters(scene=table)])
    plant.world.set_state(0, [(0.45, 0.0, 0.2, 0.0)], NO_PART, plant.tool(np.array([0]))[:, 0])
    plant.world._falling[0, 0] = True
    plant.world.falling = True
    plant.world._drift[0, 0, 0] = 1.0
    for _ in range(60):
        plant.step(np.array([[0.0], [0.0], [-0.5 * GRAVITY], [0.0]]), OFF)
    assert plant.world.z[0, 0] == pytest.approx(TABLE - TABLE_ABOVE_GROUND_M + 0.015)
    assert plant.world.x[0, 0] > 0.7


def test_plant_version_1_releases_parts_at_rest() -> None:
    plant, velocity = thrown(20_000_000, 0.08, version=1)
    start = plant.world.x[0, 0], plant.world.y[0, 0]
    assert np.hypot(*velocity[:2]) > 0.2
    for _ in range(20):
        plant.step(hold(plant), OFF)
    assert (plant.world.x[0, 0], plant.world.y[0, 0]) == start
