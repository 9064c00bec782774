"""Unit tests of the simulation loop in simulated time: order, timestamps, states and events."""

import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from hilrig_runtime.config.lab import ArmConfig, LabConfig, RigSettings, SimConfig, parse_lab
from hilrig_runtime.errors import InputError
from hilrig_runtime.timing.rate import Rate
from hilrig_schemas import Event
from hilrig_sim.arm.model import RigParameters
from hilrig_sim.events import SimulationEvents
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.limits import PlantEvent, PlantEventKind
from hilrig_sim.plant.plant import Plant
from support.virtual_rig import VirtualRig


@pytest.fixture
def rig() -> Iterator[VirtualRig]:
    with VirtualRig() as virtual:
        yield virtual


def test_steps_have_number_incarnation_and_timestamps(rig: VirtualRig) -> None:
    rig.tick(3)
    assert [state.step for state in rig.states] == [1, 2, 3]
    assert {state.incarnation for state in rig.states} == {rig.service.incarnation}
    steps_ns = np.diff([state.sampled_ns for state in rig.states])
    assert set(steps_ns.tolist()) == {20_000_000}
    assert rig.states[-1].wall_ns - rig.states[-1].sampled_ns == rig.clock.wall_ns() - rig.clock.monotonic_ns()
    assert rig.states[-1].lateness_ns == 0


def test_state_is_published_before_its_step_with_its_effort(rig: VirtualRig) -> None:
    rig.tick()
    rig.command((1.0, 0.5, -5.0, 0.0))
    applied = rig.tick()
    assert list(applied.effort) == [1.0, 0.5, -5.0, 0.0]
    assert list(applied.position[:2]) == [0.0, 0.0]
    following = rig.tick()
    plant = Plant([rig.parameters[0]])
    plant.set_state(0, applied.position, applied.velocity)
    plant.step(np.array([applied.effort]).T, np.array([False]))
    assert list(following.position) == plant.position[:, 0].tolist()
    assert list(following.velocity) == plant.velocity[:, 0].tolist()
    assert list(following.integration_error) == plant.error[:, 0].tolist()


def test_loop_latency_is_time_from_basis_to_new_command(rig: VirtualRig) -> None:
    rig.tick(5)
    rig.clock.advance(7_000_000)
    rig.command(basis_step=3)
    arrived_ns = rig.clock.monotonic_ns()
    state = rig.tick()
    assert (state.basis_step, state.command_arrived_ns, state.command_seq) == (3, arrived_ns, 1)
    assert state.loop_latency_ns == state.sampled_ns - rig.states[2].sampled_ns > 0
    assert state.sampled_ns >= state.command_arrived_ns
    after = rig.tick()
    assert (after.basis_step, after.command_arrived_ns, after.loop_latency_ns, after.command_seq) == (0, 0, 0, 1)


def test_report_has_the_age_of_the_basis_at_each_step(rig: VirtualRig) -> None:
    rig.tick(3)
    rig.command((1.0, 0.0, 0.0, 0.0), basis_step=2)
    rig.tick(3)
    (report,) = rig.service.health.rig_reports()
    assert (list(report.loop_us), list(report.age_us)) == ([40_000], [40_000, 60_000, 80_000])
    # The command is held over the report, and another one without a basis replaces it.
    rig.tick(2)
    rig.command((2.0, 0.0, 0.0, 0.0))
    rig.tick(2)
    rig.command((3.0, 0.0, 0.0, 0.0), basis_step=10)
    rig.tick(2)
    (report,) = rig.service.health.rig_reports()
    assert (list(report.loop_us), list(report.age_us)) == ([20_000], [100_000, 120_000, 20_000, 40_000])


def test_timed_out_command_has_no_age(rig: VirtualRig) -> None:
    rig.tick(2)
    rig.command((1.0, 0.0, 0.0, 0.0), basis_step=2)
    timeout_steps = rig.lab.sim.command_timeout_ns // rig.lab.sim.step_ns
    rig.tick(timeout_steps + 20)
    (report,) = rig.service.health.rig_reports()
    assert report.safe
    assert timeout_steps <= len(report.age_us) <= timeout_steps + 2


def test_unknown_basis_gives_no_latency(rig: VirtualRig) -> None:
    rig.tick(2)
    for step, incarnation in ((99, None), (1, 5), (0, None)):
        rig.command(basis_step=step, basis_incarnation=incarnation)
        state = rig.tick()
        assert (state.basis_step, state.loop_latency_ns) == (0, 0)
        assert state.command_arrived_ns > 0


def test_lost_and_resumed_commands_are_reported(rig: VirtualRig) -> None:
    rig.command((1.0, 0.0, 0.0, 0.0))
    assert not rig.tick().safe
    rig.tick(31)
    state = rig.states[-1]
    assert state.safe
    assert list(state.effort) == [0.0] * 4
    rig.command((1.0, 0.0, 0.0, 0.0), repeat=True)
    assert list(rig.tick().effort) == [1.0, 0.0, 0.0, 0.0]
    reported = [event for event in rig.events if event.kind in (Event.COMMAND_LOST, Event.COMMAND_BACK)]
    assert [event.kind for event in reported] == [Event.COMMAND_LOST, Event.COMMAND_BACK]
    assert reported[0].watchdog_data.timeout_ns == 600_000_000
    assert reported[0].watchdog_data.silent_ns > 600_000_000
    assert reported[0].session == "session"


