"""Measures the loop latency and the time that the rig adds to a bare zenoh and a bare Modbus round trip.

A C controller on libmodbus polls without pauses against a complete lab (simulation, edge and recorder as processes, as
`hilrig up` starts them) at steps of 20, 5 and 1 ms. The peers are measured in the same run on the same machine: a
message from one Python process to another over zenoh and back, and the same C controller against a minimal libmodbus
server. The latency is computed from the recording as `hilrig latency` does. Thresholds are checked on the samples
without CPU steal nearby.

The cost of recording is measured in one lab that keeps running while a recorder is started and stopped in turn. There
the latency is taken from the states that a subscriber receives from the bus.
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
from steal import StealMonitor

from hilrig_cli.local.local_lab import free_ports, running_lab
from hilrig_cli.local.supervisor import DEFAULT_PROCESSES, Supervisor
from hilrig_replay.analysis import latency
from hilrig_replay.analysis.stages import STAGES
from hilrig_replay.io.run import open_run
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.bus import BusConfig
from hilrig_schemas import JointState
from hilrig_schemas.topics import STATE, Traffic, alive_key

QUESTION = "How large is the loop latency, and what does the rig add to a bare zenoh and a bare Modbus round trip?"
RUN_S = {20.0: 20.0, 5.0: 12.0, 1.0: 12.0}
"""Duration of a run, s, by the step, ms: at least a thousand samples."""
WINDOW_S = {20.0: 7.0, 5.0: 5.0}
"""Duration of a measurement with or without a recorder, s, by the step, ms."""
MIN_UNDISTURBED_SAMPLES = {20.0: 2_000, 5.0: 4_000, 1.0: 10_000}
"""Undisturbed samples after which no further run is started, by the step, ms."""
MIN_WINDOW_SAMPLES, MAX_WINDOW_TRIES = 100, 4
"""Undisturbed samples that a measurement with or without a recorder needs, and how often it is tried."""
LOOP_THRESHOLDS_STEPS = {
    20.0: {"p50": 1.005, "p99.9": 1.05},
    5.0: {"p99.9": 1.2},
    1.0: {"p50": 1.05, "p99": 2.0},
}
"""Largest loop latency without CPU steal nearby, in steps, by the step, ms."""


def measure(report: Report, quick: bool) -> None:
    """Measure the peers, the loop and the cost of recording."""
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
        done: list[RigRun] = []
        while len(done) < runs or (
            not quick
            and len(done) < 2 * runs
            and sum(int(run.undisturbed.sum()) for run in done) < MIN_UNDISTURBED_SAMPLES[step_ms]
        ):
            progress(f"the rig at a step of {step_ms:g} ms, run {len(done) + 1}")
            done.append(rig_run(client, step_ms, 5.0 if quick else seconds))
        add_loop(report, step_ms, done)
        if step_ms == 20:
            rig_read_p50 = statistics.median(run.figures["read_us"]["p50"] for run in done)
            report.add("rig, 20 ms", "Modbus read p50", rig_read_p50, "µs")
            report.add("rig, 20 ms", "Modbus read p50, ratio to bare Modbus", rig_read_p50 / read_p50, "ratio")
    for step_ms, seconds in WINDOW_S.items():
        progress(f"with and without a recorder, at a step of {step_ms:g} ms")
        add_recording_cost(report, step_ms, alternate_recorder(client, step_ms, 1 if quick else 4, seconds))


@dataclass(frozen=True, slots=True)
class RigRun:
    """One session of the controller with a complete lab."""

    samples: NDArray[np.void]
    """Samples as `hilrig latency` computes them from the recording, ns."""
    undisturbed: NDArray[np.bool_]
    """Whether there was no CPU steal near the sample, one value per sample."""
    lost: int
    figures: dict[str, Any]
    """Round-trip times that the controller measured."""
    steal: float
    """CPU steal, CPUs."""
    edge_us: float
    """CPU time of the edge per controller cycle, µs."""


def rig_run(client: Path, step_ms: float, seconds: float) -> RigRun:
    """Run the controller against a lab of one rig."""
    with tempfile.TemporaryDirectory() as folder:
        lab, config, port = write_lab(Path(folder), step_ms=step_ms)
        with running_lab(lab, config, log, threading.Event()) as supervisor, StealMonitor() as steal:
            before_s = cpu_seconds(supervisor.pids["edge"])
            figures = run_client(client, port, seconds)
            edge_s = cpu_seconds(supervisor.pids["edge"]) - before_s
        (recording,) = Path(folder).rglob("*.mcap")
        found = latency.measure(open_run(recording))
    undisturbed = steal.undisturbed(found.table["wall_ns"])
    edge_us = 1e6 * edge_s / (figures["cycles_per_s"] * seconds)
    return RigRun(
        found.table, undisturbed, found.lost.transport + found.lost.recorder, figures, steal.mean_cpus, edge_us
    )


def add_loop(report: Report, step_ms: float, runs: list[RigRun]) -> None:
    """Add the latencies of all samples and of those without CPU steal nearby, and check the thresholds."""
    case = f"rig, {step_ms:g} ms"
    samples = np.concatenate([run.samples for run in runs])
    undisturbed = np.concatenate([run.undisturbed for run in runs])
    report.add(case, "runs", len(runs), "count")
    report.add(case, "samples", len(samples), "count")
    report.add(case, "CPU steal", statistics.mean(run.steal for run in runs), "CPUs")
    report.add(case, "samples without CPU steal nearby", 100 * float(undisturbed.mean()), "%")
    loop: dict[str, float] = {}
    for selection, selected in (("all samples", samples), ("samples without CPU steal nearby", samples[undisturbed])):
        for name, quantile in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0)):
            loop[name] = float(np.quantile(selected["loop"], quantile)) / 1e6 if len(selected) else float("nan")
            report.add(case, f"loop {name}, {selection}", loop[name], "ms")
    for stage in STAGES:
        report.add(case, f"stage {stage} p50", float(np.median(samples[stage])) / 1e6, "ms")
    report.add(case, "lost", max(run.lost for run in runs), "count")
    report.add(case, "Modbus cycles", statistics.median(run.figures["cycles_per_s"] for run in runs), "1/s")
    report.add(case, "edge: CPU time per cycle", statistics.median(run.edge_us for run in runs), "µs")
    for name, bound in LOOP_THRESHOLDS_STEPS[step_ms].items():
        report.require(f"{step_ms:g} ms step: loop {name} in steps", loop[name] / step_ms, "<=", bound)


def median(runs: list[dict[str, Any]], group: str, key: str) -> float:
    return statistics.median(run[group][key] for run in runs)


@dataclass(frozen=True, slots=True)
class Window:
    """One measurement with or without a recorder."""

    loop_ms: list[float]
    """Loop latency of the commands without CPU steal nearby; of all commands if too few are left."""
    cycles_per_s: float
    steal: float
    """CPU steal, CPUs."""


def alternate_recorder(client: Path, step_ms: float, pairs: int, seconds: float) -> list[tuple[Window, Window]]:
    """Measure pairs without and with a recorder, in one lab that keeps running."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        lab, config, port = write_lab(Path(folder), step_ms=step_ms)
        others = tuple(spec for spec in DEFAULT_PROCESSES if spec.service != "recorder")
        recorder = tuple(spec for spec in DEFAULT_PROCESSES if spec.service == "recorder")
        with (
            running_lab(lab, config, log, threading.Event(), others),
            ZenohBus(lab.bus, "tool") as bus,
        ):
            received: list[bytes] = []
            bus.subscribe(STATE.key(lab.name, lab.rigs[0].name), lambda _, payload: received.append(payload))

            def measure_window() -> Window:
                for _ in range(MAX_WINDOW_TRIES):
                    received.clear()
                    with StealMonitor() as steal:
                        figures = run_client(client, port, seconds)
                    states = [state for state in map(JointState.FromString, received.copy()) if state.basis_step]
                    loop_ms = np.array([state.loop_latency_ns / 1e6 for state in states])
                    undisturbed = steal.undisturbed([state.wall_ns for state in states])
                    if undisturbed.sum() >= MIN_WINDOW_SAMPLES:
                        loop_ms = loop_ms[undisturbed]
                        break
                return Window(loop_ms.tolist(), figures["cycles_per_s"], steal.mean_cpus)

            for pair in range(pairs):
                without = measure_window() if pair % 2 == 0 else None
                with Supervisor(config, log, recorder) as supervisor:
                    supervisor.start()
                    while not bus.get_liveliness(alive_key(lab.name, "recorder", "*"), timeout_s=0.5):
                        supervisor.poll()
                    # After this time the recorder has recovered the messages published before its start.
                    time.sleep(1.0)
                    recorded = measure_window()
                found.append((without or measure_window(), recorded))
    return found


