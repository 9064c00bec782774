"""Diagnosis of recordings of real programs with one mistake each, and of the recordings of cases from use.

With HILRIG_LONG in the environment for more runs of each cause: the live part of the table in docs/timing.md.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hilrig_replay.analysis.diagnosis.evidence import Finding
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from support.labs import RunningLab, write_lab
from support.waiting import eventually

pytestmark = [pytest.mark.rig, pytest.mark.alone]

PROGRAM = Path(__file__).parents[1] / "support/student_program.py"
LONG = bool(os.environ.get("HILRIG_LONG"))
SECONDS = 8.0 if LONG else 1.5


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    extra = "edge.session_grace_ms = 100\nedge.host = '0.0.0.0'\nrecorder.preroll_s = 0.1"
    with RunningLab(write_lab(tmp_path_factory.mktemp("lab"), extra=extra)) as lab:
        yield lab


def program(
    lab: RunningLab, mistake: str, value_ms: float = 0.0, seconds: float = SECONDS, host: str = "127.0.0.1"
) -> list[str]:
    return [sys.executable, str(PROGRAM), host, str(lab.port), str(seconds), mistake, str(value_ms)]


def diagnosed(lab: RunningLab, command: list[str], during: "Iterator[None] | None" = None) -> list[Finding]:
    """Timing causes of a program; `during` acts while it runs."""
    known = set(lab.recordings)
    process = subprocess.Popen(command)
    for _ in during or ():
        pass
    assert process.wait(60) == 0
    recording = eventually(lambda: next((path for path in lab.recordings if path not in known), None))
    return [finding for finding in measure(open_run(recording)).findings if finding.list == "timing"]


def stops(pid: int, count: int, stop_s: float) -> Iterator[None]:
    time.sleep(0.6)
    for _ in range(count):
        os.kill(pid, signal.SIGSTOP)
        try:
            time.sleep(stop_s)
        finally:
            os.kill(pid, signal.SIGCONT)
        time.sleep(0.5)
        yield


def test_previous_poll_adds_a_period(lab: RunningLab) -> None:
    first, *_ = diagnosed(lab, program(lab, "previous poll", seconds=2 * SECONDS))
    assert first.code == "previous_poll", first
    assert "add one period of 20 ms" in first.text
    assert first.gain_ms == pytest.approx(20, abs=3)


def test_wait_between_read_and_write_is_found(lab: RunningLab) -> None:
    first, *others = diagnosed(lab, program(lab, "wait before write", 20))
    assert (first.code, others) == ("wait_before_write", [])
    assert first.text == "the program waits 20 ms between read and write"
    assert first.remedy == "read, compute, write, then wait"
    assert first.gain_ms == pytest.approx(20, abs=3)


def test_two_segments_are_one_finding(lab: RunningLab) -> None:
    first, *others = diagnosed(lab, program(lab, "two segments"))
    assert (first.code, others) == ("delayed_acknowledgement", [])


def test_open_loop_after_one_read_is_found(lab: RunningLab) -> None:
    first, *others = diagnosed(lab, program(lab, "read once"))
    assert (first.code, others) == ("open_loop", [])


def test_slow_polling_has_period_and_age(lab: RunningLab) -> None:
    first, *others = diagnosed(lab, program(lab, "slow polling", 100))
    assert (first.code, others) == ("slow_polling", [])
    assert "polls every 100 ms" in first.text
    assert "the mean age 6" in first.text
