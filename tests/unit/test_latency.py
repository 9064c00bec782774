"""Loop latency: the stages add up, are not negative, and equal the scripted delays."""

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.analysis.samples import CommandMatcher, SampleTable
from hilrig_replay.analysis.stages import STAGES
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.plots.latency_plot import save_plot
from hilrig_runtime.errors import InputError
from hilrig_schemas import JointState, TorqueCommand
from support.recordings import MS, Script, make, record, write


def measured(folder: Path, script: Script) -> LatencyReport:
    return measure(open_run(record(folder / "run.mcap", script)))


def independent_stages(path: Path) -> dict[tuple[int, int], dict[str, int]]:
    """Stages computed from the raw messages with the stock MCAP reader and dictionaries."""
    states, commands = [], {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic == "/state":
                states.append(JointState.FromString(message.data))
            elif channel.topic == "/command":
                command = TorqueCommand.FromString(message.data)
                commands[command.session, command.seq] = command
    sampled = {(state.incarnation, state.step): state.sampled_ns for state in states}
    found = {}
    for state in states:
        if not state.basis_step:
            continue
        command = commands[state.session, state.command_seq]
        loop = state.sampled_ns - sampled[command.basis_incarnation, command.basis_step]
        stages = {
            "register_wait": command.state_served_ns - command.state_arrived_ns - command.state_injected_ns,
            "controller": command.write_arrived_ns - command.state_served_ns,
            "edge": command.sent_ns - command.write_arrived_ns - command.command_injected_ns,
            "injected": command.state_injected_ns + command.command_injected_ns,
            "tick_wait": state.sampled_ns - state.command_arrived_ns,
        }
        found[state.incarnation, state.step] = {"loop": loop, **stages, "transport": loop - sum(stages.values())}
    return found


@pytest.mark.parametrize("delay_ms", [0, 10, 30, 60])
@pytest.mark.parametrize("poll_ms", [5, 20, 33, 100])
def test_measures_the_scripted_delays(tmp_path: Path, delay_ms: float, poll_ms: float) -> None:
    script = Script(seconds=8.0, poll_ms=poll_ms, delay_ms=delay_ms)
    report = measured(tmp_path, script)
    assert report.loop_ms is not None
    assert report.stages_ms["controller"].p50 == pytest.approx(delay_ms + 2 * script.network_ms, abs=1.0)
    # A state waits for the poll, and a command for the tick: at most two steps longer than the controller's delay.
    assert delay_ms <= report.loop_ms.p50 <= delay_ms + 2 * script.step_ms + 1
    assert (
        report.loop_ms.p50 % script.step_ms == pytest.approx(0, abs=0.2) or report.loop_ms.p50 % script.step_ms > 19.8
    )


def test_samples_equal_an_independent_computation(tmp_path: Path) -> None:
    script = Script(seconds=6.0, poll_ms=7.0, injected_state_ms=4.0, injected_command_ms=3.0)
    path = record(tmp_path / "run.mcap", script)
    expected = independent_stages(path)
    table = measure(open_run(path)).table
    assert len(table) == len(expected) > 200
    for row in table[:]:
        assert {name: int(row[name]) for name in ("loop", *STAGES)} == expected[
            int(row["incarnation"]), int(row["step"])
        ]


def test_stages_add_up_exactly_and_are_not_negative(tmp_path: Path) -> None:
    table = measured(tmp_path, Script(seconds=6.0, injected_command_ms=12.5)).table
    assert np.array_equal(sum(table[stage] for stage in STAGES), table["loop"])
    for stage in STAGES:
        assert (table[stage] >= 0).all(), stage


def samples_of(run: Run, rows: int) -> SampleTable:
    matcher, table = CommandMatcher(), SampleTable()
    for block in run.blocks(rows=rows):
        table.add(matcher.add(block.states, block.commands))
    table.finish()
    assert matcher.unmatched == 0
    return table


def test_samples_do_not_depend_on_the_block_size(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=4.0, poll_ms=3.0)))
    whole = samples_of(run, 100_000)[:]
    for rows in (7, 100, 1000):
        assert np.array_equal(samples_of(run, rows)[:], whole), rows


def test_sorts_samples_with_late_commands(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=4.0)))
    whole = samples_of(run, 100_000)[:]
    table = SampleTable()
    for piece in (whole[100:], whole[:40], whole[40:100]):
        table.add(piece)
    table.finish()
    assert np.array_equal(table[:], whole)


