"""Measures how many rigs one machine runs, each with its own controller and its own recording.

A lab of 1 to 256 rigs at a step of 20 ms runs as `hilrig up` starts it. A load generator in C holds a TCP connection to
each rig and reads and writes once every 20 ms, with phases spread over the period. Latency comes from the recordings,
CPU time and memory from the health reports of the services. The load generator uses a real-time policy, because its
controllers represent other machines, which don't share the CPUs of this one.

A loop closes within one step when the state link, the controller's read and write, and the command link all lie between
two ticks. For a controller of random phase a tick falls into this interval with the probability (sum of these times) /
step; then the loop takes two steps. This is a property of the sampling and not a fault. So the 99th percentile of many
controllers is two steps, and the percentage within one step is the figure that distinguishes machines: 93 % correspond
to a sum of 1.4 ms. The three times are measured separately, because all processes share this machine's monotonic clock.

CPU steal delays loops for a reason outside hilrig. Thresholds are therefore checked on the loops without CPU steal
nearby, if there are enough of them; the tables show all loops too.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import harness
import numpy as np
from harness import Report, build_c, progress, rigs_text, write_lab
from numpy.typing import NDArray
from steal import StealMonitor

from hilrig_cli.local.local_lab import running_lab
from hilrig_cli.local.supervisor import lab_processes
from hilrig_modbus_edge.command_scheduler import DEADLINE_MARGIN_NS
from hilrig_replay.analysis.latency import measure as latency_of
from hilrig_replay.analysis.samples import join_commands
from hilrig_replay.io.run import Run, open_run
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_schemas import Health
from hilrig_schemas.topics import HEALTH

QUESTION = "How many rigs does one machine run, each with its own controller and recording?"
COUNTS = (1, 16, 64, 128, 256)
REQUIRED_RIGS = 128
STEP_MS = 20.0
RIGS = os.environ.get("HILRIG_BENCH_RIGS", "")
"""Numbers of rigs, separated by commas; empty: `COUNTS`."""
EDGES = tuple(map(int, os.environ.get("HILRIG_BENCH_EDGES", "1").split(",")))
"""Numbers of edges that share the rigs; each is measured."""
SETTLE_S = 2.0
"""Time after which a run is in its steady state: sessions have started and files are open."""
MIN_UNDISTURBED_SAMPLES = 5_000
"""Undisturbed loops that are needed to determine a percentage within half a percent."""


@dataclass
class LabRun:
    """Results of one run with some number of rigs."""

    rigs: int
    load: dict[str, Any]
    steps: NDArray[np.int64]
    """Steps from a command's basis to the step at which the command took effect, one value per sample."""
    loop_ms: NDArray[np.float64]
    undisturbed: NDArray[np.bool_]
    """Whether there was no CPU steal near the sample, one value per sample."""
    steal: float
    """CPU steal, CPUs."""
    links_ms: dict[str, NDArray[np.float64]]
    """Times of the state link, of read to write and of the command link, one value per sample each."""
    longest_hold: int
    """Largest number of steps for which one command was in effect before a newer one replaced it."""
    lost: int
    recordings: int
    wall_s: float
    cpu_s: dict[str, float] = field(default_factory=dict)
    """CPU time of each service while the load ran."""
    resident_mib: dict[str, float] = field(default_factory=dict)
    lateness_p99_ms: float = 0.0
    overruns: int = 0


def measure(report: Report, quick: bool) -> None:
    """Run labs of all sizes under load."""
    build = build_c("scale_load.c", library="")
    counts = tuple(map(int, RIGS.split(","))) if RIGS else COUNTS
    for count in counts:
        for edges in EDGES:
            progress(f"{rigs_text(count)}, {edges} edge{'s' if edges != 1 else ''}")
            add(report, run_lab(build, count, edges, 6.0 if quick else 15.0), edges)
    report.add_note(
        "A loop takes one step when the read, the write and both links lie between two ticks. The phases are spread "
        "evenly, so the 99th percentile is two steps as soon as a tick falls into this interval for more than 1 % of "
        "the phases; in ms it is two steps plus the jitter of the tick."
    )


