"""How many rigs does one machine carry, each with a controller of its own, all of them recorded?

A lab of 1 to 256 rigs at a step of 20 ms runs as `hilrig up` starts it. A load generator in C holds a TCP connection to
each rig and reads and writes once every 20 ms, with phases spread over the period. Latency is what the recordings say;
processor time and memory are what the services' own health reports say. The load generator asks for the real-time
policy, for its controllers stand for other machines, which would not wait for this one's processes.

A loop closes within one step when a state's way to the edge, the controller's read and write, and its command's way to
the simulation lie between two ticks. A controller whose phase is anything meets a tick in between with the share
(sum of these) / step, and then takes two steps, by nature and not by a fault. So the 99th percentile of many
controllers is two steps, and the share within one step tells machines apart: 94 % are 1.2 ms for all of it. The three
parts are measured one by one, which is possible as all processes share this machine's monotonic clock.

Where the host of a virtual machine takes processors away, a loop waits for what is no part of the rig. What is promised
is judged by the loops that closed with no stolen time near them, if there are enough of these; said are all.
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
from harness import Report, build_c, progress, write_lab
from numpy.typing import NDArray
from stolen import StolenTime

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

QUESTION = "How many rigs does one machine carry, each with a controller of its own, all of them recorded?"
COUNTS = (1, 16, 64, 128, 256)
PROMISED = 128
STEP_MS = 20.0
RIGS = os.environ.get("HILRIG_BENCH_RIGS", "")
"""Numbers of rigs to try, with commas between them; empty: those above."""
EDGES = tuple(map(int, os.environ.get("HILRIG_BENCH_EDGES", "1").split(",")))
"""Numbers of edges that share the rigs, each tried."""
SETTLE_S = 2.0
"""Sessions begin, files are opened: the first so many seconds of a run are not its steady state."""
ENOUGH = 5_000
"""Loops with no stolen time near that tell a share to half a percent."""


@dataclass
class Found:
    """What a run with some number of rigs gave."""

    rigs: int
    load: dict[str, Any]
    steps: NDArray[np.int64]
    """From a command's basis to the step at which it took effect, one a sample."""
    loop_ms: NDArray[np.float64]
    undisturbed: NDArray[np.bool_]
    """Of each sample, whether nothing was stolen near it."""
    stolen: float
    """Taken away by the host, processors."""
    ways_ms: dict[str, NDArray[np.float64]]
    """Parts of the way from a tick round to the simulation again, one value a sample each."""
    longest_hold: int
    """Steps for which one command acted at most, before a newer one replaced it."""
    lost: int
    recordings: int
    wall_s: float
    cpu_s: dict[str, float] = field(default_factory=dict)
    """Processor time of each service while the load ran."""
    resident_mib: dict[str, float] = field(default_factory=dict)
    lateness_p99_ms: float = 0.0
    overruns: int = 0


def measure(report: Report, quick: bool) -> None:
    build = build_c("scale_load.c", library="")
    counts = tuple(map(int, RIGS.split(","))) if RIGS else COUNTS
    for count in counts:
        for edges in EDGES:
            progress(f"{count} rigs, {edges} edges")
            add(report, carry(build, count, edges, 6.0 if quick else 15.0), edges)
    report.say(
        "A loop of one step is read, write and both ways over the bus between two ticks. Phases are spread evenly, so "
        "the 99th percentile is two steps wherever more than 1 % of the phases meet a tick; in ms it is two steps and "
        "the jitter of the tick."
    )


def add(report: Report, found: Found, edges: int) -> None:
    case = f"{found.rigs} rigs" if edges == 1 else f"{found.rigs} rigs, {edges} edges"
    is_judged = found.undisturbed if found.undisturbed.sum() >= ENOUGH else np.ones_like(found.undisturbed)
    judged = found.steps[is_judged]
    within = float((found.steps <= 1).mean())
    report.add(case, "loop p50", float(np.percentile(found.loop_ms, 50)), "ms")
    report.add(case, "loop p99", float(np.percentile(found.loop_ms, 99)), "ms")
    report.add(case, "within one step", 100 * within, "%")
    report.add(case, "longest hold of a command", found.longest_hold, "steps")
    if not is_judged.all():
        report.add(case, "within one step, with no stolen time near", 100 * float((judged <= 1).mean()), "%")
    report.add(case, "samples with no stolen time near", int(found.undisturbed.sum()), "count")
    report.add(case, "taken away by the host", found.stolen, "processors")
    for way, times_ms in found.ways_ms.items():
        for share in (50, 99):
            report.add(case, f"{way} p{share}", float(np.percentile(times_ms, share)), "ms")
    on_the_way_ms = sum(float(times_ms.mean()) for times_ms in found.ways_ms.values())
    report.add(case, "within one step, of evenly spread phases", max(0.0, 100 * (1 - on_the_way_ms / STEP_MS)), "%")
    report.add(case, "samples", len(found.steps), "count")
    report.add(case, "lost", found.lost, "count")
    wanted = found.rigs * found.wall_s / (STEP_MS * 1e-3)
    report.add(case, "cycles made, of those meant", 100 * found.load["cycles"] / wanted, "%")
    report.add(case, "read p50", found.load["read_us"]["p50"], "µs")
    report.add(case, "read p99", found.load["read_us"]["p99"], "µs")
    report.add(case, "tick lateness p99", found.lateness_p99_ms, "ms")
    report.add(case, "overruns", found.overruns, "count")
    for service, cpu_s in sorted(found.cpu_s.items()):
        report.add(case, f"processor, {service}", 100 * cpu_s / found.wall_s, "% of a core")
        report.add(case, f"memory, {service}", found.resident_mib[service], "MiB")
    report.add(case, "processor, load generator", 100 * found.load["cpu_s"] / found.wall_s, "% of a core")
    report.add(
        case, "processor a rig, all services", 1e3 * sum(found.cpu_s.values()) / found.wall_s / found.rigs, "mcore"
    )
    if found.rigs == PROMISED:
        report.bar(f"{case}: 99th percentile of the loop, in steps", float(np.percentile(judged, 99)), "<=", 2)
        report.bar(f"{case}: loop within one step", 100 * float((judged <= 1).mean()), ">=", 93, "%")
        report.bar(f"{case}: messages lost", found.lost, "<=", 0)
        report.bar(f"{case}: recordings of rigs", found.recordings / found.rigs, ">=", 1)


