"""Diagnosis: each rule finds its cause in a recording, and finds nothing without the cause."""

from pathlib import Path

import pytest

from hilrig_replay.analysis.diagnosis import Finding
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from support.recordings import Script, make, record, write


def findings(folder: Path, script: Script) -> dict[str, Finding]:
    report = measure(open_run(record(folder / "run.mcap", script)))
    return {finding.kind: finding for finding in report.findings}


def test_fast_controller_has_no_findings(tmp_path: Path) -> None:
    assert findings(tmp_path, Script(seconds=12.0, poll_ms=5.0)) == {}


def test_finds_a_simulation_stall(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, stalls={200: 130.0}))["simulation_stall"]
    assert found.evidence["stalls"] == 1
    assert found.evidence["longest_ms"] == pytest.approx(130, abs=1)
    assert found.evidence["at_s"] == pytest.approx(4.1, abs=0.05)


def test_finds_an_edge_stall(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, edge_stalls={3.0: 90.0}))["edge_stall"]
    assert found.evidence["longest_ms"] == pytest.approx(90, abs=6)
    assert found.evidence["at_s"] == pytest.approx(3.0, abs=0.1)


def test_finds_an_injected_delay(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, injected_state_ms=12.0, injected_command_ms=18.0))["injected_delay"]
    assert found.evidence["mean_ms"] == pytest.approx(30.0)


@pytest.mark.parametrize("poll_ms", [33.0, 100.0])
def test_finds_polling_slower_than_the_step(tmp_path: Path, poll_ms: float) -> None:
    found = findings(tmp_path, Script(seconds=8.0, poll_ms=poll_ms))
    assert found["slow_polling"].evidence["cycle_ms"] == pytest.approx(poll_ms, abs=0.5)
    assert "slow_controller" not in found


def test_finds_a_slow_controller(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, delay_ms=60.0))["slow_controller"]
    assert found.evidence["controller_ms"] == pytest.approx(60.8, abs=1)


def test_controller_with_a_small_share_is_not_slow(tmp_path: Path) -> None:
    assert "slow_controller" not in findings(tmp_path, Script(seconds=8.0, delay_ms=6.0))


def test_finds_a_controller_that_reads_after_writing(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=12.0, poll_ms=100.0, order="write-read"))["slow_controller"]
    assert "waits before the next write" in found.text
    assert found.evidence["controller_ms"] == pytest.approx(99, abs=1)


@pytest.mark.parametrize("poll_ms", [19.6, 20.3])
def test_finds_a_cycle_that_beats_with_the_step(tmp_path: Path, poll_ms: float) -> None:
    found = findings(tmp_path, Script(seconds=12.0, poll_ms=poll_ms))["beating"]
    expected_s = 0.02 / abs(poll_ms - 20.0) * poll_ms
    assert found.evidence["period_s"] == pytest.approx(expected_s, rel=0.1)


@pytest.mark.parametrize("poll_ms", [5.0, 10.0, 33.0])
def test_other_cycles_do_not_beat(tmp_path: Path, poll_ms: float) -> None:
    assert "beating" not in findings(tmp_path, Script(seconds=12.0, poll_ms=poll_ms))


@pytest.mark.parametrize("wait_ms", [40.5, 204.0])
def test_finds_delayed_acknowledgments(tmp_path: Path, wait_ms: float) -> None:
    found = findings(tmp_path, Script(seconds=12.0, poll_ms=0, delayed_ack_ms=wait_ms))["delayed_acknowledgement"]
    assert found.evidence["wait_ms"] == pytest.approx(wait_ms, abs=2)
    assert "TCP_NODELAY" in found.text


@pytest.mark.parametrize("poll_ms", [20.0, 40.0, 100.0])
def test_finds_torques_based_on_the_previous_poll(tmp_path: Path, poll_ms: float) -> None:
    found = findings(tmp_path, Script(seconds=20.0, poll_ms=poll_ms, law="feedback", feedback_delay_polls=1))[
        "previous_poll"
    ]
    assert found.evidence["added_ms"] == pytest.approx(poll_ms, rel=0.05)
    assert found.evidence["unexplained_previous"] < found.evidence["unexplained_newest"]


@pytest.mark.parametrize("poll_ms", [5.0, 20.0, 40.0, 100.0])
def test_torques_based_on_the_newest_poll_are_not_found(tmp_path: Path, poll_ms: float) -> None:
    assert "previous_poll" not in findings(tmp_path, Script(seconds=20.0, poll_ms=poll_ms, law="feedback"))


@pytest.mark.parametrize("basis_step", [0, 1, 5], ids=["never reads", "unknown step", "reads once"])
def test_accepts_commands_without_a_known_basis(tmp_path: Path, basis_step: int) -> None:
    script = Script(seconds=30.0, poll_ms=20.0, law="feedback")
    made = make(script)
    for item in made:
        if item.topic == "command" or (item.topic == "state" and item.message.basis_step):
            item.message.basis_step = basis_step
    report = measure(open_run(write(tmp_path / "run.mcap", made, script=script)))
    assert "previous_poll" not in {finding.kind for finding in report.findings}
