"""Measuring how well this machine keeps time: the rig itself, run for a while with a quick controller.

Nothing is imitated: simulation, edge and recorder run as `hilrig up` runs them, a controller polls over real Modbus
TCP, and the recording says what ticks, bus and loop took. The controller times its requests itself.
"""

import os
import socket
import struct
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_cli.bench.cpu_stress import busy_processors
from hilrig_cli.bench.timing_benchmark import Timekeeping
from hilrig_cli.local.demo import free_ports
from hilrig_cli.local.local_lab import running_lab
from hilrig_replay.analysis.data_quality import tick_lateness_ns
from hilrig_replay.analysis.distribution import Statistics
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import open_run
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.errors import OperationError
from hilrig_runtime.timing.rate import Rate
from hilrig_runtime.timing.realtime import prefer_latency

LAB: Final = """[sim]
step_ms = {step_ms}
[edge]
first_port = {modbus_port}
session_grace_ms = 0
[bus]
first_port = {bus_port}
[recorder]
folder = '{folder}'
"""
SHORTEST_POLL_NS: Final = 1_000_000
POLLS_A_STEP: Final = 4
ANSWER_WITHIN_S: Final = 5.0
READ: Final = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
"""The four positions."""
WRITE: Final = struct.pack(">HHHBBHHB8x", 2, 0, 15, 1, 16, 0, 4, 8)
"""Four torques of zero."""
READ_ANSWER, WRITE_ANSWER = 17, 12
"""How long the answers are, bytes."""


def measure_timekeeping(
    step_ms: float, seconds: float, loaded: bool, say: Callable[[str], None], tick: Callable[[float], None]
) -> Timekeeping:
    """Run a lab at a step for so long, with every processor kept busy if `loaded`; `tick` hears the share that passed.

    Raises:
        HilrigError: the lab could not start, or it stopped answering.
    """
    prefer_latency()
    with tempfile.TemporaryDirectory(prefix="hilrig-jitter-") as folder:
        config = Path(folder) / "lab.toml"
        ports = {"modbus_port": free_ports(5020), "bus_port": free_ports(7447, 3)}
        config.write_text(LAB.format(step_ms=step_ms, folder=folder, **ports))
        lab = load_lab(config)
        processors = os.cpu_count() or 1
        with (
            running_lab(lab, config, say, threading.Event()) as supervisor,
            busy_processors(processors) if loaded else nullcontext(),
        ):
            before_s, begin_s = stolen_s(), time.monotonic()
            round_trips_ns = _poll(lab, seconds, supervisor.poll, tick)
            passed_s, after_s = time.monotonic() - begin_s, stolen_s()
        stolen = None if before_s is None or after_s is None else (after_s - before_s) / (passed_s * processors)
        recordings = list(Path(folder).rglob("*.mcap"))
        if len(recordings) != 1:
            raise OperationError("the session was not recorded: the lab stopped too early")
        return _judge(recordings[0], seconds, loaded, round_trips_ns, stolen)


def _judge(
    recording: Path, seconds: float, loaded: bool, round_trips_ns: NDArray[np.int64], stolen: float | None
) -> Timekeeping:
    run = open_run(recording)
    ticks = overruns = missed = 0

    def count(block: Records) -> None:
        nonlocal ticks, overruns, missed
        ticks += len(block.states)
        overruns += int((tick_lateness_ns(block.states, run.step_ns) > run.step_ns).sum())
        missed += int(block.states["missed_steps"].sum())

    report = measure(run, count)
    if report.loop_ms is None:
        raise OperationError("no command of the controller took effect: the simulation or the edge stood still")
    return Timekeeping(
        loaded=loaded,
        step_ms=report.step_ms,
        seconds=seconds,
        ticks=ticks,
        overruns=overruns,
        missed_steps=missed,
        tick_lateness_ms=report.jitter_ms.tick_lateness,
        bus_ms=report.stages_ms["transport"],
        modbus_ms=Statistics.of(round_trips_ns),
        loop_ms=report.loop_ms,
        stolen=stolen,
    )


def _poll(lab: LabConfig, seconds: float, poll: Callable[[], None], tick: Callable[[float], None]) -> NDArray[np.int64]:
    """Read and write, some cycles a step; how long each request took, ns, shape (requests,)."""
    took_ns: list[int] = []
    rate = Rate(max(SHORTEST_POLL_NS, lab.sim.step_ns // POLLS_A_STEP))
    begin_ns = time.monotonic_ns()
    told_s = 0.0
    try:
        with socket.create_connection((lab.edge.host, lab.ports[lab.rigs[0].name]), ANSWER_WITHIN_S) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while (passed_s := (time.monotonic_ns() - begin_ns) * 1e-9) < seconds:
                rate.wait()
                took_ns.append(_ask(link, READ, READ_ANSWER))
                took_ns.append(_ask(link, WRITE, WRITE_ANSWER))
                if passed_s - told_s > 0.5:
                    # Between two cycles, not within one.
                    told_s = passed_s
                    poll()
                    tick(passed_s / seconds)
    except OSError as error:
        raise OperationError(f"the edge stopped answering: {error}") from error
    return np.array(took_ns, np.int64)


def _ask(link: socket.socket, request: bytes, length: int) -> int:
    begin_ns = time.monotonic_ns()
    link.sendall(request)
    answer = b""
    while len(answer) < length:
        part = link.recv(length - len(answer))
        if not part:
            raise ConnectionError("it closed the connection")
        answer += part
    took_ns = time.monotonic_ns() - begin_ns
    if answer[7] & 0x80:
        raise ConnectionError(f"exception {answer[8]:02d}")
    return took_ns


def stolen_s() -> float | None:
    """Processor time that the host has taken from this virtual machine since its start, s; None: it is not told."""
    stat = Path("/proc/stat")
    if not stat.exists():
        return None
    return int(stat.read_text().split(maxsplit=9)[8]) / os.sysconf("SC_CLK_TCK")
