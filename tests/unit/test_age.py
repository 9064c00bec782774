"""Age of the loop: equals an independent computation, contains held commands, and does not depend on the blocks."""

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from hilrig_replay.analysis.age import AgeTable
from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.io.run import Run, open_run
from hilrig_schemas import Event, JointState, TorqueCommand
from support.recordings import MS, Script, TimedMessage, make, record, write

SESSION = "20260101T000000Z-rig1-abcd"


def report_of(folder: Path, script: Script, made: list[TimedMessage] | None = None) -> LatencyReport:
    return measure(open_run(write(folder / "run.mcap", made or make(script), script=script)))


def ages_ms(report: LatencyReport) -> np.ndarray:
    assert report.ages is not None
    return np.concatenate(list(report.ages.ages_ns())) / 1e6


def independent_ages_ns(path: Path) -> list[int]:
    """Ages from the raw messages: each state's command by (session, seq), the tick of its basis by its step."""
    states, commands = [], {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic == "/state":
                states.append(JointState.FromString(message.data))
            elif channel.topic == "/command":
                command = TorqueCommand.FromString(message.data)
                commands[command.session, command.seq] = command
    sampled_ns = {(state.incarnation, state.step): state.sampled_ns for state in states}
    last_new = max(number for number, state in enumerate(states) if state.basis_step)
    ages = []
    for state in states[: last_new + 1]:
        acting = commands.get((state.session, state.command_seq))
        if acting is not None and acting.basis_step:
            ages.append(state.sampled_ns - sampled_ns[acting.basis_incarnation, acting.basis_step])
    return ages


@pytest.mark.parametrize(
    "script",
    [
        Script(seconds=4.0, poll_ms=5.0),
        Script(seconds=6.0, poll_ms=100.0, delay_ms=10.0),
        Script(seconds=4.0, poll_ms=33.0, injected_command_ms=45.0),
        Script(seconds=4.0, edge_stalls={2.0: 200.0}, stalls={50: 130.0}),
    ],
    ids=["fast", "slow", "delayed", "stalled"],
)
def test_ages_equal_an_independent_computation(tmp_path: Path, script: Script) -> None:
    path = record(tmp_path / "run.mcap", script)
    report = measure(open_run(path))
    assert report.ages is not None
    assert np.concatenate(list(report.ages.ages_ns())).tolist() == independent_ages_ns(path)


def table_of(run: Run, rows: int) -> AgeTable:
    table = AgeTable(run)
    for block in run.blocks(rows=rows):
        table.add(block)
    table.finish()
    return table


def test_ages_do_not_depend_on_the_block_size(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=4.0, poll_ms=33.0)))
    whole = table_of(run, 100_000)
    for rows in (7, 100, 1000):
        table = table_of(run, rows)
        assert np.array_equal(np.concatenate(list(table.ages_ns())), np.concatenate(list(whole.ages_ns()))), rows
        assert table.statistics() == whole.statistics(), rows


def test_slow_polling_shows_in_age_and_control_period(tmp_path: Path) -> None:
    report = report_of(tmp_path, Script(seconds=20.0, poll_ms=101.0))
    assert report.loop_ms is not None
    assert report.age_ms is not None
    assert report.loop_ms.p50 == pytest.approx(20, abs=1)
    assert report.age_ms.p50 == pytest.approx(60, abs=5)
    assert report.age_ms.max == pytest.approx(120, abs=1)
    assert report.control_period_ms == pytest.approx(101, abs=1)
    assert report.longest_hold_ms == pytest.approx(120, abs=1)
    assert report.older_than_steps == pytest.approx({"1": 0.8, "2": 0.6, "5": 0.05}, abs=0.06)
    # 500 samples at this period.
    assert report.reasons[-1].text.endswith("record 51 s or longer at your 101 ms period")


def test_period_of_a_fast_controller_is_the_step(tmp_path: Path) -> None:
    for poll_ms in (5.0, 15.0):
        report = report_of(tmp_path, Script(seconds=6.0, poll_ms=poll_ms))
        assert report.control_period_ms == pytest.approx(20, abs=0.5), poll_ms


def test_pauses_show_in_the_age_and_not_in_the_loop_latency(tmp_path: Path) -> None:
    script = Script(seconds=20.0, poll_ms=20.0, edge_stalls={1.5 * number: 200.0 for number in range(1, 13)})
    report = report_of(tmp_path, script)
    assert report.loop_ms is not None
    assert report.age_ms is not None
    assert report.loop_ms.p99 < 50
    assert report.age_ms.p95 > 140
    assert report.age_ms.p99 > 190
    assert report.control_period_ms == pytest.approx(20, abs=1)
    assert not report.fit
    assert "age_inconsistent" in {reason.code for reason in report.reasons}


@pytest.mark.parametrize("emulated", [False, True])
def test_emulated_losses_explain_pauses(tmp_path: Path, emulated: bool) -> None:
    script = Script(seconds=20.0, poll_ms=20.0)
    made = make(script)
    # A burst of 8 of 40 commands is lost.
    lost = {one.message.seq for one in made if isinstance(one.message, TorqueCommand) and one.message.seq % 40 >= 32}
    kept: list[TimedMessage] = []
    number = 0
    for one in made:
        message = one.message
        if isinstance(message, TorqueCommand):
            if message.seq in lost:
                continue
            number += 1
            message.seq = message.seq if emulated else number
        elif isinstance(message, JointState) and message.command_seq:
            if message.command_seq in lost:
                message.basis_step = message.loop_latency_ns = message.command_arrived_ns = 0
                message.command_seq = message.command_seq // 40 * 40 + 31
            if not emulated:
                message.command_seq -= sum(seq <= message.command_seq for seq in lost)
        kept.append(one)
    report = report_of(tmp_path, script, kept)
    assert report.age_ms is not None
    assert report.age_ms.p99 > 150
    assert ("age_inconsistent" in {reason.code for reason in report.reasons}) == (not emulated)


