"""Diagnosis of recordings of real programs with one mistake each, and of the recordings of cases from use.

With HILRIG_LONG in the environment for more runs of each cause: the live part of the table in docs/timing.md.
"""

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from diagnosis_corpus import interval
from hilrig_replay.analysis.diagnosis.evidence import Finding
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from support.delay_line import NEAR, DelayLine, require_delay_line
from support.labs import RunningLab, write_lab
from support.waiting import eventually

pytestmark = [pytest.mark.rig, pytest.mark.real_time]

PROGRAM = Path(__file__).parents[1] / "support/student_program.py"
EXAMPLE = Path(__file__).parents[2] / "examples/hold_position.py"
LONG = bool(os.environ.get("HILRIG_LONG"))
SECONDS = 4.0 if LONG else 2.5
LIVE_RUNS = 25
"""Runs of each cause in the long test."""
RIGS = 4
MISTAKES: dict[str, tuple[str, tuple[float, float]]] = {
    "previous_poll": ("previous poll", (0, 0)),
    "wait_before_write": ("wait before write", (12, 60)),
    "open_loop": ("read once", (0, 0)),
    "slow_polling": ("slow polling", (30, 120)),
}
"""By cause: mistake of the program and range of its value, ms."""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    extra = "edge.session_grace_ms = 100\nedge.host = '0.0.0.0'\nrecorder.preroll_s = 0.1"
    with RunningLab(write_lab(tmp_path_factory.mktemp("lab"), rigs=RIGS, extra=extra)) as lab:
        yield lab


def program(
    lab: RunningLab,
    mistake: str,
    value_ms: float = 0.0,
    seconds: float = SECONDS,
    *,
    rig: int = 0,
    host: str = "127.0.0.1",
) -> list[str]:
    port = lab.lab.ports[lab.lab.rigs[rig].name]
    return [sys.executable, str(PROGRAM), host, str(port), str(seconds), mistake, str(value_ms)]


def diagnosed(lab: RunningLab, commands: list[list[str]], during: Iterable[None] = ()) -> dict[str, list[Finding]]:
    """Timing causes by rig of programs, one a rig, that run at the same time; `during` acts meanwhile."""
    known = set(lab.recordings)
    processes = [subprocess.Popen(command) for command in commands]
    for _ in during:
        pass
    for process in processes:
        process.wait(60)

    def new() -> list[Path] | None:
        found = [path for path in lab.recordings if path not in known]
        return found if len(found) >= len(commands) else None

    runs = [open_run(path) for path in eventually(new)]
    return {run.rig: [one for one in measure(run).findings if one.list == "timing"] for run in runs}


def causes_of(lab: RunningLab, command: list[str]) -> list[Finding]:
    [found] = diagnosed(lab, [command]).values()
    return found


def stops(pid: int, count: int, stop_s: float) -> Iterator[None]:
    """Stop a process several times."""
    time.sleep(1.0)  # the programs connect and move the arm before they are disturbed
    for _ in range(count):
        os.kill(pid, signal.SIGSTOP)
        try:
            time.sleep(stop_s)  # the duration of the stop is under test
        finally:
            os.kill(pid, signal.SIGCONT)
        time.sleep(0.8)  # undisturbed time between two stops
        yield


def test_example_that_writes_the_old_torques_is_found(lab: RunningLab, tmp_path: Path) -> None:
    source = EXAMPLE.read_text(encoding="utf-8")
    written = "answer = client.write_registers(0, words)"
    late = source.replace(written, "answer = client.write_registers(0, old)\n        old = words")
    late = late.replace("error = [0.0] * 4\n", "error = [0.0] * 4\n    old = [0, 0, 0, 0]\n", 1)
    assert "write_registers(0, old)" in late
    assert "old = [0, 0, 0, 0]" in late
    path = tmp_path / "hold_previous.py"
    path.write_text(late, encoding="utf-8")
    arguments = ["--port", str(lab.port), "--duration", str(2 * SECONDS)]
    first, *_ = causes_of(lab, [sys.executable, str(path), *arguments])
    assert first.code == "previous_poll", first
    assert "add one period of 20 ms" in first.text


