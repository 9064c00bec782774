"""Timing measurement of this host: runs a lab with a fast controller and measures its recording.

Simulation, edge and recorder run as with `hilrig up`. The controller polls over Modbus TCP and times its own requests;
the recording gives the times of ticks, bus and loop.
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

from hilrig_cli.bench.cpu_stress import cpu_stress
from hilrig_cli.bench.timing_benchmark import TimingResult
from hilrig_cli.local.local_lab import free_ports, running_lab
from hilrig_modbus_edge.protocol.functions import FunctionCode
from hilrig_modbus_edge.protocol.mbap import encode_frame
from hilrig_modbus_edge.registers.map import POSITION_ADDRESS, TORQUE_ADDRESS
from hilrig_recorder.mcap_format.file_names import MCAP_PATTERN
from hilrig_replay.analysis.data_quality import tick_lateness_ns
from hilrig_replay.analysis.distribution import Statistics
from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.stages import TRANSPORT
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import open_run
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.errors import OperationError
from hilrig_runtime.timing.rate import Rate
from hilrig_runtime.timing.realtime import set_short_slice

LAB_TEMPLATE: Final = """[sim]
step_ms = {step_ms}
[edge]
first_port = {modbus_port}
session_grace_ms = 0
[bus]
first_port = {bus_port}
[recorder]
folder = '{folder}'
"""
MIN_POLL_PERIOD_NS: Final = 1_000_000
POLLS_PER_STEP: Final = 4
RESPONSE_TIMEOUT_S: Final = 5.0
READ_REQUEST: Final = encode_frame(1, 1, struct.pack(">BHH", FunctionCode.READ_HOLDING_REGISTERS, POSITION_ADDRESS, 4))
"""Modbus request that reads the four positions."""
WRITE_REQUEST: Final = encode_frame(
    2, 1, struct.pack(">BHHB8x", FunctionCode.WRITE_MULTIPLE_REGISTERS, TORQUE_ADDRESS, 4, 8)
)
"""Modbus request that writes four torques of zero."""
READ_RESPONSE_BYTES: Final = 17
WRITE_RESPONSE_BYTES: Final = 12


def measure_timing(
    step_ms: float, seconds: float, loaded: bool, log: Callable[[str], None], on_progress: Callable[[float], None]
) -> TimingResult:
    """Run a lab for `seconds` and measure its timing.

    Args:
        step_ms: step of the simulation.
        seconds: duration of the measurement.
        loaded: whether CPU stress keeps every processor busy meanwhile.
        log: receives messages of the lab, one line each.
        on_progress: receives the elapsed share of the duration.

    Raises:
        HilrigError: the lab could not start, or it stopped responding.
    """
    set_short_slice()
    with tempfile.TemporaryDirectory(prefix="hilrig-jitter-") as folder:
        config = Path(folder) / "lab.toml"
        default = LabConfig()
        ports = {"modbus_port": free_ports(default.edge.first_port), "bus_port": free_ports(default.bus.first_port, 3)}
        config.write_text(LAB_TEMPLATE.format(step_ms=step_ms, folder=folder, **ports))
        lab = load_lab(config)
        processors = os.cpu_count() or 1
        with (
            running_lab(lab, config, log, threading.Event()) as supervisor,
            cpu_stress(processors) if loaded else nullcontext(),
        ):
            before_s, start_s = steal_time_s(), time.monotonic()
            round_trips_ns = _poll(lab, seconds, supervisor.poll, on_progress)
            elapsed_s, after_s = time.monotonic() - start_s, steal_time_s()
        stolen = None if before_s is None or after_s is None else (after_s - before_s) / (elapsed_s * processors)
        recordings = list(Path(folder).rglob(MCAP_PATTERN))
        if len(recordings) != 1:
            raise OperationError("the session was not recorded: the lab stopped too early")
        return _evaluate(recordings[0], seconds, loaded, round_trips_ns, stolen)


def _evaluate(
    recording: Path, seconds: float, loaded: bool, round_trips_ns: NDArray[np.int64], stolen: float | None
) -> TimingResult:
    run = open_run(recording)
    ticks = overruns = missed = 0

    def count(block: Records) -> None:
        nonlocal ticks, overruns, missed
        ticks += len(block.states)
        overruns += int((tick_lateness_ns(block.states, run.step_ns) > run.step_ns).sum())
        missed += int(block.states["missed_steps"].sum())

    report = measure(run, count)
    if report.loop_ms is None:
        raise OperationError("no command of the controller took effect: the simulation or the edge was blocked")
    return TimingResult(
        loaded=loaded,
        step_ms=report.step_ms,
        seconds=seconds,
        ticks=ticks,
        overruns=overruns,
        missed_steps=missed,
        tick_lateness_ms=report.jitter_ms.tick_lateness,
        bus_ms=report.stages_ms[TRANSPORT.key],
        modbus_ms=Statistics.of(round_trips_ns),
        loop_ms=report.loop_ms,
        stolen=stolen,
    )


def _poll(
    lab: LabConfig, seconds: float, poll: Callable[[], None], on_progress: Callable[[float], None]
) -> NDArray[np.int64]:
    """Read and write `POLLS_PER_STEP` times a step; return the round trip times, ns, shape (requests,)."""
    round_trips_ns: list[int] = []
    rate = Rate(max(MIN_POLL_PERIOD_NS, lab.sim.step_ns // POLLS_PER_STEP))
    start_ns = time.monotonic_ns()
    reported_s = 0.0
    try:
        with socket.create_connection((lab.edge.host, lab.ports[lab.rigs[0].name]), RESPONSE_TIMEOUT_S) as connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while (elapsed_s := (time.monotonic_ns() - start_ns) * 1e-9) < seconds:
                rate.wait()
                round_trips_ns.append(_request(connection, READ_REQUEST, READ_RESPONSE_BYTES))
                round_trips_ns.append(_request(connection, WRITE_REQUEST, WRITE_RESPONSE_BYTES))
                if elapsed_s - reported_s > 0.5:
                    # Between two cycles, so that no cycle is delayed by it.
                    reported_s = elapsed_s
                    poll()
                    on_progress(elapsed_s / seconds)
    except OSError as error:
        raise OperationError(f"the edge stopped responding: {error}") from error
    return np.array(round_trips_ns, np.int64)


def _request(connection: socket.socket, request: bytes, response_bytes: int) -> int:
    """Send a request and receive its response; return the round trip time, ns."""
    start_ns = time.monotonic_ns()
    connection.sendall(request)
    response = b""
    while len(response) < response_bytes:
        received = connection.recv(response_bytes - len(response))
        if not received:
            raise ConnectionError("it closed the connection")
        response += received
    round_trip_ns = time.monotonic_ns() - start_ns
    if response[7] & 0x80:
        raise ConnectionError(f"exception {response[8]:02d}")
    return round_trip_ns


def steal_time_s() -> float | None:
    """CPU steal time of this virtual machine since its start, s (`steal` of /proc/stat); None: not reported."""
    stat = Path("/proc/stat")
    if not stat.exists():
        return None
    return int(stat.read_text().split(maxsplit=9)[8]) / os.sysconf("SC_CLK_TCK")
