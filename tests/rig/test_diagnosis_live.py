"""Diagnosis of recordings of real programs with one mistake each, and of services that were disturbed.

With HILRIG_LONG in the environment for more runs of each cause: the live part of the table in docs/diagnosis.md.
"""

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

from diagnosis_corpus import UNDISTURBED, interval
from hilrig_replay.analysis.diagnosis.evidence import Finding
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from support.delay_line import NEAR, DelayLine, require_delay_line
from support.forwarder import Forwarder
from support.labs import RunningLab, write_lab
from support.long_tests import LONG
from support.waiting import eventually

pytestmark = [pytest.mark.rig, pytest.mark.real_time]

PROGRAM = Path(__file__).parents[1] / "support/student_program.py"
EXAMPLE = Path(__file__).parents[2] / "examples/hold_position.py"
SECONDS = 4.0 if LONG else 2.5
LIVE_RUNS = 25
"""Runs of each cause in the long test, at least."""
RIGS = 6
MISTAKES: dict[str, tuple[str, tuple[float, float]]] = {
    "previous_poll": ("previous poll", (0, 0)),
    "wait_before_write": ("wait before write", (12, 60)),
    "open_loop": ("read once", (0, 0)),
    "slow_polling": ("slow polling", (30, 120)),
    "delayed_acknowledgement": ("two segments", (0, 0)),
    "competing_clients": ("competitor", (0, 0)),
}
"""By cause: mistake of the program and range of its value, ms."""
FIFO_LOAD = """
import os, sys, time
core, count, busy_s = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
os.sched_setaffinity(0, {core})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
for _ in range(count):
    end = time.monotonic() + busy_s
    while time.monotonic() < end:
        pass
    time.sleep(0.5)
"""
"""A program with a higher real-time priority than the services."""


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
    port: int | None = None,
) -> list[str]:
    """Command line of a program; `port`: another one than that of the rig."""
    port = port or lab.lab.ports[lab.lab.rigs[rig].name]
    return [sys.executable, str(PROGRAM), host, str(port), str(seconds), mistake, str(value_ms)]


def diagnosed(lab: RunningLab, commands: Sequence[list[str]], during: Iterable[None] = ()) -> list[list[Finding]]:
    """Timing causes of the programs of the first rigs, which run at the same time; `during` acts meanwhile.

    Of several programs of a rig, the causes of its first recording.
    """
    known = set(lab.recordings)
    processes = [subprocess.Popen(command) for command in commands]
    for _ in during:
        pass
    for process in processes:
        process.wait(60)
    rigs = [rig.name for rig in lab.lab.rigs]

    def new() -> dict[str, Path] | None:
        found = {path.parent.name: path for path in reversed(lab.recordings) if path not in known}
        return found if len(found) >= min(len(commands), RIGS) else None

    paths = eventually(new)
    findings = [measure(open_run(paths[rig])).findings for rig in rigs if rig in paths]
    return [[one for one in of_rig if one.list == "timing"] for of_rig in findings]


def stops(pid: int, count: int, stop_s: float) -> Iterator[None]:
    """Stop a process several times."""
    time.sleep(1.0)  # the programs connect and move the arm before they are disturbed
    for _ in range(count):
        os.kill(pid, signal.SIGSTOP)
        try:
            time.sleep(stop_s)  # the duration of the stop is under test
        finally:
            os.kill(pid, signal.SIGCONT)
        time.sleep(0.5)  # undisturbed time between two stops
        yield


def takes_processor(pid: int, count: int, busy_s: float) -> Iterator[None]:
    """Occupy the core of a process several times, with a higher priority; the process may use no other one."""
    time.sleep(1.0)  # the programs connect and move the arm before they are disturbed
    threads, cores = [int(path.name) for path in Path(f"/proc/{pid}/task").iterdir()], os.sched_getaffinity(pid)
    for thread in threads:
        os.sched_setaffinity(thread, {max(cores)})
    try:
        subprocess.run([sys.executable, "-c", FIFO_LOAD, *map(str, (max(cores), count, busy_s))], check=True)
    finally:
        for thread in threads:
            with suppress(ProcessLookupError):  # the thread has ended
                os.sched_setaffinity(thread, cores)
    yield


def require_real_time() -> None:
    """Skip the test if a program can't have a higher priority than the services."""
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("needs root on Linux for a real-time priority")


@pytest.fixture(scope="module")
def causes(lab: RunningLab, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Finding]]:
    """Timing causes of programs with one mistake each, by mistake."""
    source = EXAMPLE.read_text(encoding="utf-8")
    written = "answer = client.write_registers(0, words)"
    late = source.replace(written, "answer = client.write_registers(0, old)\n        old = words")
    late = late.replace("error = [0.0] * 4\n", "error = [0.0] * 4\n    old = [0, 0, 0, 0]\n", 1)
    assert "write_registers(0, old)" in late
    assert "old = [0, 0, 0, 0]" in late
    path = tmp_path_factory.mktemp("example") / "hold_previous.py"
    path.write_text(late, encoding="utf-8")
    values = {
        "wait before write": 20.0,
        "two segments": 0.0,
        "read once": 0.0,
        "slow polling": 100.0,
        "competitor": 0.0,
    }
    programs = [program(lab, mistake, value, rig=rig) for rig, (mistake, value) in enumerate(values.items(), start=1)]
    arguments = ["--port", str(lab.port), "--duration", str(2 * SECONDS)]
    rival = program(lab, "competitor", rig=RIGS - 1, seconds=SECONDS + 0.5)
    found = diagnosed(lab, [[sys.executable, str(path), *arguments], *programs, rival])
    return dict(zip(("previous poll", *values), found, strict=True))