def add(report: Report, lab_run: LabRun, edges: int) -> None:
    """Add the results and thresholds of one run."""
    case = rigs_text(lab_run.rigs) + (f", {edges} edges" if edges != 1 else "")
    is_counted = lab_run.undisturbed
    if is_counted.sum() < MIN_UNDISTURBED_SAMPLES:
        is_counted = np.ones_like(is_counted)
    counted = lab_run.steps[is_counted]
    within = float((lab_run.steps <= 1).mean())
    report.add(case, "loop p50", float(np.percentile(lab_run.loop_ms, 50)), "ms")
    report.add(case, "loop p99", float(np.percentile(lab_run.loop_ms, 99)), "ms")
    report.add(case, "within one step", 100 * within, "%")
    report.add(case, "longest hold of a command", lab_run.longest_hold, "steps")
    if not is_counted.all():
        report.add(case, "within one step, without CPU steal nearby", 100 * float((counted <= 1).mean()), "%")
    report.add(case, "samples without CPU steal nearby", int(lab_run.undisturbed.sum()), "count")
    report.add(case, "CPU steal", lab_run.steal, "CPUs")
    for link, times_ms in lab_run.links_ms.items():
        for percent in (50, 99):
            report.add(case, f"{link} p{percent}", float(np.percentile(times_ms, percent)), "ms")
    total_ms = sum(float(times_ms.mean()) for times_ms in lab_run.links_ms.values())
    report.add(
        case, "within one step, predicted for evenly spread phases", max(0.0, 100 * (1 - total_ms / STEP_MS)), "%"
    )
    report.add(case, "samples", len(lab_run.steps), "count")
    report.add(case, "lost", lab_run.lost, "count")
    wanted = lab_run.rigs * lab_run.wall_s / (STEP_MS * 1e-3)
    report.add(case, "cycles completed, relative to the planned number", 100 * lab_run.load["cycles"] / wanted, "%")
    report.add(case, "read p50", lab_run.load["read_us"]["p50"], "µs")
    report.add(case, "read p99", lab_run.load["read_us"]["p99"], "µs")
    report.add(case, "tick lateness p99", lab_run.lateness_p99_ms, "ms")
    report.add(case, "overruns", lab_run.overruns, "count")
    for service, cpu_s in sorted(lab_run.cpu_s.items()):
        report.add(case, f"CPU load, {service}", 100 * cpu_s / lab_run.wall_s, "% of a core")
        report.add(case, f"memory, {service}", lab_run.resident_mib[service], "MiB")
    report.add(case, "CPU load, load generator", 100 * lab_run.load["cpu_s"] / lab_run.wall_s, "% of a core")
    cpu_load = sum(lab_run.cpu_s.values()) / lab_run.wall_s
    report.add(case, "CPU load per rig, all services", 1e3 * cpu_load / lab_run.rigs, "mcore")
    if lab_run.rigs == REQUIRED_RIGS:
        report.require(f"{case}: loop p99 in steps", float(np.percentile(counted, 99)), "<=", 2)
        report.require(f"{case}: loops within one step", 100 * float((counted <= 1).mean()), ">=", 93, "%")
        report.require(f"{case}: messages lost", lab_run.lost, "<=", 0)
        report.require(f"{case}: recordings per rig", lab_run.recordings / lab_run.rigs, ">=", 1)


def run_lab(load: Path, count: int, edges: int, seconds: float) -> LabRun:
    """Run a lab of `count` rigs on `edges` edges under load and return the results."""
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        lab, config, port = write_lab(Path(folder), rigs=count, step_ms=STEP_MS)
        processes = lab_processes([rig.name for rig in lab.rigs], edges=edges)
        healths: dict[str, list[Health]] = {}

        def on_health(_: str, payload: bytes) -> None:
            health = Health.FromString(payload)
            healths.setdefault(f"{health.service} {health.instance}", []).append(health)

        with (
            running_lab(lab, config, lambda line: print(line, file=sys.stderr), threading.Event(), processes),
            ZenohBus(lab.bus, "tool") as bus,
            StealMonitor() as steal,
        ):
            bus.subscribe(HEALTH.key(lab.name, "*", "*"), on_health)
            wall_ns = SYSTEM_CLOCK.wall_ns()
            command = [str(load), "127.0.0.1", str(port), str(count), str(seconds + SETTLE_S), str(STEP_MS)]
            output = subprocess.run(command, check=True, stdout=subprocess.PIPE, timeout=seconds + 60).stdout
        figures = json.loads(output)
        begin_ns, end_ns = wall_ns + round(SETTLE_S * 1e9), wall_ns + round((SETTLE_S + figures["seconds"]) * 1e9)
        lab_run = evaluate_recordings(Path(folder), count, figures, begin_ns, steal)
    for service, reports in healths.items():
        # A service that sent no report in the steady state is evaluated by its first and last report.
        steady = [health for health in reports if begin_ns <= health.wall_ns <= end_ns] or reports
        first, last = steady[0], steady[-1]
        cpu_load = (last.cpu_ns - first.cpu_ns) / max(1, last.wall_ns - first.wall_ns)
        lab_run.cpu_s[service] = cpu_load * lab_run.wall_s
        lab_run.resident_mib[service] = last.resident_bytes / 2**20
        if service.startswith("sim"):
            lab_run.lateness_p99_ms = max(health.lateness_p99_ns for health in steady) / 1e6
            lab_run.overruns = last.overruns - first.overruns
    return lab_run