def add_recording_cost(report: Report, step_ms: float, pairs: list[tuple[Window, Window]]) -> None:
    case = f"recorder off and on, {step_ms:g} ms"
    report.add(case, "pairs of measurements", len(pairs), "count")
    for number, name in enumerate(("off", "on")):
        windows = [pair[number] for pair in pairs]
        pooled = [latency for window in windows for latency in window.loop_ms]
        report.add(case, f"samples, {name}", len(pooled), "count")
        report.add(case, f"loop p50, {name}", percentile(pooled, 0.5), "ms")
        report.add(case, f"loop p99, {name}", percentile(pooled, 0.99), "ms")
        report.add(case, f"Modbus cycles, {name}", statistics.median(window.cycles_per_s for window in windows), "1/s")
        report.add(case, f"CPU steal, {name}", statistics.mean(window.steal for window in windows), "CPUs")
    cycles = statistics.median(on.cycles_per_s / off.cycles_per_s for off, on in pairs)
    report.add(case, "Modbus cycles, ratio of on to off, median of pairs", cycles, "ratio")
    # The ratio of each pair: the other load of the machine is similar at neighboring times.
    ratio = statistics.median(percentile(on.loop_ms, 0.99) / percentile(off.loop_ms, 0.99) for off, on in pairs)
    report.require(f"{step_ms:g} ms step: loop p99, ratio of with to without a recorder", ratio, "<=", 1.1)


