"""How long is the loop, and what does the rig add to a bare zenoh and a bare Modbus round trip?

A C controller on libmodbus polls as fast as it can against the whole lab (simulation, edge and recorder as
processes, as `hilrig up` starts them), at steps of 20, 5 and 1 ms. In the same run, on the same machine: a message
that goes from one Python process to another over zenoh and back, and the same C controller against the least Modbus
server that libmodbus makes. Latency is what `hilrig latency` finds in the recording; what is promised is held
against the samples near which the host of a virtual machine took nothing away.

What recording costs is measured in one lab that runs on while its recorder comes and goes, in turns. Latency is then
what the states themselves say, as a witness on the bus hears them.
"""

import json
import multiprocessing
import multiprocessing.connection
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
import numpy as np
from harness import Report, build_c, cpu_seconds, percentile, progress, write_lab
from numpy.typing import NDArray
from stolen import StolenTime

from hilrig_cli.local.demo import free_ports
from hilrig_cli.local.local_lab import running_lab
from hilrig_cli.local.supervisor import DEFAULT_PROCESSES, Supervisor
from hilrig_replay.analysis import latency
from hilrig_replay.io.run import open_run
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.bus import BusConfig
from hilrig_schemas import JointState
from hilrig_schemas.topics import STATE, Traffic, alive_key

QUESTION = "How long is the loop, and what does the rig add to a bare zenoh and a bare Modbus round trip?"
RUN_S = {20.0: 20.0, 5.0: 12.0, 1.0: 12.0}
"""How long a run takes at each step, ms: a thousand samples or more."""
WINDOW_S = {20.0: 7.0, 5.0: 5.0}
"""How long each turn with or without a recorder takes."""
ENOUGH = {20.0: 2_000, 5.0: 4_000, 1.0: 10_000}
"""Samples with no stolen time near, after which no further run is made."""
FEW, TURNS = 100, 4
"""Such samples of a turn with or without a recorder, and how often it is made again where there are fewer."""
PROMISED = {
    20.0: {"p50": 1.005, "p99.9": 1.05},
    5.0: {"p99.9": 1.2},
    1.0: {"p50": 1.05, "p99": 2.0},
}
"""Most that the loop may take at each step, in steps, where nothing is taken away."""


def measure(report: Report, quick: bool) -> None:
    client = build_c("loop_client.c")
    echo = build_c("modbus_echo_server.c")
    runs = 1 if quick else 3

    progress("bare Modbus round trip")
    bare_modbus = [modbus_round_trip(client, echo, 2.0) for _ in range(runs)]
    read_p50 = report.add("bare Modbus", "read p50", median(bare_modbus, "read_us", "p50"), "µs")
    report.add("bare Modbus", "read p99", median(bare_modbus, "read_us", "p99"), "µs")
    progress("bare zenoh round trip")
    zenoh_p50, zenoh_p99 = zenoh_round_trip(50 if quick else 250)
    report.add("bare zenoh, 50 Hz", "round trip p50", zenoh_p50, "µs")
    report.add("bare zenoh, 50 Hz", "round trip p99", zenoh_p99, "µs")

    for step_ms, seconds in RUN_S.items():
        made: list[RigRun] = []
        while len(made) < runs or (
            len(made) < 2 * runs and sum(int(run.counts.sum()) for run in made) < ENOUGH[step_ms] and not quick
        ):
            progress(f"the rig at a step of {step_ms:g} ms, run {len(made) + 1}")
            made.append(rig_run(client, step_ms, 5.0 if quick else seconds))
        add_loop(report, step_ms, made)
        if step_ms == 20:
            ours = statistics.median(run.figures["read_us"]["p50"] for run in made)
            report.add("rig, 20 ms", "Modbus read p50", ours, "µs")
            report.add("rig, 20 ms", "Modbus read against bare Modbus", ours / read_p50, "ratio")
    for step_ms, seconds in WINDOW_S.items():
        progress(f"with and without a recorder, at a step of {step_ms:g} ms")
        add_cost_of_recording(report, step_ms, recorder_comes_and_goes(client, step_ms, 1 if quick else 4, seconds))


