"""Data quality: each defect of a recording is a reason with a code, and a recording without defects has none."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hilrig_recorder.mcap_format.recover import recover
from hilrig_replay.analysis.data_quality import Stalls
from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.io.run import open_run
from hilrig_schemas import Event, JointState, ModbusTraffic, TorqueCommand
from support.recordings import CONTROLLER, MS, Script, TimedMessage, make, record, write

SCRIPT = Script(seconds=20.0, poll_ms=20.0)
SESSION = "20260101T000000Z-rig1-abcd"
RESTARTED = Path(__file__).parents[1] / "data" / "simulation-restarted.mcap"


def measured(folder: Path, made: list[TimedMessage], summary: dict[str, str] | None = None) -> LatencyReport:
    values = {"ended": "ended", "lost_transport": "0", "lost_recorder": "0", **(summary or {})}
    path = write(folder / "run.mcap", made, script=SCRIPT, metadata={"hilrig.summary": values})
    return measure(open_run(path))


def reasons(report: LatencyReport) -> dict[str, str]:
    assert report.fit == (not report.reasons)
    return {reason.code: reason.text for reason in report.reasons}


def test_complete_recording_has_no_reasons(tmp_path: Path) -> None:
    made = make(SCRIPT)
    assert reasons(measured(tmp_path, made, {"messages": str(len(made))})) == {}


def test_reports_a_simulation_killed_during_the_session() -> None:
    assert reasons(measure(open_run(RESTARTED)))["restart"] == "sim/1 was restarted during the session"


def test_reports_a_restarted_simulation_by_its_states(tmp_path: Path) -> None:
    made = make(SCRIPT)
    for one in made:
        if isinstance(one.message, JointState) and one.message.step > 600:
            one.message.incarnation = 8
            one.message.step -= 600
    assert reasons(measured(tmp_path, made))["restart"] == "the simulation was restarted during the session"


def test_reports_a_recorder_started_during_the_session(tmp_path: Path) -> None:
    metadata = {
        "hilrig.session": {"session": SESSION, "rig": "rig1", "controller": CONTROLLER, "start_wall_ns": "1000"},
        "hilrig.source": {"source": "sim/1", "incarnation": "900"},
        "hilrig.source.2": {"source": "recorder/1", "incarnation": "1100"},
        "hilrig.source.3": {"incarnation": "no number"},
    }
    report = measure(open_run(write(tmp_path / "run.mcap", make(SCRIPT), script=SCRIPT, metadata=metadata)))
    assert reasons(report)["restart"] == "recorder/1 was started during the session"


def test_restart_before_the_session_is_no_reason(tmp_path: Path) -> None:
    made = make(SCRIPT)
    for one in made:
        if isinstance(one.message, JointState) and one.message.step < 3:
            one.message.incarnation, one.message.session = 6, ""
    assert "restart" not in reasons(measured(tmp_path, made))


def test_reports_a_service_started_during_the_session(tmp_path: Path) -> None:
    made = make(SCRIPT)
    metadata = {
        "hilrig.session": {"session": SESSION, "rig": "rig1", "controller": CONTROLLER, "start_wall_ns": "1000"},
        "hilrig.source": {"source": "edge/1", "incarnation": "900"},
        "hilrig.source.2": {"source": "recorder/1", "incarnation": "1100"},
        "hilrig.source.3": {"source": "recorder/1", "incarnation": "1200"},
    }
    report = measure(open_run(write(tmp_path / "run.mcap", made, script=SCRIPT, metadata=metadata)))
    assert reasons(report)["restart"] == "recorder/1 was restarted during the session (2 times)"


@pytest.mark.parametrize(
    "is_kept",
    [
        lambda one, begin_ns: one.publish_wall_ns < begin_ns + 10_000 * MS,
        lambda one, begin_ns: not (isinstance(one.message, JointState) and one.message.step <= 300),  # noqa: ARG005
        lambda one, begin_ns: not 8_000 * MS < one.publish_wall_ns - begin_ns < 9_000 * MS,
    ],
    ids=["last 10 s", "first 300 states", "a second in the middle"],
)
def test_reports_messages_that_the_summary_counts(tmp_path: Path, is_kept: Callable[[TimedMessage, int], bool]) -> None:
    made = make(SCRIPT)
    kept = [one for one in made if is_kept(one, made[0].publish_wall_ns)]
    report = measured(tmp_path, kept, {"messages": str(len(made))})
    missing = len(made) - len(kept)
    assert (
        reasons(report)["missing_messages"]
        == f"{missing} messages missing in the file: it counts more than it contains"
    )
    assert report.lost.file == missing
    assert report.lost.transport == 0


def test_reports_a_missing_end_without_a_message_count(tmp_path: Path) -> None:
    made = make(SCRIPT)
    kept = [one for one in made if one.publish_wall_ns < made[0].publish_wall_ns + 10_000 * MS]
    assert "missing_end" in reasons(measured(tmp_path, kept))


def test_reports_a_missing_beginning_without_a_message_count(tmp_path: Path) -> None:
    kept = [one for one in make(SCRIPT) if not (isinstance(one.message, JointState) and one.message.step <= 300)]
    assert "missing_beginning" in reasons(measured(tmp_path, kept))


def test_single_early_read_is_no_missing_beginning(tmp_path: Path) -> None:
    made = [one for one in make(SCRIPT) if not (isinstance(one.message, JointState) and one.message.step <= 3)]
    for one in made:
        if isinstance(one.message, TorqueCommand) and one.message.basis_step <= 3:
            one.message.basis_step = 1
    assert "missing_beginning" not in reasons(measured(tmp_path, made))


def test_reports_a_truncated_file_after_its_recovery(tmp_path: Path) -> None:
    whole = record(tmp_path / "run.mcap", SCRIPT)
    content = whole.read_bytes()
    whole.write_bytes(content[: len(content) * 7 // 10])
    recover(whole, tmp_path / "recovered.mcap")
    found = reasons(measure(open_run(tmp_path / "recovered.mcap")))
    assert found["truncated"] == "the file was truncated: messages at its end are missing, or can be"


def stalled(count: int, lateness_ms: float, *, stalls: int = 0) -> list[TimedMessage]:
    """A run with overrun events of the edge; `stalls`: number of stalls in each."""
    made = make(SCRIPT)
    for number in range(count):
        event = Event(rig="rig1", session=SESSION, kind=Event.OVERRUN, severity=Event.WARNING, source="edge/1")
        event.wall_ns = made[0].publish_wall_ns + (number + 1) * 1_000 * MS
        event.overrun_data.lateness_ns = round((lateness_ms + number / 10) * MS)
        event.overrun_data.stalls = stalls
        made.append(TimedMessage("event", event.wall_ns, event))
    return sorted(made, key=lambda one: one.publish_wall_ns)


def test_reports_the_stalls_of_the_edge(tmp_path: Path) -> None:
    # The recorder counts the events of all services.
    report = measured(tmp_path, stalled(12, 200), {"overruns": "12"})
    assert reasons(report) == {"edge_stall": "edge stalled 12 times, 201 ms each"}
    (finding,) = report.findings
    assert (finding.code, finding.evidence["stalls"]) == ("edge_stall", 12)


def test_counts_the_stalls_of_an_event(tmp_path: Path) -> None:
    report = measured(tmp_path, stalled(4, 60, stalls=3), {"overruns": "4"})
    assert reasons(report) == {"edge_stall": "edge stalled 12 times, 60 ms each"}
    (tmp_path / "run.mcap").unlink()
    # The fifth overrun is one of the simulation.
    assert "simulation_stall" in reasons(measured(tmp_path, stalled(4, 60, stalls=3), {"overruns": "5"}))


def test_short_stalls_of_the_edge_are_no_reason(tmp_path: Path) -> None:
    assert reasons(measured(tmp_path, stalled(3, 12))) == {}


def test_reports_a_stall_of_the_edge_by_the_request_log(tmp_path: Path) -> None:
    script = Script(seconds=20.0, poll_ms=20.0, edge_stalls={3.0: 90.0})
    report = measure(open_run(record(tmp_path / "run.mcap", script)))
    assert reasons(report)["edge_stall"].startswith("edge stalled once, ")


@pytest.mark.parametrize(
    ("stalls", "text"),
    [
        (Stalls(1, 90 * MS), "once, 90 ms"),
        (Stalls(12, 200 * MS, shortest_ns=190 * MS), "12 times, 200 ms each"),
        (Stalls(2, 200 * MS, shortest_ns=60 * MS), "2 times, 60 to 200 ms"),
        (Stalls(2, 200 * MS), "2 times, longest 200 ms"),
    ],
)
def test_describes_stalls(stalls: Stalls, text: str) -> None:
    assert str(stalls) == text


def test_reports_large_integration_errors(tmp_path: Path) -> None:
    made = make(SCRIPT)
    states = [one.message for one in made if isinstance(one.message, JointState)]
    states[100].integration_error[2] = 0.9e-4
    assert reasons(measured(tmp_path, made)) == {}
    states[101].integration_error[2] = 1.5e-4
    states[102].integration_error[2] = -2.5e-4
    assert reasons(measured(tmp_path, made)) == {
        "integration_error": "2 steps with an integration error above 0.1° or 0.1 mm, up to 0.25 mm (joint 3)"
    }


@pytest.mark.parametrize(("reads", "codes"), [(1, ["few_reads"]), (20, [])])
def test_reports_a_controller_that_writes_without_reading(tmp_path: Path, reads: int, codes: list[str]) -> None:
    made = make(SCRIPT)
    states = {one.message.step: one.message for one in made if isinstance(one.message, JointState)}
    last_step = max(states)
    for one in made:
        message = one.message
        if isinstance(message, TorqueCommand | JointState) and message.basis_step:
            message.basis_step = 1 + (message.basis_step * reads // (last_step + 1)) * (last_step // reads)
        if isinstance(message, JointState) and message.basis_step:
            message.loop_latency_ns = message.sampled_ns - states[message.basis_step].sampled_ns
    found = reasons(measured(tmp_path, made))
    assert list(found) == codes
    if codes:
        assert found["few_reads"].endswith(" commands are based on 1 state: the controller writes without reading")


def on_other_connection(made: list[TimedMessage], share: float = 1.0) -> list[TimedMessage]:
    for one in made:
        if isinstance(one.message, TorqueCommand):
            one.message.basis_on_other_connection = one.message.seq % 100 < 100 * share
    return made


def test_feedback_over_two_connections_has_a_latency(tmp_path: Path) -> None:
    made = make(Script(seconds=20.0, poll_ms=20.0, law="feedback"))
    expected = measured(tmp_path, made)
    report = measured(tmp_path, on_other_connection(made))
    assert reasons(report) == {}
    assert report.read_on_other_connection
    assert not expected.read_on_other_connection
    assert (report.loop_ms, report.age_ms) == (expected.loop_ms, expected.age_ms)
    assert any(note.startswith("read on another connection") for note in report.notes())


def test_torques_beside_a_reader_are_an_open_loop(tmp_path: Path) -> None:
    report = measured(tmp_path, on_other_connection(make(SCRIPT)))
    assert list(reasons(report)) == ["open_loop"]
    assert (report.samples, report.loop_ms, report.age_ms, report.stages_ms) == (0, None, None, {})
    assert "slow_polling" not in {finding.code for finding in report.findings}


def test_few_reads_on_another_connection_are_accepted(tmp_path: Path) -> None:
    report = measured(tmp_path, on_other_connection(make(SCRIPT), 0.1))
    assert reasons(report) == {}
    assert not report.read_on_other_connection


def test_kernel_timestamps_move_the_border_to_the_edge(tmp_path: Path) -> None:
    made = make(SCRIPT)
    before = measured(tmp_path, made)
    for one in made:
        if isinstance(one.message, TorqueCommand):
            one.message.write_received_ns = one.message.write_arrived_ns - 60_000
    report = measured(tmp_path, made)
    assert report.kernel_timestamps
    assert not before.kernel_timestamps
    assert report.loop_ms == before.loop_ms
    assert report.stages_ms["controller"].p50 == pytest.approx(before.stages_ms["controller"].p50 - 0.06, abs=1e-6)
    assert report.stages_ms["edge"].p50 == pytest.approx(before.stages_ms["edge"].p50 + 0.06, abs=1e-6)
    assert any("without kernel timestamps" in note for note in before.notes())
    assert not any("without kernel timestamps" in note for note in report.notes())


def test_network_is_bounded_by_the_smallest_round_trip_time(tmp_path: Path) -> None:
    made = make(Script(seconds=20.0, poll_ms=20.0, delay_ms=14.0))
    number = 0
    for one in made:
        if isinstance(one.message, ModbusTraffic):
            number += 1
            one.message.connections.add(
                controller=CONTROLLER,
                min_rtt_us=0 if number == 1 else 9_000 - min(number, 3) * 200,
                retransmissions=number // 10,
            )
            one.message.connections.add(controller="192.0.2.9:1", min_rtt_us=10, retransmissions=1000)
    report = measured(tmp_path, made)
    assert report.network is not None
    assert report.network.min_ms == 8.4
    assert report.network.controller_max_ms == pytest.approx(report.stages_ms["controller"].p50 - 8.4)
    assert report.network.retransmissions == number // 10 > 0
    assert f"network ≥ 8.4 ms, controller ≤ 6.4 ms, {number // 10} TCP retransmissions" in report.notes()