def test_wait_between_read_and_write_is_found(lab: RunningLab) -> None:
    first, *others = causes_of(lab, program(lab, "wait before write", 20))
    assert (first.code, others) == ("wait_before_write", [])
    assert first.text == "the program waits 20 ms between read and write"
    assert first.remedy == "read, compute, write, then wait"
    assert first.gain_ms == pytest.approx(20, abs=3)


@pytest.mark.skipif(sys.platform != "linux", reason="TCP_QUICKACK is an option of Linux")
def test_two_segments_cost_no_delay(lab: RunningLab) -> None:
    # The edge acknowledges an incomplete request at once.
    assert causes_of(lab, program(lab, "two segments")) == []


def test_open_loop_after_one_read_is_found(lab: RunningLab) -> None:
    first, *others = causes_of(lab, program(lab, "read once"))
    assert (first.code, others) == ("open_loop", [])


def test_slow_polling_has_period_and_age(lab: RunningLab) -> None:
    first, *others = causes_of(lab, program(lab, "slow polling", 100))
    assert (first.code, others) == ("slow_polling", [])
    assert "polls every 100 ms" in first.text
    assert "the mean age 6" in first.text


@pytest.mark.skipif(not LONG, reason="long test: set HILRIG_LONG=1")
def test_refused_writes_of_a_second_program_are_found(lab: RunningLab) -> None:
    competitor = subprocess.Popen(program(lab, "competitor", seconds=SECONDS + 1, rig=1))
    found = diagnosed(lab, [program(lab, "competitor", rig=1)])
    competitor.wait(30)
    assert "competing_clients" in {one.code for causes in found.values() for one in causes}, found


@pytest.mark.skipif(not LONG, reason="long test: set HILRIG_LONG=1")
@pytest.mark.timeout(1800)
def test_error_rate_of_live_causes(lab: RunningLab, capsys: pytest.CaptureFixture[str]) -> None:
    """Several rigs run at the same time."""
    require_delay_line()
    random = np.random.default_rng(24)
    outcomes: dict[str, list[list[str]]] = defaultdict(list)
    rigs = [rig.name for rig in lab.lab.rigs]

    def note(code: str, found: dict[str, list[Finding]]) -> None:
        outcomes[code] += [[one.code for one in causes] for causes in found.values()]

    for batch in range(LIVE_RUNS):
        order = random.permutation(RIGS)
        commands = [
            program(lab, mistake, float(random.uniform(*values)), rig=int(rig))
            for rig, (mistake, values) in zip(order, MISTAKES.values(), strict=True)
        ]
        found = diagnosed(lab, commands)
        for rig, code in zip(order, MISTAKES, strict=True):
            outcomes[code].append([one.code for one in found[rigs[rig]]])
        if batch % RIGS == 0:
            good = [program(lab, "none", rig=rig) for rig in range(RIGS)]
            note("undisturbed", diagnosed(lab, good))
            for service, code in (("edge", "edge_stall"), ("sim", "simulation_stall")):
                stop_s = float(random.uniform(0.15, 0.4))
                note(code, diagnosed(lab, good, stops(lab.service_pid(service), 3, stop_s)))
            delay_s = float(random.uniform(0.008, 0.03))
            for code, line in (
                ("network", DelayLine(delay_s, delay_s)),
                ("retransmissions", DelayLine(0.0002, 0.0002, loss=float(random.uniform(0.02, 0.05)))),
            ):
                with line:
                    far = [line.command(program(lab, "none", rig=rig, host=NEAR)) for rig in range(RIGS)]
                    note(code, diagnosed(lab, far))
    with capsys.disabled():
        print()
        for code, every in outcomes.items():
            found_count, wrong = (
                sum(code in causes if code != "undisturbed" else not causes for causes in every),
                sum(bool(causes) and causes[0] != code for causes in every),
            )
            print(f"| {code} | {len(every)} | {interval(found_count, len(every))} | {interval(wrong, len(every))} |")
            missed = [causes for causes in every if causes[:1] != ([code] if code != "undisturbed" else [])]
            print(missed)
            assert found_count >= 0.9 * len(every), code