@dataclass(frozen=True, slots=True)
class RigRun:
    """One session of the controller with the whole lab."""

    samples: NDArray[np.void]
    """As `hilrig latency` finds them in the recording; ns."""
    counts: NDArray[np.bool_]
    """Of each sample, whether nothing was stolen near it."""
    lost: int
    figures: dict[str, Any]
    """The controller's own."""
    stolen: float
    """CPU steal time, processors."""
    edge_us: float
    """Processor time of the edge for one cycle of the controller, µs."""


def rig_run(client: Path, step_ms: float, seconds: float) -> RigRun:
    with tempfile.TemporaryDirectory() as folder:
        lab, config, port = write_lab(Path(folder), step_ms=step_ms)
        with running_lab(lab, config, say, threading.Event()) as supervisor, StolenTime() as stolen:
            before_s = cpu_seconds(supervisor.pids["edge"])
            figures = run_client(client, port, seconds)
            edge_s = cpu_seconds(supervisor.pids["edge"]) - before_s
        (recording,) = Path(folder).rglob("*.mcap")
        found = latency.measure(open_run(recording))
    counts = stolen.undisturbed(found.table["wall_ns"])
    edge_us = 1e6 * edge_s / (figures["cycles_per_s"] * seconds)
    return RigRun(found.table, counts, found.lost.transport + found.lost.recorder, figures, stolen.share, edge_us)


def add_loop(report: Report, step_ms: float, runs: list[RigRun]) -> None:
    """Figures of all samples, and of those that count: a virtual machine's host takes processors away as it likes."""
    case = f"rig, {step_ms:g} ms"
    samples = np.concatenate([run.samples for run in runs])
    counts = np.concatenate([run.counts for run in runs])
    report.add(case, "runs", len(runs), "count")
    report.add(case, "samples", len(samples), "count")
    report.add(case, "taken away by the host", statistics.mean(run.stolen for run in runs), "processors")
    report.add(case, "samples with nothing taken near", 100 * float(counts.mean()), "%")
    loop: dict[str, float] = {}
    for which, of in (("all samples", samples), ("nothing taken near", samples[counts])):
        for name, quantile in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0)):
            loop[name] = float(np.quantile(of["loop"], quantile)) / 1e6 if len(of) else float("nan")
            report.add(case, f"loop {name}, {which}", loop[name], "ms")
    for stage in latency.STAGES:
        report.add(case, f"stage {stage} p50", float(np.median(samples[stage])) / 1e6, "ms")
    report.add(case, "lost", max(run.lost for run in runs), "count")
    report.add(case, "Modbus cycles", statistics.median(run.figures["cycles_per_s"] for run in runs), "1/s")
    report.add(case, "edge, processor time a cycle", statistics.median(run.edge_us for run in runs), "µs")
    for name, bound in PROMISED[step_ms].items():
        report.bar(f"{step_ms:g} ms step: loop {name} in steps", loop[name] / step_ms, "<=", bound)


def median(runs: list[dict[str, Any]], group: str, key: str) -> float:
    return statistics.median(run[group][key] for run in runs)


@dataclass(frozen=True, slots=True)
class Window:
    """A turn of the controller."""

    loop_ms: list[float]
    """Loop latency of each command that took effect with no stolen time near; of all, if it was near nearly all."""
    cycles_per_s: float
    stolen: float
    """Taken away by the host, processors."""