def test_example_that_writes_the_old_torques_is_found(causes: dict[str, list[Finding]]) -> None:
    first = causes["previous poll"][0]
    assert first.code == "previous_poll", first
    assert "add one period of 20 ms" in first.text


def test_wait_between_read_and_write_is_found(causes: dict[str, list[Finding]]) -> None:
    first, *others = causes["wait before write"]
    assert (first.code, others) == ("wait_before_write", [])
    assert first.text == "the program waits 20 ms between read and write"
    assert first.remedy == "read, compute, write, then wait"
    assert first.gain_ms == pytest.approx(20, abs=3)


@pytest.mark.skipif(sys.platform != "linux", reason="TCP_QUICKACK is an option of Linux")
def test_two_segments_cost_no_delay(causes: dict[str, list[Finding]]) -> None:
    # The edge acknowledges an incomplete request at once.
    # Whether its polls beat with the steps depends on its phase.
    assert {one.code for one in causes["two segments"]} <= {"beating"}


def test_open_loop_after_one_read_is_found(causes: dict[str, list[Finding]]) -> None:
    first, *others = causes["read once"]
    assert (first.code, others) == ("open_loop", [])


def test_slow_polling_has_period_and_age(causes: dict[str, list[Finding]]) -> None:
    first, *others = causes["slow polling"]
    assert (first.code, others) == ("slow_polling", [])
    assert "polls every 100 ms" in first.text
    assert "the mean age 6" in first.text


def test_refused_writes_of_a_second_program_are_found(causes: dict[str, list[Finding]]) -> None:
    assert "competing_clients" in {one.code for one in causes["competitor"]}


def test_program_that_takes_the_edges_processor_is_found(lab: RunningLab) -> None:
    require_real_time()
    [[first, *others]] = diagnosed(lab, [program(lab, "none")], takes_processor(lab.service_pid("edge"), 2, 0.25))
    assert (first.code, others) == ("cpu_steal", [])
    assert first.evidence["run_delay_ms"] == pytest.approx(first.evidence["longest_ms"], rel=0.2)


@pytest.mark.long("takes minutes")
@pytest.mark.timeout(1800)
def test_error_rate_of_live_causes(lab: RunningLab, capsys: pytest.CaptureFixture[str]) -> None:
    """Several rigs run at the same time."""
    require_delay_line()
    random = np.random.default_rng(24)
    outcomes: dict[str, list[list[str]]] = defaultdict(list)

    def note(code: str, found: list[list[Finding]]) -> None:
        outcomes[code] += [[one.code for one in causes] for causes in found]

    for batch in range(LIVE_RUNS):
        order = [int(rig) for rig in random.permutation(RIGS)]
        with ExitStack() as forwarding:
            commands: list[list[str]] = []
            for rig, (mistake, values) in zip(order, MISTAKES.values(), strict=True):
                port = None
                if mistake == "two segments":
                    target = lab.lab.ports[lab.lab.rigs[rig].name]
                    port = forwarding.enter_context(Forwarder(target)).port
                commands.append(program(lab, mistake, float(random.uniform(*values)), rig=rig, port=port))
            rival = program(lab, "competitor", rig=order[-1], seconds=SECONDS + 0.5)
            found = diagnosed(lab, [*commands, rival])
        for rig, code in zip(order, MISTAKES, strict=True):
            note(code, [found[rig]])
        if batch * RIGS < LIVE_RUNS:
            good = [program(lab, "none", rig=rig) for rig in range(RIGS)]
            note(UNDISTURBED, diagnosed(lab, good))
            edge, sim = lab.service_pid("edge"), lab.service_pid("sim")
            for code, disturb, pid in (
                ("edge_stall", stops, edge),
                ("simulation_stall", stops, sim),
                ("cpu_steal", takes_processor, (edge, sim)[batch % 2]),
            ):
                note(code, diagnosed(lab, good, disturb(pid, 3, float(random.uniform(0.15, 0.4)))))
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
                sum(code in causes if code != UNDISTURBED else not causes for causes in every),
                sum(bool(causes) and causes[0] != code for causes in every),
            )
            print(f"| {code} | {len(every)} | {interval(found_count, len(every))} | {interval(wrong, len(every))} |")
            missed = [causes for causes in every if causes[:1] != ([code] if code != UNDISTURBED else [])]
            print(missed)
    for code, every in outcomes.items():
        found_count = sum(code in causes if code != UNDISTURBED else not causes for causes in every)
        assert found_count >= 0.9 * len(every), code
