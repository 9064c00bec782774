"""Basis of commands and stalls of the edge in recordings of real processes.

Runs for a short time; with HILRIG_LONG in the environment for as long as the cases that were found in use.
"""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.io.run import open_run
from hilrig_schemas import Event, TorqueCommand, topics
from support.labs import RunningLab, write_lab
from support.long_tests import LONG
from support.waiting import eventually

pytestmark = [pytest.mark.rig, pytest.mark.real_time]

ROOT = Path(__file__).parents[2]
HOLD = ROOT / "examples/hold_position.py"
TWO, COIL_FIRST = (ROOT / "tests/support" / name for name in ("two_connections.py", "coil_first.py"))
MS = 1_000_000


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    extra = "edge.session_grace_ms = 100\nrecorder.preroll_s = 0.1"
    with RunningLab(write_lab(tmp_path_factory.mktemp("lab"), extra=extra)) as lab:
        yield lab


class Session:
    """Recording of one controller."""

    def __init__(self, path: Path) -> None:
        self.run = open_run(path)
        self.report: LatencyReport = measure(self.run)
        every = [TorqueCommand.FromString(payload) for *_, payload in self._messages("command")]
        written = {one.seq: one for one in every if one.write_arrived_ns and one.session == self.run.session}
        self.writes = [written[seq] for seq in sorted(written)]
        events = [Event.FromString(payload) for *_, payload in self._messages("event")]
        stalls = [one for one in events if one.kind == Event.OVERRUN and one.source.startswith("edge/")]
        self.stalls = sum(one.overrun_data.stalls for one in stalls)
        self.stall_ms = [one.overrun_data.lateness_ns / MS for one in stalls]
        self.texts = [one.text for one in stalls]

    def _messages(self, topic: str) -> Iterator[tuple[int, int, int, int, bytes]]:
        return self.run.file.messages(frozenset({topics.RECORDED[topic].name}))

    def stage_ms(self, end: str, begin: str) -> np.ndarray:
        """Time between two stamps of each write that has a basis, ms; without the last one, which ends the program."""
        writes = [one for one in self.writes if one.basis_step][:-1]
        return np.array([getattr(one, end) - getattr(one, begin) for one in writes]) / MS


def record(
    lab: RunningLab, program: Path, *arguments: str, stops: int = 0, stop_ms: float = 0, every_s: float = 1
) -> Session:
    """Run a controller, stop the edge meanwhile, and return the recording."""
    known = set(lab.recordings)
    controller = subprocess.Popen([sys.executable, str(program), *arguments], stdout=subprocess.DEVNULL)
    edge = lab.service_pid("edge")
    time.sleep(0.8)  # the program connects and moves the arm before it is disturbed
    for _ in range(stops):
        os.kill(edge, signal.SIGSTOP)
        try:
            time.sleep(stop_ms / 1e3)  # the duration of the stop is under test
        finally:
            os.kill(edge, signal.SIGCONT)
        time.sleep(every_s - stop_ms / 1e3)  # undisturbed time between two stops
    controller.wait(60)
    return Session(eventually(lambda: next((path for path in lab.recordings if path not in known), None)))


def hold(lab: RunningLab, seconds: float, **stops: float) -> Session:
    return record(lab, HOLD, "--port", str(lab.port), "--duration", str(seconds), **stops)  # type: ignore[arg-type]


@pytest.mark.long("takes minutes")
@pytest.mark.parametrize(("stops", "stop_ms", "every_s", "seconds"), [(12, 200.0, 1.5, 20.0), (25, 60.0, 0.7, 19.0)])
def test_stops_of_the_edge_are_counted_and_its_own_time(
    lab: RunningLab, stops: int, stop_ms: float, every_s: float, seconds: float
) -> None:
    session = hold(lab, seconds, stops=stops, stop_ms=stop_ms, every_s=every_s)
    # A loaded host may stall the edge once more.
    assert stops <= session.stalls <= stops + 2, session.texts
    assert sum(stop_ms - 25 <= length_ms < stop_ms + 40 for length_ms in session.stall_ms) >= len(session.stall_ms) - 2
    assert all(one.write_received_ns for one in session.writes)
    controller_ms = session.stage_ms("write_received_ns", "state_served_ns")
    # The program computes for less than a millisecond; a stop is in no write's time.
    assert np.percentile(controller_ms, 95) < 15
    assert controller_ms.max() < stop_ms / 2
    report = session.report
    assert not report.fit
    [text] = [reason.text for reason in report.reasons if reason.code == "edge_stall"]
    assert re.fullmatch(rf"edge stalled {session.stalls} times, (\d+ ms each|longest \d+ ms)", text)
    assert report.age_ms is not None
    assert report.age_ms.max > stop_ms
    if stop_ms == 200.0:
        assert report.age_ms.p95 > 100
        assert report.age_ms.p99 > 180


def test_second_session_of_a_coil_writer_has_no_old_basis(lab: RunningLab) -> None:
    seconds = "5" if LONG else "0.5"
    for _ in range(2):
        session = record(lab, COIL_FIRST, "127.0.0.1", str(lab.port), seconds)
        first, *others = session.writes
        assert (first.basis_step, first.basis_on_other_connection) == (0, False)
        # The second write is the first one of torques: its position was read before.
        assert all(one.basis_step and not one.basis_on_other_connection for one in others[1:])
        assert session.report.loop_ms is not None
        assert session.report.loop_ms.max < 500


@pytest.mark.parametrize("law", ["feedback", "constant"] if LONG else ["feedback"])
def test_write_of_one_connection_is_based_on_read_of_another(lab: RunningLab, law: str) -> None:
    session = record(lab, TWO, "127.0.0.1", str(lab.port), "20" if LONG else "1.6", law)
    first, *others = session.writes
    # Its position was read before the session began.
    assert (first.basis_step, first.basis_on_other_connection) == (0, False)
    assert len(others) > 20
    assert all(one.basis_on_other_connection for one in others)
    assert all(one.state_served_ns <= one.write_received_ns for one in others)
    report = session.report
    if law == "feedback":
        assert report.loop_ms is not None
        assert report.read_on_other_connection
    else:
        assert report.loop_ms is None
        assert "open_loop" in {reason.code for reason in report.reasons}