def test_report_dict_has_the_documented_keys(tmp_path: Path) -> None:
    plain = json.loads(json.dumps(measured(tmp_path, Script(seconds=12.0)).as_dict()))
    keys = {"p50", "p95", "p99", "p999", "max", "mean", "std"}
    assert plain["samples"] > 500
    assert set(plain["loop_ms"]) == keys
    assert list(plain["stages_ms"]) == list(STAGES)
    assert all(set(statistics) == keys for statistics in plain["stages_ms"].values())
    assert plain["step_ms"] == 20.0
    assert plain["lost"] == {"transport": 0, "recorder": 0, "file": 0}
    assert plain["fit"] is True
    assert plain["reasons"] == []


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (Script(seconds=12.0, lost_transport=3), "3 messages lost in transport to the recorder"),
        (Script(seconds=12.0, lost_recorder=1), "1 message lost in the recorder"),
        (Script(seconds=12.0, clock_steps=2), "2 steps of the wall clock"),
        (Script(seconds=12.0, stalls={200: 130.0}), "1 overrun of the simulation, 6 steps missed"),
        (Script(seconds=2.0), "500 are required for a 99th percentile"),
    ],
)
def test_reports_why_a_recording_is_not_valid(tmp_path: Path, script: Script, words: str) -> None:
    report = measured(tmp_path, script)
    assert not report.fit
    assert any(words in reason.text for reason in report.reasons), report.reasons


def test_counts_a_sequence_gap_as_lost_messages(tmp_path: Path) -> None:
    script = Script(seconds=12.0)
    made = make(script)
    report = measure(open_run(write(tmp_path / "run.mcap", made, script=script, missing={"state": {77, 78}})))
    assert report.lost.transport == 2
    assert any("2 messages lost" in reason.text for reason in report.reasons)


def test_counts_samples_without_a_command(tmp_path: Path) -> None:
    script = Script(seconds=12.0)
    run = open_run(write(tmp_path / "run.mcap", make(script), script=script))
    used = int(run.states["command_seq"][300])
    report = measure(open_run(write(tmp_path / "less.mcap", make(script), script=script, missing={"command": {used}})))
    assert any("the commands of 1 sample are not in the recording" in reason.text for reason in report.reasons)


def test_reports_contradictory_timestamps(tmp_path: Path) -> None:
    script = Script(seconds=12.0)
    made = make(script)
    state = next(one.message for one in made if isinstance(one.message, JointState) and one.message.step == 200)
    state.command_arrived_ns += 40 * MS
    report = measure(open_run(write(tmp_path / "run.mcap", made, script=script)))
    assert any("negative stage duration" in reason.text for reason in report.reasons)


def test_reports_a_lagging_recorder(tmp_path: Path) -> None:
    script = Script(seconds=12.0)
    run = open_run(write(tmp_path / "run.mcap", make(script), script=script, arrival_lag_ns=2_500_000_000))
    assert any("the recorder lagged by up to 2.5 s" in reason.text for reason in measure(run).reasons)


def test_measures_ticks_without_a_controller(tmp_path: Path) -> None:
    report = measure(open_run(record(tmp_path / "run.mcap", Script(seconds=1.0, controllers=False))))
    assert (report.samples, report.loop_ms, report.stages_ms, report.fit) == (0, None, {}, False)
    assert report.reason_text() == "no closed loop: no controller wrote commands in this session"
    assert report.jitter_ms.tick_lateness.max > 0


def test_torques_without_a_basis_do_not_close_a_loop(tmp_path: Path) -> None:
    made = make(Script(seconds=1.0))
    for one in made:
        # A controller that writes and never reads.
        if isinstance(one.message, JointState | TorqueCommand):
            one.message.basis_step = 0
    report = measure(open_run(write(tmp_path / "run.mcap", made, script=Script(seconds=1.0))))
    assert report.reason_text() == (
        "no closed loop: no torque was applied that a controller wrote after it had read a state"
    )


@pytest.mark.parametrize("ending", [".png", ".svg", ".pdf"])
def test_plot_format_follows_the_suffix(tmp_path: Path, ending: str) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=3.0)))
    picture = tmp_path / f"latency{ending}"
    save_plot(measure(run), run, picture)
    begins = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
    assert picture.read_bytes().startswith(begins[ending])


def test_rejects_an_unknown_plot_suffix(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=2.0)))
    with pytest.raises(InputError, match=r"unsupported plot format '\.bmp'; .* must end in \.png, \.svg, \.pdf"):
        save_plot(measure(run), run, tmp_path / "latency.bmp")