def test_reset_is_executed_at_its_tick(rig: VirtualRig) -> None:
    rig.command((3.0, -2.0, -5.5, 0.2))
    rig.tick(20)
    rig.command((3.0, -2.0, -5.5, 0.2), resets=1)
    state = rig.tick()
    assert list(state.position) == [0.0] * 4
    assert list(state.velocity) == [0.0] * 4
    assert len(state.parts) == 4
    (reset,) = [event for event in rig.events if event.kind == Event.RESET]
    assert reset.step == state.step


def test_parts_are_published_at_start_and_once_per_second(rig: VirtualRig) -> None:
    rig.tick(120)
    steps = [state.step for state in rig.states if state.parts]
    assert steps[0] == 1
    assert np.diff(steps).tolist() == [50, 50]
    assert [part.name for part in rig.states[0].parts] == ["red", "blue", "green", "yellow"]


def test_contact_of_the_quill_is_reported_once(rig: VirtualRig) -> None:
    rig.tick(100)
    (hit,) = [event for event in rig.events if event.kind == Event.LIMIT_HIT]
    assert (hit.limit_data.joint, hit.limit_data.upper) == (0, True)
    shows = next(state for state in rig.states if state.limit_flags & 256)
    assert hit.step == shows.step
    assert "mm/s" in hit.text


