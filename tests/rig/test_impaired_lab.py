"""Tests of network impairment with real processes: the measured delays and losses are the configured ones.

One lab with one rig per distribution. The controller of each writes every 30 ms, longer than the spread of the delays,
so that no command is superseded. The recordings are evaluated as by `hilrig latency`.
"""

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from hilrig_modbus_edge.impairment.model import Impairment, link_seed
from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.analysis.stages import STAGES
from hilrig_replay.io.run import Run, open_run
from hilrig_runtime.config.impairment import LinkImpairment
from support.edge_rig import RawClient
from support.labs import RunningLab, free_ports, hilrig
from support.waiting import eventually

pytestmark = [pytest.mark.rig, pytest.mark.real_time]

SECONDS = 4.0
STEP_MS = 10.0
SEED = 2
TRACE_MS = [4.0, 19.0, 7.5, 0.25, 12.0, 25.0, 3.0]
DISTRIBUTIONS: dict[str, Any] = {
    "constant:35": None,
    "uniform:5,25": stats.uniform(5, 20),
    "normal:20,3": stats.truncnorm(-20 / 3, np.inf, 20, 3),
    "gamma:12,3,5": stats.gamma(16, loc=5, scale=9 / 12),
    "exponential:3,10": stats.expon(10, 3),
}
COMMAND_RIGS = {f"{text.partition(':')[0]}-link": text for text in DISTRIBUTIONS}
STATE_DELAY = "uniform:1,6"
RIGS = ("free", *COMMAND_RIGS, "trace", "state-link", "lossy", "scheduled")


@dataclass
class Session:
    """Recording of one rig and its latency report."""

    run: Run
    report: LatencyReport

    @property
    def injected_ms(self) -> np.ndarray:
        return np.asarray(self.report.table["injected"] / 1e6)

    @property
    def loop_ms(self) -> np.ndarray:
        return np.asarray(self.report.table["loop"] / 1e6)


def write_impaired_lab(folder: Path) -> Path:
    trace = folder / "trace.txt"
    trace.write_text("".join(f"{delay}\n" for delay in TRACE_MS))
    impairments = {name: f"command = '{text}'" for name, text in COMMAND_RIGS.items()}
    impairments["trace"] = f"command = 'trace:{trace}'"
    impairments["state-link"] = f"state = '{STATE_DELAY}'"
    impairments["lossy"] = "command.loss = 'gilbert:0.05,0.4'"
    impairments["scheduled"] = "schedule = [{ at_s = 1, command = 'constant:20' }, { at_s = 2, preset = 'none' }]"
    text = f"[sim]\nstep_ms = {STEP_MS}\n[edge]\nfirst_port = {free_ports(len(RIGS))}\nsession_grace_ms = 0\n"
    text += f"[bus]\nfirst_port = {free_ports(3)}\n[recorder]\nfolder = '{folder / 'recordings'}'\n"
    for rig in RIGS:
        text += f"[[rigs]]\nname = '{rig}'\n"
        if rig in impairments:
            text += f"[rigs.impairment]\nseed = {SEED}\n{impairments[rig]}\n"
    path = folder / "lab.toml"
    path.write_text(text)
    return path


def every(period_s: float, cycle: Callable[[RawClient], object]) -> Callable[[int], None]:
    """Return a controller that runs its cycle periodically."""

    def control(port: int) -> None:
        with RawClient("127.0.0.1", port) as client:
            end = time.monotonic() + SECONDS
            while (now := time.monotonic()) < end:
                cycle(client)
                time.sleep(max(0.0, now + period_s - time.monotonic()))

    return control


def read_and_write(client: RawClient) -> None:
    positions = client.read(4, 4)
    client.write(0, positions[0] & 0xFF, 0, 0, 0)


def write_for_each_state(port: int) -> None:
    """Poll for the next state, and write once for each new one."""
    with RawClient("127.0.0.1", port) as client:
        end = time.monotonic() + SECONDS
        last = None
        while time.monotonic() < end:
            step = client.read(2, 2, function=4)
            if step != last:
                last = step
                client.write(0, step[1] & 0xFF, 0, 0, 0)
            time.sleep(0.001)  # polls for the next state


