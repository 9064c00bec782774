"""Verification: a recording is reproduced bit for bit, and each change is found at its step."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.analysis.verify import OTHER_PLATFORM_TOLERANCE, verify
from hilrig_runtime.errors import InputError
from hilrig_schemas import Event, JointState, TorqueCommand
from hilrig_sim.platform_fingerprint import machine_name
from support.recordings import TimedMessage, record, write
from support.virtual_rig import VirtualRig, run_controller


@pytest.fixture(scope="module")
def run() -> list[TimedMessage]:
    """The pick-and-place example, then a reset, an impact on the joint limits, and a falling quill."""
    with VirtualRig() as rig:
        run_controller(rig, 14.0, state_delay_ms=10, command_delay_ms=10)
        rig.command((0, 0, -5, 0), resets=0)
        rig.tick(20)
        rig.command((20, -8, 3, 1), magnet=True, resets=1)
        rig.tick(100)
        rig.command((-20, 8, -9, -1), resets=1)
        rig.tick(100)
        return rig.recorded()


def states(made: list[TimedMessage]) -> list[JointState]:
    return [one.message for one in made if isinstance(one.message, JointState)]


def copied(made: list[TimedMessage]) -> list[TimedMessage]:
    copies = []
    for one in made:
        message = type(one.message)()
        message.CopyFrom(one.message)
        copies.append(TimedMessage(one.topic, one.publish_wall_ns, message))
    return copies


def test_verifies_picks_stops_and_a_reset_bit_for_bit(run: list[TimedMessage], tmp_path: Path) -> None:
    kinds = {one.message.kind for one in run if isinstance(one.message, Event)}
    assert len(kinds) >= 4
    found = verify(write(tmp_path / "run.mcap", run), tolerance=0.0)
    assert found.same
    assert found.exact
    assert found.gaps == 0
    assert found.largest_deviation == (0.0, 0.0, 0.0, 0.0)
    # A reset starts a new interval, and the last state has no successor.
    assert found.steps == len(states(run)) - 2
    assert "bit-identical" in found.sentence()


@pytest.mark.parametrize("row", [40, 333, 700])
def test_finds_the_step_of_a_changed_effort(run: list[TimedMessage], tmp_path: Path, row: int) -> None:
    changed = copied(run)
    state = states(changed)[row]
    state.effort[1] += 0.001
    found = verify(write(tmp_path / "run.mcap", changed), tolerance=0.0)
    assert not found.same
    assert not found.exact
    assert found.first_diverging_step == state.step
    assert found.largest_deviation[1] > 1e-8
    assert f"step {state.step} does not lead" in found.sentence()
    assert not verify(tmp_path / "run.mcap", tolerance=OTHER_PLATFORM_TOLERANCE).same


def test_finds_the_step_before_a_changed_position(run: list[TimedMessage], tmp_path: Path) -> None:
    changed = copied(run)
    state = states(changed)[500]
    state.position[0] = np.nextafter(state.position[0], 10)
    found = verify(write(tmp_path / "run.mcap", changed), tolerance=0.0)
    assert found.first_diverging_step == state.step - 1
    assert verify(tmp_path / "run.mcap", tolerance=1e-9).same


def test_finds_a_changed_part_position(run: list[TimedMessage], tmp_path: Path) -> None:
    changed = copied(run)
    state = next(state for state in states(changed)[300:] if state.parts)
    state.parts[0].x += 0.001
    found = verify(write(tmp_path / "run.mcap", changed), tolerance=0.0)
    assert not found.same
    assert found.largest_part_deviation == pytest.approx(0.001)


def test_missing_states_are_gaps_not_divergence(run: list[TimedMessage], tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", run, missing={"state": {20, 21, 400}})
    found = verify(path, tolerance=0.0)
    assert found.same
    assert found.exact
    assert found.gaps == 2
    assert 0 < found.skipped < 120
    assert "2 gaps" in found.sentence()


def test_a_simulation_restart_is_a_gap(run: list[TimedMessage], tmp_path: Path) -> None:
    restarted = copied(run)
    for state in states(restarted)[200:]:
        state.incarnation += 1
        # The restarted simulation has another state.
        state.position[3] += 0.5
    found = verify(write(tmp_path / "run.mcap", restarted), tolerance=0.0)
    assert found.gaps == 1
    assert found.first_diverging_step != states(restarted)[199].step


def test_finds_a_changed_held_part(run: list[TimedMessage], tmp_path: Path) -> None:
    changed = copied(run)
    state = next(state for state in states(changed) if state.held_part == "blue")
    state.held_part = "red"
    found = verify(write(tmp_path / "run.mcap", changed), tolerance=0.0)
    assert found.first_diverging_step == state.step - 1
    assert found.largest_part_deviation == np.inf


def _change_limit_flags(state: JointState) -> None:
    state.limit_flags ^= 1


def _change_integration_error(state: JointState) -> None:
    state.integration_error[0] += 1e-6


def _change_substeps(state: JointState) -> None:
    state.substeps += 1


def _change_external_force(state: JointState) -> None:
    state.external_force_z += 0.5


def _change_part_yaw(state: JointState) -> None:
    state.parts[0].yaw += 0.01


def _change_part_velocity(state: JointState) -> None:
    state.parts[0].vx += 0.01


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (_change_limit_flags, "limit flags"),
        (_change_integration_error, "integration error"),
        (_change_substeps, "sub-steps"),
        (_change_external_force, "external wrench"),
        (_change_part_yaw, "parts"),
        (_change_part_velocity, "parts"),
    ],
)
def test_finds_a_change_of_each_published_field(
    run: list[TimedMessage], tmp_path: Path, change: Callable[[JointState], None], field: str
) -> None:
    changed = copied(run)
    state = next(state for state in states(changed)[300:] if state.parts)
    change(state)
    found = verify(write(tmp_path / "run.mcap", changed), tolerance=0.0)
    assert not found.same
    assert set(found.differing) == {field}
    assert found.first_diverging_step == state.step - 1
    assert f"{field} ({found.differing[field]} state" in found.sentence()


def test_finds_a_command_that_differs_from_its_state(run: list[TimedMessage], tmp_path: Path) -> None:
    made = commands_of(run)
    assert verify(write(tmp_path / "run.mcap", [*run, *made]), tolerance=0.0).same
    first, second = made[200].message, made[300].message
    assert isinstance(first, TorqueCommand)
    assert isinstance(second, TorqueCommand)
    first.effort[0] += 0.001
    second.magnet = not second.magnet
    found = verify(write(tmp_path / "run.mcap", [*run, *made]), tolerance=0.0)
    assert not found.same
    assert found.differing == {"effort or magnet of the command": 2}
    assert "differing from the recording: effort or magnet of the command (2 states)" in found.sentence()


def _change_loop_latency(state: JointState) -> None:
    state.loop_latency_ns -= 1_000_000


def _change_basis_step(state: JointState) -> None:
    state.basis_step += 1


def _change_lateness(state: JointState) -> None:
    state.lateness_ns += 1


def _change_sampling_time(state: JointState) -> None:
    state.sampled_ns += 1_000_000


def _change_missed_steps(state: JointState) -> None:
    state.missed_steps += 1


def _change_safe(state: JointState) -> None:
    state.safe = True


@pytest.mark.parametrize(
    ("change", "fields"),
    [
        (_change_loop_latency, {"loop latency"}),
        (_change_basis_step, {"loop latency"}),
        (_change_lateness, {"tick time"}),
        (_change_sampling_time, {"loop latency", "tick time"}),
        (_change_missed_steps, {"tick time"}),
        (_change_safe, {"effort or magnet of the command"}),
    ],
)
def test_finds_a_change_of_the_times(
    run: list[TimedMessage], tmp_path: Path, change: Callable[[JointState], None], fields: set[str]
) -> None:
    changed = copied(based(run))
    assert verify(write(tmp_path / "run.mcap", changed), tolerance=0.0).same
    change(next(state for state in states(changed)[300:] if state.loop_latency_ns))
    found = verify(write(tmp_path / "run.mcap", changed), tolerance=0.0)
    assert not found.same
    assert set(found.differing) == fields


def based(made: list[TimedMessage]) -> list[TimedMessage]:
    """Return a run whose new commands are based on the state two steps before."""
    changed = copied(made)
    before: list[JointState] = []
    for state in states(changed):
        if len(before) > 1 and state.command_seq != before[-1].command_seq:
            state.basis_step = before[-2].step
            state.loop_latency_ns = state.sampled_ns - before[-2].sampled_ns
        before.append(state)
    return changed


def commands_of(made: list[TimedMessage]) -> list[TimedMessage]:
    """Return the commands that act at the states."""
    commands: dict[tuple[str, int], TimedMessage] = {}
    for one in made:
        state = one.message
        if isinstance(state, JointState) and state.command_seq and not state.safe:
            command = TorqueCommand(
                rig=state.rig,
                session=state.session,
                seq=state.command_seq,
                effort=list(state.effort),
                magnet=state.magnet,
            )
            commands.setdefault(
                (state.session, state.command_seq), TimedMessage("command", one.publish_wall_ns, command)
            )
    return list(commands.values())


def test_reports_fields_that_an_old_recording_lacks(run: list[TimedMessage], tmp_path: Path) -> None:
    old = copied(run)
    for state in states(old):
        state.ClearField("substeps")
    found = verify(write(tmp_path / "run.mcap", old), tolerance=0.0)
    assert found.same
    assert found.not_checked == ("sub-steps",)
    assert found.sentence().endswith("bit-identical to the recording; not in the recording, not checked: sub-steps")


def test_default_tolerance_depends_on_the_platform(run: list[TimedMessage], tmp_path: Path) -> None:
    found = verify(write(tmp_path / "run.mcap", run))
    assert found.machine != machine_name()
    assert found.tolerance == OTHER_PLATFORM_TOLERANCE


def test_rejects_a_run_not_made_by_the_model(tmp_path: Path) -> None:
    found = verify(record(tmp_path / "run.mcap"))
    assert not found.same
    assert found.first_diverging_step == 1


def test_reports_a_recording_without_parameters(run: list[TimedMessage], tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", run, metadata={"hilrig.config": {"step_ns": "20000000"}})
    with pytest.raises(InputError, match="does not contain the parameters"):
        verify(path)


def test_verifies_an_hour_in_less_than_half_a_minute(tmp_path: Path) -> None:
    with VirtualRig() as rig:
        for second in range(60):
            rig.command(np.sin(second + np.arange(4.0)) * (1, 1, 3, 0.05) - (0, 0, 4.9, 0))
            rig.tick(50)
    path = write(tmp_path / "run.mcap", rig.recorded())
    begin_s = time.process_time()
    found = verify(path, tolerance=0.0)
    took_s = time.process_time() - begin_s
    assert found.exact
    assert 3600 / 60 * took_s < 30