def test_stall_is_one_overrun_with_its_missed_steps(rig: VirtualRig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.tick(3)
    monkeypatch.setattr(rig.service.health, "take_run_delay", lambda: 90_000_000)
    rig.clock.advance(130_000_000)
    state = rig.tick()
    assert state.missed_steps == 5
    assert state.step == 4
    # Of a punctual tick it is not read.
    assert (rig.states[-2].run_delay_ns, state.run_delay_ns) == (0, 90_000_000)
    (overrun,) = [event for event in rig.events if event.kind == Event.OVERRUN]
    assert overrun.overrun_data.missed_steps == 5
    # Lateness against the original deadline, not the one after the skipped steps.
    behind_ns = state.lateness_ns + 5 * 20_000_000
    assert overrun.overrun_data.lateness_ns == behind_ns
    assert overrun.text == f"simulation overrun: up to {behind_ns / 1e6:.1f} ms late, 5 steps skipped"
    rig.tick()
    assert rig.states[-1].missed_steps == 0
    assert rig.service.counters.overruns == 1


def test_long_stall_is_an_event_of_each_rig() -> None:
    with VirtualRig(LabConfig(rigs=(RigSettings(name="rig1"), RigSettings(name="rig2")))) as rig:
        rig.tick(3)
        rig.clock.advance(14_000_000_000)
        rig.tick()
        stalls = [event for event in rig.events if event.kind == Event.OVERRUN]
        assert sorted(event.rig for event in stalls) == ["rig1", "rig2"]
        assert {event.overrun_data.missed_steps for event in stalls} == {rig.states[-1].missed_steps}


def test_burst_of_overruns_is_reported_together(rig: VirtualRig) -> None:
    for _ in range(30):
        rig.clock.advance(50_000_000)
        rig.tick()
    late = [state for state in rig.states if state.missed_steps]
    # The last ones are reported a second later, without a further overrun.
    rig.tick(110)
    reported = [event for event in rig.events if event.kind == Event.OVERRUN]
    assert 2 <= len(reported) <= 3
    assert rig.service.counters.overruns == 30
    assert sum(event.overrun_data.missed_steps for event in reported) == sum(state.missed_steps for state in late)
    assert reported[-1].step == late[-1].step
    # The counters have restarted: the next event has the lateness of the next overrun.
    rig.clock.advance(45_000_000)
    state = rig.tick()
    last = [event for event in rig.events if event.kind == Event.OVERRUN][-1]
    assert last.step == state.step
    assert last.overrun_data.lateness_ns == state.lateness_ns + state.missed_steps * 20_000_000 < 30_000_000


def test_lateness_of_state_is_that_of_its_timestamp(rig: VirtualRig) -> None:
    rate = Rate(rig.lab.sim.step_ns, rig.clock)
    tick = rate.wait()
    rig.clock.advance(3_000_000)
    rig.simulation.tick(tick)
    assert rig.states[-1].lateness_ns == 3_000_000
    assert rig.states[-1].sampled_ns == tick.deadline_ns + 3_000_000


def test_chattering_joint_is_reported_once_per_period() -> None:
    reported: list[Event] = []
    events = SimulationEvents(reported.append, ["rig1"], Plant([RigParameters()]))
    hit = PlantEvent(PlantEventKind.LIMIT_HIT, 0, joint=1, upper=True, speed=0.5)
    for now_ms in (0, 400, 1200, 2080, 3200):
        events.report_plant_events([hit], now_ms, now_ms * 1_000_000, ["session"])
    assert [event.step for event in reported] == [0, 1200, 3200]
    assert [event.text for event in reported] == [
        "joint 1 hit its upper stop at 29 °/s",
        "joint 1 hit its upper stop at 29 °/s (2 times)",
        "joint 1 hit its upper stop at 29 °/s (2 times)",
    ]
    events.report_plant_events([replace(hit, upper=False), replace(hit, joint=2)], 3201, 3_201_000_000, ["session"])
    assert [event.text for event in reported[3:]] == [
        "joint 1 hit its lower stop at 29 °/s",
        "joint 2 hit its upper stop at 29 °/s",
    ]


def test_diverged_rig_is_reset_to_the_start() -> None:
    arm = ArmConfig(masses_kg=(0.05, 0.02, 0.02), friction=(0.01, 0.01, 0.1, 0.01))
    with (
        VirtualRig(LabConfig(sim=SimConfig(substeps=1), rigs=(RigSettings(arm=arm),))) as rig,
        np.errstate(all="ignore"),
    ):
        for turn in range(300):
            rig.command([32.0, -32.0, 0.0, 1.0] if turn % 2 else [-32.0, 32.0, 0.0, 1.0])
            rig.tick()
            if "RESET" in rig.kinds():
                break
        reset = rig.events[rig.kinds().index("RESET")]
        assert reset.severity == Event.ERROR
        state = rig.tick()
    assert state.step == reset.step
    assert list(state.position) == [0.0] * 4


def test_inaccurate_steps_are_counted_and_reported_once_a_second() -> None:
    with VirtualRig(LabConfig(sim=SimConfig(substeps=1))) as rig:
        for turn in range(40):
            rig.command([16.0, -16.0, -4.9, 0.0] if turn % 2 else [-16.0, 16.0, -4.9, 0.0])
            state = rig.tick()
        assert state.substeps == 1
        reports = [event for event in rig.events if event.kind == Event.INACCURATE_STEP]
        assert len(reports) == 1
        assert reports[0].severity == Event.WARNING
        assert reports[0].rig == "rig1"
        assert reports[0].integration_data.steps == 1
        assert max(reports[0].integration_data.error[:2]) > np.radians(0.1)
        assert "inaccurate step: the estimated error of joint" in reports[0].text
        assert rig.service.counters.inaccurate_steps > 5


def test_automatic_substeps_are_accurate_and_published() -> None:
    with VirtualRig(LabConfig()) as rig:
        for turn in range(40):
            rig.command([16.0, -16.0, -4.9, 0.0] if turn % 2 else [-16.0, 16.0, -4.9, 0.0])
            assert rig.tick().substeps >= 2
        assert "INACCURATE_STEP" not in rig.kinds()
        assert rig.service.counters.inaccurate_steps == 0


def test_rigs_apply_their_own_commands_only() -> None:
    lab = LabConfig(rigs=(RigSettings(name="a"), RigSettings(name="b")))
    with VirtualRig(lab) as rig:
        rig.command((2.0, 0.0, -4.9, 0.0), rig="b")
        rig.tick(20)
        last = {state.rig: state for state in rig.states}
    assert last["a"].position[0] == 0.0
    assert last["b"].position[0] > 0.05
    assert last["a"].safe
    assert not last["b"].safe


def test_parameters_survive_json() -> None:
    parameters = rig_parameters(LabConfig(), RigSettings())
    assert RigParameters.from_json(parameters.to_json()) == parameters
    assert json.loads(parameters.to_json())["scene"]["parts"][0]["name"] == "red"
    for text in ("", "{}", "[]", '{"arm": {}, "sim": {}, "scene": {"parts": [{"name": 1}], "trays": []}}'):
        with pytest.raises(InputError, match="invalid rig parameters"):
            RigParameters.from_json(text)


def test_unstable_step_is_rejected_with_the_rig() -> None:
    lab = LabConfig(sim=SimConfig(step_ms=40, substeps=1))
    with pytest.raises(InputError, match=r"rig 'rig1': the step of 40 ms would be unstable.*sim\.substeps = 2"):
        rig_parameters(lab, lab.rigs[0])


def test_command_after_pre_encoding_acts_at_the_tick() -> None:
    with VirtualRig(parse_lab("[rigs]\ncount = 20\n")) as rig:
        rate = Rate(rig.lab.sim.step_ns, rig.clock)
        for early, late in ((0.25, 0.5), (0.75, 1.0)):
            rig.command((early, 0.0, 0.0, 0.0), rig="rig20")
            rig.simulation.pre_encode(rate.next_ns)
            rig.command((late, 0.0, 0.0, 0.0), rig="rig20")
            tick = rate.wait()
            rig.simulation.tick(tick)
            assert (tick.lateness_ns, rig.states[-1].rig, rig.states[-1].effort[0]) == (0, "rig20", late)
            assert rig.states[-2].effort[0] == 0.0