def carry(load: Path, count: int, edges: int, seconds: float) -> Found:
    """Run a lab of `count` rigs on some edges under load; what came of it."""
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        lab, config, port = write_lab(Path(folder), rigs=count, step_ms=STEP_MS)
        parts = lab_processes([rig.name for rig in lab.rigs], edges=edges)
        healths: dict[str, list[Health]] = {}

        def hear(_: str, payload: bytes) -> None:
            health = Health.FromString(payload)
            healths.setdefault(f"{health.service} {health.instance}", []).append(health)

        with (
            running_lab(lab, config, lambda line: print(line, file=sys.stderr), threading.Event(), parts),
            ZenohBus(lab.bus, "tool") as bus,
            StolenTime() as stolen,
        ):
            bus.subscribe(HEALTH.key(lab.name, "*", "*"), hear)
            wall_ns = SYSTEM_CLOCK.wall_ns()
            command = [str(load), "127.0.0.1", str(port), str(count), str(seconds + SETTLE_S), str(STEP_MS)]
            output = subprocess.run(command, check=True, stdout=subprocess.PIPE, timeout=seconds + 60).stdout
        figures = json.loads(output)
        begin_ns, end_ns = wall_ns + round(SETTLE_S * 1e9), wall_ns + round((SETTLE_S + figures["seconds"]) * 1e9)
        found = in_recordings(Path(folder), count, figures, begin_ns, stolen)
    for service, reports in healths.items():
        # A service that got no time to report in is seen by its first and last word.
        steady = [health for health in reports if begin_ns <= health.wall_ns <= end_ns] or reports
        first, last = steady[0], steady[-1]
        share = (last.cpu_ns - first.cpu_ns) / max(1, last.wall_ns - first.wall_ns)
        found.cpu_s[service] = share * found.wall_s
        found.resident_mib[service] = last.resident_bytes / 2**20
        if service.startswith("sim"):
            found.lateness_p99_ms = max(health.lateness_p99_ns for health in steady) / 1e6
            found.overruns = last.overruns - first.overruns
    return found


def in_recordings(folder: Path, count: int, figures: dict[str, Any], begin_ns: int, stolen: StolenTime) -> Found:
    steps, loops, undisturbed, lost, recordings, longest_hold = [], [], [], 0, set(), 0
    ways: dict[str, list[NDArray[np.float64]]] = {}
    for path in folder.rglob("*.mcap"):
        run = open_run(path)
        one = latency_of(run)
        recordings.add(one.rig)
        table = one.table[one.table["wall_ns"] >= begin_ns]
        steps.append(table["step"].astype(np.int64) - table["basis_step"].astype(np.int64))
        loops.append(table["loop"] / 1e6)
        longest_hold = max(longest_hold, int(np.diff(table["step"].astype(np.int64)).max(initial=0)))
        undisturbed.append(stolen.undisturbed(table["wall_ns"]))
        lost += one.lost.transport + one.lost.recorder
        for way, times_ms in ways_of(run, begin_ns).items():
            ways.setdefault(way, []).append(times_ms)
    return Found(
        rigs=count,
        load=figures,
        steps=np.concatenate(steps),
        loop_ms=np.concatenate(loops),
        undisturbed=np.concatenate(undisturbed),
        stolen=stolen.share,
        ways_ms={way: np.concatenate(parts) for way, parts in ways.items()},
        longest_hold=longest_hold,
        lost=lost,
        recordings=len(recordings),
        wall_s=figures["seconds"],
    )


def ways_of(run: Run, begin_ns: int) -> dict[str, NDArray[np.float64]]:
    """The parts of the way from a tick round to the simulation again, ms, one value a sample of the steady state."""
    states, commands = run.states, run.commands
    rows, is_there = join_commands(states, commands)
    new = is_there & (states["command_arrived_ns"] > 0) & (states["wall_ns"] >= begin_ns)
    applied, command = states[new], commands[rows[new]]
    ticks = np.searchsorted(states["step"], command["basis_step"])
    known = (command["basis_step"] > 0) & (ticks < len(states))
    applied, command, basis = applied[known], command[known], states[ticks[known]]
    # Of many rigs, what has time until the tick waits for others at the edge: that is no part of the way.
    is_near = applied["sampled_ns"] - command["sent_ns"] < DEADLINE_MARGIN_NS
    if not is_near.any():
        # One rig, whose controller never comes near the tick: nothing waited.
        is_near[:] = True
    return {
        "state way": (command["state_arrived_ns"] - basis["sampled_ns"]) / 1e6,
        "read to write": (command["sent_ns"] - command["state_served_ns"]) / 1e6,
        "command way": (applied["command_arrived_ns"] - command["sent_ns"])[is_near] / 1e6,
    }


if __name__ == "__main__":
    sys.exit(harness.run(measure, QUESTION))
