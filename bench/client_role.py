"""Measures the client role: rigs whose controllers are Modbus servers, which the edge polls.

Five questions. How many such rigs does one machine run: 16 and 64 rigs at a step of 20 ms against servers in C on
libmodbus, whose programs run every 10 ms. Which latency has one such rig beside one in the server role, in one lab.
Which latency do the paper's devices have: programs with scan times of 5 to 80 ms over networks of 0 to 20 ms; the basis
of each command is compared with the positions that the device's program used. Without an echo register: does the truth
lie within the stated bound and range, also of a program that writes its outputs at the end of a scan. And what do fewer
requests in a cycle save.
"""

import math
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Final

import harness
import numpy as np
from harness import Report, build_c, cpu_seconds, progress, rigs_text
from numpy.typing import NDArray
from steal import StealMonitor

from hilrig_cli.local.local_lab import free_ports, running_lab
from hilrig_replay.analysis.latency import LatencyReport
from hilrig_replay.analysis.latency import measure as latency_of
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.run import open_run
from hilrig_runtime.config.lab import load_lab

sys.path.insert(0, str(harness.HERE.parent / "tests"))
from support.plc import Plc

QUESTION = "How many controllers that are Modbus servers does one machine poll, and with which latency?"
COUNTS = (16, 64)
REQUIRED_RIGS, REQUIRED_SHARE = 16, 90.0
"""Rigs of which this share, %, of the samples closes within two steps."""
STEP_MS = 20.0
SCANS_MS = (5.0, 20.0, 50.0, 80.0)
NETWORKS_MS = (0.0, 5.0, 20.0)
"""One-way delays of the network."""
SETTLE_S = 1.5


def measure(report: Report, quick: bool) -> None:
    """Measure scale, both roles, and the devices of the paper."""
    server = build_c("../examples/server_controller.c")
    seconds = 6.0 if quick else 15.0
    for count in (2,) if quick else COUNTS:
        progress(f"{rigs_text(count)} against servers in C")
        add_scale(report, server, count, seconds)
    progress("both roles")
    add_both_roles(report, server, seconds)
    progress("requests of a cycle")
    add_requests(report, seconds)
    errors = Errors()
    for network_ms in NETWORKS_MS[:1] if quick else NETWORKS_MS:
        progress(f"devices over a network of {network_ms:g} ms")
        add_devices(report, errors, network_ms, seconds)
    require_small(report, errors)


@dataclass(frozen=True, slots=True)
class LabRun:
    """Results of one lab: one entry a rig."""

    latency: list[LatencyReport]
    commands: list[Rows]
    edge_cpus: float
    """CPU load of the edge."""
    steal: float
    """CPU steal, CPUs."""


ECHO: Final = "registers.echo = 9\n"