@pytest.fixture(scope="module")
def lab_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("impaired")


@pytest.fixture(scope="module")
def statuses(lab_folder: Path) -> dict[str, Any]:
    """Run the lab, which makes the recordings; return the output of `hilrig impair --json`."""
    config = write_impaired_lab(lab_folder)
    with RunningLab(config) as lab:
        ports = lab.lab.ports
        text = "step 10 ms, impairment: state link none; command link constant"
        assert f"{ports['constant-link']}, {text}" in lab.output()
        assert f"{ports['free']}, step 10 ms\n" in lab.output()
        controllers = {rig: every(0.03, read_and_write) for rig in RIGS} | {"state-link": write_for_each_state}
        threads = [threading.Thread(target=controllers[rig], args=(ports[rig],)) for rig in RIGS]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        done = hilrig("impair", "--json", "--config", config)
        assert done.returncode == 0, done.stderr
        eventually(lambda: len(lab.recordings) == len(RIGS))
    return {row["rig"]: row for row in json.loads(done.stdout)}


@pytest.fixture(scope="module")
def sessions(statuses: dict[str, Any], lab_folder: Path) -> dict[str, Session]:
    runs = [open_run(path) for path in (lab_folder / "recordings").rglob("*.mcap")]
    return {run.rig: Session(run, measure(run)) for run in runs}


def assert_stages_add_up(session: Session) -> None:
    table = session.report.table
    assert np.array_equal(sum(table[stage] for stage in STAGES), table["loop"])
    for stage in STAGES:
        assert (table[stage] >= 0).all(), stage


@pytest.mark.parametrize("rig", COMMAND_RIGS)
def test_injected_delay_has_configured_distribution(sessions: dict[str, Session], rig: str) -> None:
    session, distribution = sessions[rig], DISTRIBUTIONS[COMMAND_RIGS[rig]]
    assert_stages_add_up(session)
    assert session.report.samples > 90
    if distribution is None:
        assert set(session.injected_ms) == {35.0}
    else:
        found = stats.kstest(session.injected_ms, distribution.cdf)
        assert found.pvalue > 0.01, found


@pytest.mark.parametrize("rig", COMMAND_RIGS)
def test_each_command_has_the_delay_of_its_seed(sessions: dict[str, Session], rig: str) -> None:
    commands = sessions[rig].run.commands
    commands = commands[commands["write_arrived_ns"] > 0]
    link = LinkImpairment.model_validate(COMMAND_RIGS[rig])
    sampled, _ = Impairment(link, link_seed(SEED, rig, "command")).draw(2000)
    expected = sampled[(commands["seq"] - commands["seq"][0]).astype(int)]
    assert commands["command_injected_ns"].tolist() == expected.tolist()


def test_trace_is_injected_in_its_order(sessions: dict[str, Session]) -> None:
    """The last command of the session may still have been in flight."""
    assert_stages_add_up(sessions["trace"])
    commands = sessions["trace"].run.commands
    commands = commands[commands["write_arrived_ns"] > 0]
    start = TRACE_MS.index(commands["command_injected_ns"][0] / 1e6)
    first = commands["seq"][0]
    expected = [TRACE_MS[int(start + seq - first) % len(TRACE_MS)] for seq in commands["seq"]]
    assert (commands["command_injected_ns"] / 1e6).tolist() == expected