def recorder_comes_and_goes(client: Path, step_ms: float, pairs: int, seconds: float) -> list[tuple[Window, Window]]:
    """Turns without and with a recorder, in pairs, in one lab that runs on."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        lab, config, port = write_lab(Path(folder), step_ms=step_ms)
        others = tuple(spec for spec in DEFAULT_PROCESSES if spec.service != "recorder")
        recorder = tuple(spec for spec in DEFAULT_PROCESSES if spec.service == "recorder")
        with (
            running_lab(lab, config, say, threading.Event(), others),
            ZenohBus(lab.bus, "tool") as bus,
        ):
            heard: list[bytes] = []
            bus.subscribe(STATE.key(lab.name, lab.rigs[0].name), lambda _, payload: heard.append(payload))

            def turn() -> Window:
                for _ in range(TURNS):
                    heard.clear()
                    with StolenTime() as stolen:
                        figures = run_client(client, port, seconds)
                    states = [state for state in map(JointState.FromString, heard.copy()) if state.basis_step]
                    loop_ms = np.array([state.loop_latency_ns / 1e6 for state in states])
                    counts = stolen.undisturbed([state.wall_ns for state in states])
                    if counts.sum() >= FEW:
                        loop_ms = loop_ms[counts]
                        break
                return Window(loop_ms.tolist(), figures["cycles_per_s"], stolen.share)

            for pair in range(pairs):
                without = turn() if pair % 2 == 0 else None
                with Supervisor(config, say, recorder) as supervisor:
                    supervisor.start()
                    while not bus.get_liveliness(alive_key(lab.name, "recorder", "*"), timeout_s=0.5):
                        supervisor.poll()
                    # What it missed before it came it has fetched by then.
                    time.sleep(1.0)
                    recorded = turn()
                found.append((without or turn(), recorded))
    return found


def add_cost_of_recording(report: Report, step_ms: float, pairs: list[tuple[Window, Window]]) -> None:
    case = f"recorder off and on, {step_ms:g} ms"
    report.add(case, "pairs of turns", len(pairs), "count")
    for number, name in enumerate(("off", "on")):
        windows = [pair[number] for pair in pairs]
        pooled = [latency for window in windows for latency in window.loop_ms]
        report.add(case, f"samples, {name}", len(pooled), "count")
        report.add(case, f"loop p50, {name}", percentile(pooled, 0.5), "ms")
        report.add(case, f"loop p99, {name}", percentile(pooled, 0.99), "ms")
        report.add(case, f"Modbus cycles, {name}", statistics.median(window.cycles_per_s for window in windows), "1/s")
        report.add(
            case, f"taken away by the host, {name}", statistics.mean(one.stolen for one in windows), "processors"
        )
    cycles = statistics.median(on.cycles_per_s / off.cycles_per_s for off, on in pairs)
    report.add(case, "Modbus cycles, on over off, median of pairs", cycles, "ratio")
    # Of each pair, as the two are neighbours in time: what else the machine does is the same then.
    ratio = statistics.median(percentile(on.loop_ms, 0.99) / percentile(off.loop_ms, 0.99) for off, on in pairs)
    report.bar(f"{step_ms:g} ms step: loop p99 with a recorder over without", ratio, "<=", 1.1)


def say(line: str) -> None:
    print(line, file=sys.stderr)


def run_client(client: Path, port: int, seconds: float) -> dict[str, Any]:
    command = [str(client), "127.0.0.1", str(port), str(seconds), "0"]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, timeout=seconds + 30).stdout
    figures: dict[str, Any] = json.loads(output)
    return figures


def modbus_round_trip(client: Path, server: Path, seconds: float) -> dict[str, Any]:
    port = free_ports(5920)
    with subprocess.Popen([str(server), str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        figures = run_client(client, port, seconds)
        process.stdin.close()
    return figures


def zenoh_round_trip(rounds: int) -> tuple[float, float]:
    """p50 and p99 of a message to another process and back over zenoh, sent every 20 ms, µs."""
    config = BusConfig(first_port=free_ports(7547, 3))
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=echo_over_zenoh, args=(config, theirs), daemon=True)
    process.start()
    ours.recv()
    times_us = []
    with ZenohBus(config, "edge") as bus:
        back = threading.Event()
        bus.subscribe(STATE.key("bench", "pong"), lambda *_: back.set())
        ping = bus.publisher(STATE.key("bench", "ping"), Traffic.CONTROL)
        payload = bytes(150)
        while not back.is_set():
            ping.put(payload)
            back.wait(0.1)
        time.sleep(0.3)
        for _ in range(rounds):
            time.sleep(0.02)
            back.clear()
            begin = time.perf_counter_ns()
            ping.put(payload)
            if back.wait(1.0):
                times_us.append((time.perf_counter_ns() - begin) / 1e3)
    ours.send(None)
    process.join(10)
    return percentile(times_us, 0.5), percentile(times_us, 0.99)


def echo_over_zenoh(config: BusConfig, until: multiprocessing.connection.Connection) -> None:
    with ZenohBus(config, "sim") as bus:
        pong = bus.publisher(STATE.key("bench", "pong"), Traffic.CONTROL)
        bus.subscribe(STATE.key("bench", "ping"), lambda _, payload: pong.put(payload))
        until.send(None)
        until.recv()


if __name__ == "__main__":
    sys.exit(harness.run(measure, QUESTION))
