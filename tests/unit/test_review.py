"""Summaries, comparisons and reports of scripted runs with known values; reports are self-contained pages."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.analysis.compare import Origin, compare, find_origin
from hilrig_replay.analysis.stages import LOOP_STAGES
from hilrig_replay.analysis.summary import TRAJECTORY_POINTS, summarize, under_command
from hilrig_replay.export.foxglove_messages import LOG_LEVELS
from hilrig_replay.geometry.scene import tool_positions
from hilrig_replay.io.paths import display_names
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.plots.comparison_plot import save_comparison_plot
from hilrig_replay.plots.palette import EVENT_COLORS, SEVERITY_COLORS
from hilrig_replay.report.report import build_report
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.errors import InputError
from hilrig_schemas import Event, JointState, TorqueCommand
from support.recordings import PARAMETERS, Script, TimedMessage, make, position, record, write


def named(folder: Path, name: str, script: Script, made: list[TimedMessage] | None = None) -> Run:
    made = made or make(script)
    for one in made:
        if getattr(one.message, "session", ""):
            one.message.session = name  # type: ignore[attr-defined]
    return open_run(write(folder / f"{name}.mcap", made, script=script, session=name))


def test_summary_has_the_scripted_motion(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=10.0)))
    summary = summarize(run)
    t = np.arange(0, 10.0, 0.001)
    path = tool_positions(PARAMETERS.arm, np.array([position(seconds) for seconds in t]))
    assert summary.motion.tool_path_m == pytest.approx(np.linalg.norm(np.diff(path, axis=0), axis=1).sum(), rel=0.01)
    # Trapezoidal rule: the effort is constant over a step, the speed is not.
    speed, effort = np.abs(run.states["velocity"]), np.abs(run.states["effort"])
    rows = np.flatnonzero(acting(run)[:-1])
    work = (effort[rows] * (speed[rows] + speed[rows + 1]) / 2).sum() * 0.02
    assert summary.motion.work_j == pytest.approx(work)
    assert summary.motion.saturated_share == (0, 0, 0, 0)
    assert (summary.events, summary.alarms) == ({"SESSION_END": {"INFO": 1}, "SESSION_START": {"INFO": 1}}, 0)
    assert summary.placement is not None
    assert (summary.placement.placed, len(summary.placement.parts)) == (0, 4)


def test_saturation_is_the_share_of_steps_at_the_limit(tmp_path: Path) -> None:
    script = Script(seconds=4.0)
    made = make(script)
    states = [one.message for one in made if isinstance(one.message, JointState)]
    for state in states[:50]:
        state.effort[2] = -32.767
    summary = summarize(named(tmp_path, "run", script, made))
    run = open_run(tmp_path / "run.mcap")
    acts = acting(run)[:-1]
    share = (acts & (run.states["effort"][:-1, 2] == -32.767)).sum() / acts.sum()
    assert 0.2 < share < 0.26
    assert summary.motion.saturated_share == (0, 0, pytest.approx(share), 0)
    assert summary.motion.peak_effort[2] == 32.767


def acting(run: Run) -> np.ndarray:
    """Return at which states a controller acts."""
    return np.asarray(under_command(run, run.states) & (run.states["effort"] != 0).any(axis=1))


def test_quill_that_falls_after_the_controller_does_not_count(tmp_path: Path) -> None:
    script = Script(seconds=4.0)
    made = make(script)
    expected = summarize(named(tmp_path, "whole", script, made)).motion
    states = [one.message for one in made if isinstance(one.message, JointState)]
    for number, state in enumerate(states[-20:]):
        # Zero torque of the watchdog: the quill falls at 2 m/s.
        state.effort[:] = (0.0, 0.0, 0.0, 0.0)
        state.position[2] += 0.04 * number
        state.velocity[2] = 2.0
    motion = summarize(named(tmp_path, "fallen", script, made)).motion
    assert motion.top_speed == pytest.approx(expected.top_speed, rel=0.05)
    assert motion.tool_path_m < expected.tool_path_m
    assert motion.work_j < expected.work_j


def test_trajectory_length_is_bounded(tmp_path: Path) -> None:
    script = Script(seconds=10.0, step_ms=1.0, poll_ms=50.0)
    trajectory = summarize(named(tmp_path, "run", script)).trajectory
    assert TRAJECTORY_POINTS <= len(trajectory.time_s) < 2 * TRAJECTORY_POINTS
    assert np.allclose(np.diff(trajectory.time_s), trajectory.time_s[1], atol=2e-4)


def test_identical_runs_have_no_differences(tmp_path: Path) -> None:
    script = Script(seconds=4.0)
    (difference,) = compare([named(tmp_path, "one", script), named(tmp_path, "two", script)]).differences
    assert difference.position_max == (0, 0, 0, 0)
    assert difference.tool_max_mm == 0
    assert difference.effort_rms == (0, 0, 0, 0)
    assert (difference.loop_p50_ms, difference.loop_p99_ms) == (0, 0)


def test_inserted_difference_is_found(tmp_path: Path) -> None:
    script = Script(seconds=4.0)
    made = make(script)
    for one in made:
        if isinstance(one.message, JointState):
            one.message.position[2] += 0.005
    other = named(tmp_path, "two", script, made)
    (difference,) = compare([named(tmp_path, "one", script), other], "start").differences
    assert difference.position_rms == pytest.approx((0, 0, 0.005, 0), abs=1e-9)
    assert difference.tool_rms_mm == pytest.approx(5.0)


def test_runs_are_aligned_by_an_event(tmp_path: Path) -> None:
    script = Script(seconds=4.0)
    made = make(script)
    late = [one for one in made if one.publish_wall_ns > made[0].publish_wall_ns + 1_000_000_000]
    runs = [named(tmp_path, "one", script), named(tmp_path, "late", script, late)]
    by_event = compare(runs, "session-end")
    # The late run lacks the first second: aligned at the end, the runs are identical.
    assert (by_event.origins[0].ns - by_event.origins[1].ns) / 1e9 == pytest.approx(1.0, abs=0.03)
    assert by_event.differences[0].tool_max_mm < 2.0
    assert runs[1].time_s(runs[1].states)[-1] == pytest.approx(0.0, abs=0.03)


def test_comparison_shows_a_slower_controller(tmp_path: Path) -> None:
    runs = [named(tmp_path, "quick", Script(seconds=8.0)), named(tmp_path, "slow", Script(seconds=8.0, delay_ms=40.0))]
    comparison = compare(runs)
    assert comparison.differences[0].loop_p50_ms == pytest.approx(40, abs=1)
    assert json.loads(json.dumps(comparison.as_dict()))["differences"][0]["session"] == "slow"


def test_missing_alignment_event_is_reported(tmp_path: Path) -> None:
    run = named(tmp_path, "run", Script(seconds=2.0))
    with pytest.raises(InputError, match="no event PART_PICKED; its events: SESSION_END, SESSION_START"):
        compare([run, run], "part_picked")


def test_motionless_run_is_aligned_by_command_or_start(tmp_path: Path) -> None:
    script, silent = Script(seconds=2.0), Script(seconds=2.0, controllers=False)
    made = make(script)
    for one in made:
        if isinstance(one.message, JointState):
            one.message.velocity[:] = [0.0] * 4
    still, alone = named(tmp_path, "still", script, made), named(tmp_path, "alone", silent)
    comparison = compare([named(tmp_path, "moving", script), still, alone])
    assert [origin.by for origin in comparison.origins] == ["motion", "command", "start"]
    first = still.states[still.states["command_seq"] > 0][:1]
    assert still.time_s(first)[0] == 0.0
    assert alone.time_s(alone.states)[0] == 0.0
    assert comparison.differences[0].loop_p50_ms == 0
    assert comparison.differences[1].loop_p50_ms is None
    assert comparison.left_out == ()


def test_initial_zero_torque_is_not_a_controller_command(tmp_path: Path) -> None:
    silent = Script(seconds=2.0, controllers=False)
    made = make(silent)
    for one in made:
        if isinstance(one.message, JointState):
            one.message.session, one.message.command_seq = "", 1
    first = made[0]
    made.insert(
        0, TimedMessage("command", first.publish_wall_ns, TorqueCommand(rig="rig1", seq=1, effort=[0.0] * 4, safe=True))
    )
    run = named(tmp_path, "alone", silent, made)
    assert find_origin(run, "motion") == Origin(0, "start")
    summary = summarize(
        run, parse_lab("[[task.poses]]\nname = 'here'\nposition_mm = [300, 0, 0]\ntolerance_mm = 900\n").task
    )
    assert summary.latency.reason_text() == "no closed loop: no controller wrote commands in this session"
    assert summary.grade is not None
    assert summary.grade.score == 0


def test_run_without_alignment_is_excluded(tmp_path: Path) -> None:
    script = Script(seconds=2.0)
    cut = [
        one for one in make(script) if not (isinstance(one.message, Event) and one.message.kind == Event.SESSION_END)
    ]
    runs = [named(tmp_path, "one", script), named(tmp_path, "cut", script, cut), named(tmp_path, "two", script)]
    comparison = compare(runs, "session-end")
    assert [one.session for one in comparison.differences] == ["two"]
    assert [run.session for run in comparison.runs] == ["one", "two"]
    assert ["no event SESSION_END" in reason for reason in comparison.left_out] == [True]


def test_report_of_a_run_without_a_controller(tmp_path: Path) -> None:
    silent = named(tmp_path, "silent", Script(seconds=2.0, controllers=False))
    alone = build_report([silent.path])
    page = _Page(alone.html)
    assert page.text.count("no closed loop: no controller wrote commands in this session") == 2
    assert alone.html.count("<img") == 2
    assert "tick lateness" in page.text
    among = build_report([silent.path, named(tmp_path, "quick", Script(seconds=2.0)).path])
    assert among.left_out == ()
    # Among equal runs it is ranked last.
    assert [run["session"] for run in among.runs] == ["quick", "silent"]
    assert among.runs[1]["latency"]["loop_ms"] is None


def test_comparison_of_one_run_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least two runs"):
        compare([named(tmp_path, "run", Script(seconds=1.0))])


def test_comparison_plot_is_written(tmp_path: Path) -> None:
    script = Script(seconds=2.0)
    comparison = compare([named(tmp_path, "one", script), named(tmp_path, "two", script)])
    save_comparison_plot(comparison, tmp_path / "both.svg")
    assert "aligned time" in (tmp_path / "both.svg").read_text() or (tmp_path / "both.svg").stat().st_size > 20_000


class _Page(HTMLParser):
    """Open tags, references and text of a page."""

    VOID = frozenset({"meta", "img", "br", "!doctype"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        self.sources.extend(value or "" for name, value in attrs if name in ("src", "href", "action"))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += f"{data} "


def test_report_is_a_self_contained_page(tmp_path: Path) -> None:
    html = build_report([named(tmp_path, "run-1", Script(seconds=8.0, delay_ms=40.0)).path]).html
    page = _Page(html)
    assert page.open == []
    # Two figures with two columns each.
    assert len(page.sources) == 4
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert not re.search(r"(src|href)=.?https?://|@import|url\(|<script src|<link", html)
    for expected in (
        "run-1",
        *(stage.title for stage in LOOP_STAGES),
        "controlled by 192.0.2.7:40001",
        "0 of 4",
        "Not valid for latency measurements",
    ):
        assert expected in page.text, expected
    assert "the program waits 40 ms between read and write" in page.text


def test_group_report_ranks_the_runs(tmp_path: Path) -> None:
    script = Script(seconds=3.0)
    placed = make(script)
    spot = PARAMETERS.scene.trays[0].places[0]
    for one in placed:
        if isinstance(one.message, JointState):
            for part in one.message.parts:
                if part.name == "red":
                    part.x, part.y, part.z = spot[0] + 0.001, spot[1], spot[2] + PARAMETERS.scene.parts[0].size[2] / 2
    runs = [named(tmp_path, "nothing", script), named(tmp_path, "one-part", script, placed)]
    page = _Page(build_report([run.path for run in runs]).html)
    assert page.text.index("one-part") < page.text.index("nothing")
    assert "1 of 4" in page.text
    assert "1.00" in page.text


def test_alarms_are_the_events_from_warning_up(tmp_path: Path) -> None:
    script = Script(seconds=2.0)
    made = make(script)
    added = (
        (Event.RESET, Event.INFO),
        (Event.RESET, Event.ERROR),
        (Event.RECORDING, Event.ERROR),
        (Event.WATCHDOG_TRIP, Event.WARNING),
    )
    for kind, severity in added:
        event = Event(rig="rig1", kind=kind, severity=severity, wall_ns=made[50].publish_wall_ns, text="text")
        made.append(TimedMessage("event", event.wall_ns, event))
    paths = [named(tmp_path, "alarms", script, made).path, named(tmp_path, "other", script).path]
    found = build_report(paths)
    alarms = {run["name"]: (run["alarms"], run["events"].get("RESET")) for run in found.runs}
    assert alarms == {"alarms": (3, {"ERROR": 1, "INFO": 1}), "other": (0, None)}
    assert re.search(r'data-label="alarms">3</td>', found.html)
    for level in ("error", "info"):
        assert len(re.findall(rf'<td>reset</td><td>{level}</td><td class="text">text</td>', found.html)) == 1


def test_palette_and_log_levels_match_the_schema() -> None:
    severities = {name for name, number in Event.Severity.items() if number}
    assert set(SEVERITY_COLORS) == set(LOG_LEVELS) == severities
    assert set(EVENT_COLORS) <= set(Event.Kind.keys())


def test_report_lists_replayed_and_copied_runs(tmp_path: Path) -> None:
    script = Script(seconds=4.0, law="feedback")
    anna = named(tmp_path, "anna", script).path
    ben = named(tmp_path, "ben", replace(script, seed=2, delay_ms=3.0)).path
    # The same torques in another session, and the same file under another name.
    replayed = named(tmp_path, "carl", script).path
    copied = tmp_path / "dora.mcap"
    copied.write_bytes(ben.read_bytes())
    found = build_report([anna, ben, replayed, copied])
    assert sorted(found.same_torques) == [
        "anna and carl: 100 % of the torques written by the controllers are identical",
        "ben and dora: the same recording",
    ]
    page = _Page(found.html)
    assert "Runs with the same torques" in page.text
    assert all(pair in page.text for pair in found.same_torques)
    # Runs are named after their files.
    assert {run["name"] for run in found.runs} == {"anna", "ben", "carl", "dora"}
    assert "dora" in page.text.split("Ranked")[0]


def test_files_with_equal_names_are_distinguished(tmp_path: Path) -> None:
    paths = []
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        paths.append(named(tmp_path / day, "anna", Script(seconds=1.0)).path)
    third = named(tmp_path, "ben", Script(seconds=1.0)).path
    assert set(display_names([*paths, third]).values()) == {
        str(tmp_path / "monday/anna"),
        str(tmp_path / "tuesday/anna"),
        "ben",
    }
    page = _Page(build_report(paths).html)
    assert all(str(path.with_suffix("")) in page.text for path in paths)


def test_recorded_texts_are_escaped(tmp_path: Path) -> None:
    text = build_report([named(tmp_path, "a<b>&c", Script(seconds=1.0)).path]).html
    assert "a&lt;b&gt;&amp;c" in text
    assert "<b>&c" not in text