def run_lab(
    controllers: Sequence[str], seconds: float, *, settings: Sequence[str] = (), client: Path | None = None
) -> LabRun:
    """Run a lab with a rig for each address of a controller; empty: a rig in the server role, polled by `client`.

    `settings`: lines of lab.toml for each rig; the default is an echo register.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config, port = folder / "lab.toml", free_ports(20_000, len(controllers))
        text = f"[edge]\nfirst_port = {port}\nsession_grace_ms = 0\nmax_connections = 4\n"
        text += f"[bus]\nfirst_port = {free_ports(7447, 8)}\n[recorder]\nfolder = '{folder}'\n"
        for number, (controller, lines) in enumerate(zip_longest(controllers, settings, fillvalue=ECHO), 1):
            text += f'[[rigs]]\nname = "rig{number:03d}"\n'
            text += f'controller = "{controller}"\n{lines}' if controller else ""
        config.write_text(text)
        with running_lab(load_lab(config), config, log, threading.Event()) as supervisor, StealMonitor() as steal:
            time.sleep(SETTLE_S)
            edge = supervisor.pids["edge"]
            before_s = cpu_seconds(edge)
            if client is not None:
                served = port + list(controllers).index("")
                subprocess.run([client, "127.0.0.1", str(served), str(seconds)], check=True, stdout=subprocess.DEVNULL)
            else:
                time.sleep(seconds)
            edge_cpus = (cpu_seconds(edge) - before_s) / seconds
        runs = [open_run(path) for path in sorted(folder.rglob("*.mcap"), key=lambda path: path.parent.name)]
        commands = [run.commands[run.commands["read_sent_ns"] > 0] for run in runs]
        return LabRun([latency_of(run) for run in runs], commands, edge_cpus, steal.mean_cpus)


@contextmanager
def servers(program: Path, count: int) -> Iterator[list[str]]:
    """Run programs in C that are Modbus servers; yields their addresses."""
    first = free_ports(24_000, count)
    ports = range(first, first + count)
    running = [subprocess.Popen([program, "127.0.0.1", str(port), "600"], stdout=subprocess.DEVNULL) for port in ports]
    try:
        yield [f"127.0.0.1:{port}" for port in ports]
    finally:
        for process in running:
            process.kill()
            process.wait()


def add_scale(report: Report, program: Path, count: int, seconds: float) -> None:
    """Add the latency of a number of rigs."""
    with servers(program, count) as addresses:
        found = run_lab(addresses, seconds)
    loop_ms = np.concatenate([np.asarray(one.table["loop"]) for one in found.latency]) / 1e6
    case = f"client role, {rigs_text(count)}"
    within = 100 * float((loop_ms <= 2.5 * STEP_MS).mean())
    report.add(case, "recordings", len(found.latency), "count")
    report.add(case, "samples", len(loop_ms), "count")
    add_loop(report, case, loop_ms)
    report.add(case, "within one step", 100 * float((loop_ms <= 1.5 * STEP_MS).mean()), "%")
    report.add(case, "within two steps", within, "%")
    report.add(case, "samples, relative to one a step", 100 * len(loop_ms) * STEP_MS / (1e3 * seconds * count), "%")
    lost = sum(one.lost.total for one in found.latency)
    report.add(case, "lost", lost, "count")
    report.add(case, "CPU load, edge", 100 * found.edge_cpus, "% of a core")
    report.add(case, "CPU steal", found.steal, "CPUs")
    if count == REQUIRED_RIGS:
        report.require(f"{case}: within two steps", within, ">=", REQUIRED_SHARE, "%")
        report.require(f"{case}: lost", lost, "<=", 0)


def add_both_roles(report: Report, program: Path, seconds: float) -> None:
    """Add the latencies of a rig in each role, in one lab."""
    client = build_c("../examples/hold_position.c")
    with servers(program, 1) as [address]:
        found = run_lab([address, ""], seconds, client=client)
    for role, one in zip(("client role", "server role"), found.latency, strict=True):
        add_loop(report, f"one rig, {role}", np.asarray(one.table["loop"]) / 1e6)
        for stage in one.stages:
            report.add(f"one rig, {role}", f"stage {stage.key} p50", one.stages_ms[stage.key].p50, "ms")


def add_loop(report: Report, case: str, loop_ms: NDArray[np.float64]) -> None:
    for name, quantile in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999)):
        report.add(case, f"loop {name}", float(np.quantile(loop_ms, quantile)), "ms")


def add_requests(report: Report, seconds: float) -> None:
    """Add the latencies of one, two and three requests in a cycle, over a network of 20 ms."""
    bit = f'{ECHO}registers.magnet = "holding 10.0"\n'
    cases = {
        "3 requests (magnet is a coil)": ECHO,
        "2 requests (magnet is a bit beside the echo)": bit,
        "1 request (the same, function 23)": f"{bit}client.combined_request = true\n",
    }
    with ExitStack() as stack:
        devices = [stack.enter_context(Plc(scan_s=0.005, delay_s=0.02, law=follow)) for _ in cases]
        found = run_lab([device.address for device in devices], seconds, settings=list(cases.values()))
    for case, one in zip(cases, found.latency, strict=True):
        add_loop(report, f"scan 5 ms, network 20 ms, {case}", np.asarray(one.table["loop"]) / 1e6)
        if one.control_period_ms is not None:
            report.add(f"scan 5 ms, network 20 ms, {case}", "control period", one.control_period_ms, "ms")


@dataclass
class Errors:
    """Differences from the own values of the devices, ms; a value for each device."""

    basis: list[float] = field(default_factory=list)
    scan_time: list[float] = field(default_factory=list)
    newest: list[float] = field(default_factory=list)
    mean: list[float] = field(default_factory=list)


def add_devices(report: Report, errors: Errors, network_ms: float, seconds: float) -> None:
    """Add the latency of devices with different scan times, and compare it with their own knowledge."""
    for echo, output_share in ((True, 0.0), (False, 0.0), (False, 0.9)):
        with ExitStack() as stack:
            devices = [
                stack.enter_context(
                    Plc(
                        scan_s=scan_ms / 1e3,
                        output_s=output_share * scan_ms / 1e3,
                        delay_s=network_ms / 1e3,
                        law=follow,
                    )
                )
                for scan_ms in SCANS_MS
            ]
            settings = [ECHO if echo else ""] * len(devices)
            found = run_lab([device.address for device in devices], seconds, settings=settings)
        for scan_ms, device, one, commands in zip(SCANS_MS, devices, found.latency, found.commands, strict=True):
            case = f"scan {scan_ms:g} ms, network {network_ms:g} ms" + ("" if echo else ", no echo")
            case += ", outputs at the end" if output_share else ""
            loop_ms = np.asarray(one.table["loop"]) / 1e6
            add_loop(report, case, loop_ms)
            behind = basis_errors(device, commands)
            report.add(case, "basis newer than the device's own, mean", float(behind.mean()), "ms")
            largest = float(np.quantile(np.abs(behind), 0.99))
            report.add(case, "basis newer than the device's own, p99", largest, "ms")
            if echo:
                errors.basis.append(largest)
                if one.device_scan is not None:
                    bound = "scan time, bound" if one.device_scan.is_bound else "scan time"
                    report.add(case, bound, one.device_scan.scan_ms, "ms")
                    if not one.device_scan.is_bound:
                        errors.scan_time.append(abs(one.device_scan.scan_ms - true_scan_ms(device)))
                continue
            errors.newest.append(float(behind.min()))
            if one.older_positions is not None:
                stated = one.older_positions
                report.add(case, "the same, stated from", stated.low_ms, "ms")
                report.add(case, "the same, stated to", stated.high_ms, "ms")
                mean = float(behind.mean())
                errors.mean.append(max(stated.low_ms - mean, mean - stated.high_ms, 0.0))


def require_small(report: Report, errors: Errors) -> None:
    """Compare the largest errors of all devices with their bounds."""
    cases = f"{len(errors.basis)} devices with echo"
    report.require(f"{cases}: largest p99 of the error of the basis", max(errors.basis), "<=", 1.0, "ms")
    report.require(f"{cases}: largest error of the scan time", max(errors.scan_time), "<=", 1.0, "ms")
    cases = f"{len(errors.newest)} devices without echo"
    report.require(f"{cases}: least time of the stated basis after the true one", min(errors.newest), ">=", 0.0, "ms")
    # The states are written within a millisecond of their arrival.
    report.require(f"{cases}: largest distance of the mean from the stated range", max(errors.mean), "<=", 1.0, "ms")


def follow(positions: tuple[int, ...]) -> tuple[int, ...]:
    """Torques of 0.1 N·m per degree (joint 4: 0.02) toward poses that move slowly."""
    goals = (2000 * math.sin(0.8 * time.monotonic() + joint) for joint in range(4))
    torques = (gain * (goal - q) for gain, goal, q in zip((1, 1, 1, 0.2), goals, positions, strict=True))
    return tuple(round(max(-2000, min(2000, torque))) for torque in torques)


def true_scan_ms(device: Plc) -> float:
    """Mean scan time of a device, as it knows it."""
    begins = np.array([begin for begin, _, _ in device.scans])
    return float((begins[-1] - begins[0]) / (len(begins) - 1)) / 1e6


def basis_errors(device: Plc, commands: Rows) -> NDArray[np.float64]:
    """For each command, the time by which its basis was written after the positions that the program used, ms."""
    ends = np.array([end for _, end, _ in device.scans])
    begins = np.array([begin for begin, _, _ in device.scans])
    reads = np.array([at for at, pdu in device.requests if pdu[0] == 3])
    writes = np.array([at for at, pdu in device.requests if pdu[0] == 16])
    # A request is executed between the times at which it was sent and answered.
    read = reads[np.minimum(np.searchsorted(reads, commands["read_sent_ns"]), len(reads) - 1)]
    scan = np.searchsorted(ends, read) - 1
    basis = np.searchsorted(writes, commands["state_served_ns"])
    used = np.searchsorted(writes, begins[np.maximum(scan, 0)]) - 1
    arrived_ns: NDArray[np.int64] = commands["write_arrived_ns"]
    known = (scan >= 0) & (read < arrived_ns) & (basis < len(writes)) & (used >= 0)
    errors_ms: NDArray[np.float64] = (writes[basis[known]] - writes[used[known]]) / 1e6
    return errors_ms


def log(line: str) -> None:
    print(line, file=sys.stderr)


if __name__ == "__main__":
    sys.exit(harness.run(measure, QUESTION))