def evaluate_recordings(
    folder: Path, count: int, figures: dict[str, Any], begin_ns: int, steal: StealMonitor
) -> LabRun:
    """Return the results of a run from its recordings, without the figures of the health reports."""
    steps, loops, undisturbed, lost, recordings, longest_hold = [], [], [], 0, set(), 0
    links: dict[str, list[NDArray[np.float64]]] = {}
    for path in folder.rglob("*.mcap"):
        run = open_run(path)
        result = latency_of(run)
        recordings.add(result.rig)
        table = result.table[:]
        table = table[table["wall_ns"] >= begin_ns]
        steps.append(table["step"].astype(np.int64) - table["basis_step"].astype(np.int64))
        loops.append(table["loop"] / 1e6)
        table_steps: NDArray[np.int64] = table["step"].astype(np.int64)
        longest_hold = max(longest_hold, int(np.diff(table_steps).max(initial=0)))
        undisturbed.append(steal.undisturbed(table["wall_ns"]))
        lost += result.lost.transport + result.lost.recorder
        for link, times_ms in link_times(run, begin_ns).items():
            links.setdefault(link, []).append(times_ms)
    return LabRun(
        rigs=count,
        load=figures,
        steps=np.concatenate(steps),
        loop_ms=np.concatenate(loops),
        undisturbed=np.concatenate(undisturbed),
        steal=steal.mean_cpus,
        links_ms={link: np.concatenate(parts) for link, parts in links.items()},
        longest_hold=longest_hold,
        lost=lost,
        recordings=len(recordings),
        wall_s=figures["seconds"],
    )


def link_times(run: Run, begin_ns: int) -> dict[str, NDArray[np.float64]]:
    """Return the times of both links and of read to write, ms, one value per sample of the steady state."""
    states, commands = run.states, run.commands
    rows, is_there = join_commands(states, commands)
    new = is_there & (states["command_arrived_ns"] > 0) & (states["wall_ns"] >= begin_ns)
    applied, command = states[new], commands[rows[new]]
    ticks = np.searchsorted(states["step"], command["basis_step"])
    known = (command["basis_step"] > 0) & (ticks < len(states))
    applied, command, basis = applied[known], command[known], states[ticks[known]]
    # With many rigs the edge holds a command that has time until the tick: this wait is not part of the link.
    sent_ns: NDArray[np.int64] = command["sent_ns"]
    is_near = applied["sampled_ns"] - sent_ns < DEADLINE_MARGIN_NS
    if not is_near.any():
        # One rig, whose controller never writes near the tick: the edge held no command.
        is_near[:] = True
    basis_ns: NDArray[np.int64] = basis["sampled_ns"]
    served_ns: NDArray[np.int64] = command["state_served_ns"]
    state_arrived_ns: NDArray[np.int64] = command["state_arrived_ns"]
    command_arrived_ns: NDArray[np.int64] = applied["command_arrived_ns"]
    return {
        "state link": (state_arrived_ns - basis_ns) / 1e6,
        "read to write": (sent_ns - served_ns) / 1e6,
        "command link": (command_arrived_ns - sent_ns)[is_near] / 1e6,
    }


if __name__ == "__main__":
    sys.exit(harness.run(measure, QUESTION))