def log(line: str) -> None:
    """Print a line of the supervisor on standard error."""
    print(line, file=sys.stderr)


def run_client(client: Path, port: int, seconds: float) -> dict[str, Any]:
    """Run the C controller and return its figures."""
    command = [str(client), "127.0.0.1", str(port), str(seconds), "0"]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, timeout=seconds + 30).stdout
    figures: dict[str, Any] = json.loads(output)
    return figures


def modbus_round_trip(client: Path, server: Path, seconds: float) -> dict[str, Any]:
    """Run the C controller against the minimal server and return its figures."""
    port = free_ports(5920)
    with subprocess.Popen([str(server), str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        figures = run_client(client, port, seconds)
        process.stdin.close()
    return figures


def zenoh_round_trip(rounds: int) -> tuple[float, float]:
    """Return p50 and p99 of the round trip of a message over zenoh to another process, sent every 20 ms, µs."""
    config = BusConfig(first_port=free_ports(7547, 3))
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=echo_over_zenoh, args=(config, there), daemon=True)
    process.start()
    here.recv()
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
    here.send(None)
    process.join(10)
    return percentile(times_us, 0.5), percentile(times_us, 0.99)


def echo_over_zenoh(config: BusConfig, until: multiprocessing.connection.Connection) -> None:
    """Send each message back until the other end of the pipe sends an object."""
    with ZenohBus(config, "sim") as bus:
        pong = bus.publisher(STATE.key("bench", "pong"), Traffic.CONTROL)
        bus.subscribe(STATE.key("bench", "ping"), lambda _, payload: pong.put(payload))
        until.send(None)
        until.recv()


if __name__ == "__main__":
    sys.exit(harness.run(measure, QUESTION))