def test_injected_state_delay_is_that_of_its_seed(sessions: dict[str, Session]) -> None:
    """Each state with a response has the delay of its seed; the delays of the seed have the configured distribution.

    The distribution of the states with a response is not tested: if the machine stalls, a state is superseded by the
    next one and gets no response, more often one with a long delay. The delays restart with a session while some states
    are in flight: the first and last ones are excluded.
    """
    session = sessions["state-link"]
    assert_stages_add_up(session)
    assert session.report.samples > 120
    table = session.report.table[5:-5]
    link = LinkImpairment.model_validate(STATE_DELAY)
    sampled, _ = Impairment(link, link_seed(SEED, "state-link", "state")).draw(3000)
    (first,) = np.flatnonzero(sampled == table["injected"][0])
    after = (table["basis_step"] - table["basis_step"][0]).astype(int)
    assert table["injected"].tolist() == sampled[first + after].tolist()
    found = stats.kstest(sampled[first : first + after[-1] + 1] / 1e6, stats.uniform(1, 5).cdf)
    assert found.pvalue > 0.01, found


@pytest.mark.parametrize("rig", [*COMMAND_RIGS, "trace"])
def test_loop_latency_grows_by_the_injected_delay(sessions: dict[str, Session], rig: str) -> None:
    """Up to the quantization by the tick: an added delay appears as whole steps, and on average as itself."""
    # A stall of the machine affects all rigs; the longest latencies are excluded.
    loop_ms, free_ms, injected_ms = (
        stats.trim_mean(values, 0.05)
        for values in (sessions[rig].loop_ms, sessions["free"].loop_ms, sessions[rig].injected_ms)
    )
    assert loop_ms - free_ms == pytest.approx(injected_ms, abs=0.5 * STEP_MS)
    table = sessions[rig].report.table
    rest = (table["loop"] - table["injected"] - table["tick_wait"]) / 1e6
    # The remaining latency without the wait for the tick does not depend on the injected delay.
    free = sessions["free"].report.table
    free_rest = (free["loop"] - free["tick_wait"]) / 1e6
    assert np.median(rest) == pytest.approx(np.median(free_rest), abs=0.5 * STEP_MS)


def test_lost_commands_leave_gaps_in_the_numbers(sessions: dict[str, Session], statuses: dict[str, Any]) -> None:
    counts = statuses["lossy"]["commands"]
    commands = sessions["lossy"].run.commands
    written = commands[commands["write_arrived_ns"] > 0]
    assert counts["lost"] > 0.04 * counts["count"]
    assert len(written) == counts["count"] - counts["lost"] - counts["overtaken"]
    steps = np.diff(written["seq"].astype(int))
    assert int(steps.max()) > 2, "losses come in bursts"
    assert sessions["lossy"].report.lost.transport == 0, "injected losses must not count as losses of the recording"


def test_schedule_is_followed_and_recorded(sessions: dict[str, Session]) -> None:
    run = sessions["scheduled"].run
    commands = run.commands[run.commands["write_arrived_ns"] > 0]
    begun_ns = commands["write_arrived_ns"][0]
    late = (commands["write_arrived_ns"] - begun_ns) / 1e9
    for low, high, injected_ns in ((0.0, 0.95, 0), (1.1, 1.95, 20_000_000), (2.1, SECONDS, 0)):
        part = commands[(late > low) & (late < high)]
        assert len(part) > 20
        assert set(part["command_injected_ns"].tolist()) == {injected_ns}
    assert run.events["text"][run.events["kind"] == "IMPAIRMENT_CHANGED"].tolist() == [
        f"impairment of scheduled: state link none; command link constant delay 20 ms, seed {SEED} (source: schedule)",
        "impairment of scheduled: none (source: schedule)",
    ]


def test_impaired_run_is_verified_bit_exactly(sessions: dict[str, Session]) -> None:
    done = hilrig("verify", sessions["lossy"].run.path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_recording_can_be_used_as_delay_trace(sessions: dict[str, Session], lab_folder: Path) -> None:
    from hilrig_replay.export.delay_trace import delay_trace

    session = sessions["normal-link"]
    trace = delay_trace(session.run)
    table = session.report.table
    assert trace.delays_ms == tuple(((table["controller"] + table["injected"]) / 1e6).tolist())
    assert np.mean(trace.delays_ms) > np.mean(session.injected_ms), (
        "the trace must include the controller and its network"
    )