def closing(made: list[TimedMessage], last_ms: float, silent_ms: float) -> list[TimedMessage]:
    """The messages without commands after `last_ms`, and a lease that is lost `silent_ms` after the last command."""
    commands = [one for one in made if isinstance(one.message, TorqueCommand)]
    kept = [one for one in commands if one.publish_wall_ns - made[0].publish_wall_ns <= last_ms * MS]
    last = kept[-1].message
    assert isinstance(last, TorqueCommand)
    found: list[TimedMessage] = []
    for one in made:
        message = one.message
        if isinstance(message, TorqueCommand) and message.seq > last.seq:
            continue
        if isinstance(message, JointState) and message.command_seq >= last.seq:
            if message.command_seq > last.seq:
                message.basis_step = message.loop_latency_ns = message.command_arrived_ns = 0
            message.command_seq = last.seq
        found.append(one)
    event = Event(rig="rig1", session=SESSION, kind=Event.LEASE_LOST, source="edge/1")
    event.wall_ns = last.wall_ns + round(silent_ms * MS)
    found.append(TimedMessage("event", event.wall_ns, event))
    return sorted(found, key=lambda one: one.publish_wall_ns)


@pytest.mark.parametrize("silent_ms", [1, 300])
def test_ends_when_the_controller_loses_the_lease(tmp_path: Path, silent_ms: float) -> None:
    script = Script(seconds=8.0, poll_ms=10.0)
    report = report_of(tmp_path, script, closing(make(script), 4000, silent_ms))
    # The last torque is held for the other half of the recording.
    assert ages_ms(report).max() == pytest.approx(20 + silent_ms, abs=25)
    assert report.longest_hold_ms == pytest.approx(max(silent_ms, 20), abs=25)


def without_basis(made: list[TimedMessage], first_s: float, last_s: float) -> None:
    """Remove the basis of the commands in a range of time."""
    begin_ns, removed = made[0].publish_wall_ns, set()
    for one in made:
        if isinstance(one.message, TorqueCommand) and first_s <= (one.publish_wall_ns - begin_ns) / 1e9 < last_s:
            removed.add(one.message.seq)
            one.message.basis_step = one.message.basis_incarnation = 0
    for one in made:
        if isinstance(one.message, JointState) and one.message.command_seq in removed:
            one.message.basis_step = one.message.loop_latency_ns = one.message.command_arrived_ns = 0


@pytest.mark.parametrize(
    ("first_s", "last_s"), [(0.0, 2.0), (5.0, 7.0), (17.92, 20.0)], ids=["at the start", "within the run", "at the end"]
)
def test_commands_without_basis_are_uncontrolled(tmp_path: Path, first_s: float, last_s: float) -> None:
    script = Script(seconds=20.0, poll_ms=10.0)
    made = make(script)
    without_basis(made, first_s, last_s)
    report = report_of(tmp_path, script, made)
    assert report.uncontrolled_share == pytest.approx(0.1, abs=0.005)
    assert report.age_ms is not None
    assert report.age_ms.max < 41
    (reason,) = report.reasons
    assert (reason.code, reason.text) == (
        "uncontrolled",
        f"no command with a basis acted on {report.uncontrolled_share:.1%} of the steps",
    )


def test_zero_torque_of_the_simulation_is_uncontrolled(tmp_path: Path) -> None:
    script = Script(seconds=12.0, poll_ms=10.0)
    made = make(script)
    for one in made:
        if isinstance(one.message, JointState) and 200 <= one.message.step < 260:
            one.message.safe = True
    report = report_of(tmp_path, script, made)
    assert report.uncontrolled_share == pytest.approx(60 / 595, abs=0.002)


def test_steps_after_lost_states_have_no_age(tmp_path: Path) -> None:
    script = Script(seconds=6.0, poll_ms=100.0)
    run = open_run(write(tmp_path / "run.mcap", make(script), script=script, missing={"state": set(range(100, 106))}))
    report = measure(run)
    assert report.age_ms is not None
    assert report.age_ms.max < 121
    assert report.uncontrolled_share == 0


def test_json_has_the_documented_keys(tmp_path: Path) -> None:
    plain = json.loads(json.dumps(report_of(tmp_path, Script(seconds=12.0)).as_dict()))
    assert set(plain["age_ms"]) == {"p50", "p95", "p99", "p999", "max", "mean", "std"}
    assert plain["control_period_ms"] == pytest.approx(20, abs=0.1)
    assert plain["longest_hold_ms"] == pytest.approx(20, abs=1)
    assert plain["uncontrolled_share"] == 0
    assert set(plain["older_than_steps"]) == {"1", "2", "5"}


def test_run_without_a_controller_has_no_age(tmp_path: Path) -> None:
    report = report_of(tmp_path, Script(seconds=1.0, controllers=False))
    assert (report.age_ms, report.control_period_ms, report.uncontrolled_share) == (None, None, None)
