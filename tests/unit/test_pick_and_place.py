"""Unit tests of the pick-and-place controller, also with a slow loop, and of the placement check.

With HILRIG_LONG in the environment with more delays.
"""

import numpy as np
import pytest

from hilrig_replay.grading.placement import evaluate_placement
from hilrig_schemas import JointState, PartState
from hilrig_sim.arm.dynamics import forward_dynamics
from hilrig_sim.arm.model import ArmParameters, RigParameters
from support.long_tests import LONG
from support.recordings import PARAMETERS
from support.virtual_rig import RemoteRig, VirtualRig, pick_and_place, run_controller


def last_parts(states: list[JointState]) -> tuple[list[PartState], str]:
    state = next(state for state in reversed(states) if state.parts)
    return list(state.parts), state.held_part


@pytest.mark.parametrize("extra_ms", [0, 20, 40, 60] if LONG else [0, 60])
def test_every_part_is_placed_within_2_mm_at_any_latency(extra_ms: int) -> None:
    with VirtualRig() as rig:
        done_s = run_controller(rig, 20.0, state_delay_ms=extra_ms // 2, command_delay_ms=extra_ms - extra_ms // 2)
        parts, held = last_parts(rig.states)
    result = evaluate_placement(PARAMETERS.scene, parts, held=held)
    assert result.placed == len(PARAMETERS.scene.parts) == 4
    assert result.largest_error_mm is not None
    assert result.largest_error_mm < 2.0
    assert done_s is not None
    assert done_s < 18.0
    assert rig.kinds().count("PART_PICKED") == rig.kinds().count("PART_DROPPED") == 4


@pytest.mark.parametrize("one_way_ms", [0.0, 3.0, 6.0, 9.5, 20.0, 30.0] if LONG else [9.5, 30.0])
def test_all_parts_are_placed_over_a_slow_network(one_way_ms: float, monkeypatch: pytest.MonkeyPatch) -> None:
    example = pick_and_place()
    with VirtualRig() as rig:
        remote = RemoteRig(rig, one_way_ms, seed=1)
        monkeypatch.setattr(example, "time", remote)
        outcome = example.control(remote, example.Controller(example.task_of({})), 40.0, once=True)
        parts, held = last_parts(rig.states)
    result = evaluate_placement(PARAMETERS.scene, parts, held=held)
    assert outcome["placed"] == result.placed == 4
    assert result.largest_error_mm is not None
    assert result.largest_error_mm < 2.0


@pytest.mark.parametrize("one_way_ms", [0.0, 20.0])
@pytest.mark.parametrize("seed", [1, 2, 3] if LONG else [2])
def test_stalls_delay_the_task_but_do_not_spoil_it(
    one_way_ms: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    example = pick_and_place()
    with VirtualRig() as rig:
        remote = RemoteRig(rig, one_way_ms, seed, stalls=0.004)
        monkeypatch.setattr(example, "time", remote)
        outcome = example.control(remote, example.Controller(example.task_of({})), 20.0, 20.0, once=True)
        parts, held = last_parts(rig.states)
    result = evaluate_placement(PARAMETERS.scene, parts, held=held)
    assert outcome["placed"] == result.placed == 4
    assert outcome["missing"] == []
    assert result.largest_error_mm is not None
    assert result.largest_error_mm < 2.0


def test_magnet_waits_until_the_arm_is_at_the_part() -> None:
    example = pick_and_place()
    task = example.task_of({})
    controller = example.Controller(task)
    ends = {stage.text: stage.goal for stage in list(example.plan(task, example.HOME))[:3]}
    # The arm is at the end of each stage, but 0.2° beside the part.
    ends["pick red"] = ends["pick red"] + [0.0035, 0.0, 0.0, 0.0]
    now_s = 0.0
    controller.update(now_s, example.HOME)
    while now_s < 60.0:
        now_s += 0.01
        controller.update(now_s, ends[controller.doing])
    assert (controller.doing, controller.magnet, controller.placed) == ("pick red", False, 0)


def test_timeout_is_reported_with_the_missing_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    example = pick_and_place()
    with VirtualRig() as rig:
        remote = RemoteRig(rig, 0.0, seed=1)
        monkeypatch.setattr(example, "time", remote)
        outcome = example.control(remote, example.Controller(example.task_of({})), 8.0)
    assert outcome["done_s"] is None
    assert 0 < outcome["placed"] < 4
    assert outcome["missing"] == ["red", "blue", "green", "yellow"][outcome["placed"] :]
    sentence = example.sentence({"parts": 4, **outcome})
    assert sentence.startswith(
        f"{outcome['placed']} of 4 parts placed, missing {', '.join(outcome['missing'])}: the time ended during"
    )
    assert repr(outcome["doing"]) in sentence


def test_model_of_the_controller_equals_the_arm() -> None:
    example = pick_and_place()
    rng = np.random.default_rng(3)
    for _ in range(50):
        arm, held = ArmParameters(), rng.uniform(0, 0.5)
        position, speed, acceleration = rng.uniform(arm.lower, arm.upper), rng.normal(size=4), rng.normal(size=4) * 5
        efforts, _ = example.efforts_for(position, speed, acceleration, held)
        np.testing.assert_allclose(forward_dynamics(arm, position, speed, efforts, held), acceleration, atol=1e-9)


def test_default_task_equals_the_default_scene() -> None:
    task = pick_and_place().task_of({})
    scene = PARAMETERS.scene
    assert [part.name for part in task.parts] == [part.name for part in scene.parts]
    for known, part in zip(task.parts, scene.parts, strict=True):
        np.testing.assert_allclose((known.x, known.y, known.yaw), (*part.position[:2], part.yaw), atol=1e-12)
        assert (known.height, known.mass) == (part.size[2], part.mass)
    places = [place for tray in scene.trays for place in tray.places]
    np.testing.assert_allclose([(place.x, place.y, place.z) for place in task.places], places, atol=1e-12)


def test_part_on_magnet_or_beside_its_place_is_not_placed() -> None:
    scene = PARAMETERS.scene
    places = [place for tray in scene.trays for place in tray.places]

    def standing(index: int, place: int, dx: float = 0.0, dz: float = 0.0) -> PartState:
        part, (x, y, z) = scene.parts[index], places[place]
        return PartState(name=part.name, x=x + dx, y=y, z=z + part.size[2] / 2 + dz)

    poses = [standing(0, 0, dx=0.001), standing(1, 1, dx=0.030), standing(2, 2, dz=0.01), standing(3, 3)]
    result = evaluate_placement(scene, poses, held=scene.parts[3].name)
    assert [part.place for part in result.parts] == [0, None, None, None]
    assert evaluate_placement(scene, [standing(2, 2, dz=-0.008)]).placed == 0
    assert result.placed == 1
    assert result.parts[0].error_mm == pytest.approx(1.0)
    assert evaluate_placement(RigParameters().scene, []).largest_error_mm is None


def test_two_parts_cannot_be_placed_on_one_place() -> None:
    scene = PARAMETERS.scene
    x, y, z = scene.trays[0].places[0]
    poses = [PartState(name=part.name, x=x, y=y, z=z + part.size[2] / 2) for part in scene.parts[:2]]
    assert evaluate_placement(scene, poses).placed == 1
