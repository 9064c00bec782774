"""Measures the throughput and the CPU time of the recorder, compared with the standard MCAP writer.

A sender process publishes the recording stream of a lab (500 rigs at 50 Hz by default) over zenoh; the recorder, as
`hilrig recorder` runs it, writes one file per rig. Its CPU time comes from its health reports. In the same run, the
standard `mcap` writer writes the same messages in this process: without bus and sessions, into one file, while a sender
runs, so that both are measured under the same load of the machine.
"""

import json
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from harness import Report, progress, run
from mcap.reader import make_reader
from mcap.writer import Writer

from hilrig_cli.local.local_lab import free_ports
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_runtime.timing.rate import Rate
from hilrig_runtime.timing.realtime import REALTIME_PRIORITIES, go_realtime
from hilrig_schemas import Event, Health, JointState, OpenSession
from hilrig_schemas.topics import HEALTH, STATE, alive_key

HZ = 50.0
"""States per second of each rig."""
MIN_GROWTH_RUN_S = 60
"""Shortest run whose memory growth is checked: its first fifth is the warm-up.

CPU steal fills the ingest queue for a moment, so the median memory of a fifth of the run is used.
"""
DISTINCT_STATES = 200
"""Number of distinct states of a rig before they repeat."""


def main() -> int:
    if len(sys.argv) > 1 and sys.argv[1] == "--send":
        send(load_lab(Path(sys.argv[2])), float(sys.argv[3]), without_recorder="--without-recorder" in sys.argv)
        return 0
    return run(
        measure, "How many messages does the recorder store without loss, and how much CPU time does a message need?"
    )


def measure(report: Report, quick: bool) -> None:
    seconds = float(os.environ.get("HILRIG_BENCH_SECONDS", "10" if quick else "60"))
    rigs = int(os.environ.get("HILRIG_BENCH_RIGS", "500"))
    raw_runs = 2 if quick else 5
    raw = standard_writer_with_sender(rigs, raw_runs)
    progress(f"{rigs} rigs at {HZ:g} Hz for {seconds:g} s")
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        found = record(Path(folder), rigs, seconds)
    # Measured before and after the recorder: the speed of a shared machine varies over time.
    raw += standard_writer_with_sender(rigs, raw_runs)
    raw_rate = report.add(
        "standard MCAP writer", "messages per CPU second", statistics.median(rate for rate, _ in raw), "1/s"
    )
    report.add("standard MCAP writer", "size per message on disk", raw[0][1], "bytes")
    case = f"recorder, {rigs} rigs at {HZ:g} Hz for {seconds:g} s"
    rate = report.add(case, "sent", found.sent / found.wall_s, "messages/s")
    per_core = report.add(case, "messages per CPU second, bus included", found.sent / found.cpu_s, "1/s")
    report.add(case, "CPU load", 100 * found.cpu_s / found.wall_s, "% of a core")
    report.add(case, "size per message on disk, everything included", found.size / found.recorded, "bytes")
    report.add(case, "reported lost in transport", found.lost_transport, "messages")
    report.add(case, "reported lost in the recorder", found.lost_recorder, "messages")
    report.add(case, "memory, second fifth of the run", found.memory_early / 2**20, "MiB")
    report.add(case, "memory, last fifth of the run", found.memory_late / 2**20, "MiB")
    report.add(case, "memory, maximum", found.memory_max / 2**20, "MiB")
    report.require(
        "messages per CPU second, recorder with bus, ratio to the standard writer", per_core / raw_rate, ">=", 0.6
    )
    report.require("messages missing in the files", found.sent - found.recorded, "<=", 0)
    report.require("messages sent, relative to the planned number", rate / (rigs * HZ), ">=", 0.98)
    if seconds >= MIN_GROWTH_RUN_S:
        growth = found.memory_late - found.memory_early
        # From the middle of the second fifth to the middle of the last.
        report.add(case, "memory growth, extrapolated", growth / 2**20 * 3600 / (0.6 * seconds), "MiB/h")
        report.require(
            "memory growth, from the second to the last fifth", 100 * growth / found.memory_early, "<=", 10, "%"
        )
    report.add_note(f"HILRIG_BENCH_SECONDS and HILRIG_BENCH_RIGS change the load; this run sent {found.sent} messages.")


# -- the sender, a separate process ---------------------------------------------------------------------------------


def states(rig: str, number: int) -> list[bytes]:
    """Return encoded states of a moving arm."""
    encoded_states = []
    for step in range(1, DISTINCT_STATES + 1):
        t = 0.02 * step + number
        state = JointState(
            rig=rig,
            session=f"20260101T000000Z-{rig}-abcd",
            incarnation=1_790_000_000_000_000_000,
            step=step,
            sampled_ns=12_345_678_901_234 + 20_000_000 * step,
            wall_ns=1_790_000_000_000_000_000 + 20_000_000 * step,
            lateness_ns=70_000 + 13 * step,
            command_seq=step,
            basis_step=step - 1,
            command_arrived_ns=12_345_678_901_234 + 20_000_000 * step - 4_000_000,
            loop_latency_ns=20_000_000,
        )
        state.position.extend(math.sin(t + joint) for joint in range(4))
        state.velocity.extend(math.cos(t + joint) for joint in range(4))
        state.effort.extend(0.1 * math.sin(3 * t + joint) for joint in range(4))
        state.integration_error.extend([1e-9] * 4)
        encoded_states.append(state.SerializeToString())
    return encoded_states


def send(lab: LabConfig, seconds: float, *, without_recorder: bool) -> None:
    """Publish the states of all rigs of a lab, one session per rig, and print the number of messages."""
    # The priority of the simulation that this process replaces.
    go_realtime(REALTIME_PRIORITIES["sim"])
    rigs = [rig.name for rig in lab.rigs]
    pool = [(STATE.key(lab.name, rig), states(rig, number)) for number, rig in enumerate(rigs)]
    stopping = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    with Service("sim", lab, ZenohBus(lab.bus, "sim")) as service:
        service.ready()
        if without_recorder:
            print("sending", flush=True)
        else:
            wait_for(service, lab)
        sessions = [OpenSession(rig=rig, session=f"20260101T000000Z-{rig}-abcd") for rig in rigs]
        service.recording_stream.set_sessions(sessions)
        emit(service, sessions, Event.SESSION_START)
        rate = Rate(round(1e9 / HZ))
        append, wall_ns = service.recording_stream.append, SYSTEM_CLOCK.wall_ns
        ticks = round(seconds * HZ)
        begin_ns = SYSTEM_CLOCK.monotonic_ns()
        for tick in range(1, ticks + 1):
            rate.wait()
            stamp = wall_ns()
            variant = tick % DISTINCT_STATES
            for key, encoded in pool:
                append(key, tick, stamp, encoded[variant])
            service.recording_stream.flush(SYSTEM_CLOCK.monotonic_ns())
            service.health.report_if_due(SYSTEM_CLOCK.monotonic_ns())
            if stopping.is_set():
                ticks = tick
                break
        emit(service, sessions, Event.SESSION_END)
        service.recording_stream.set_sessions([])
        wall_s = (SYSTEM_CLOCK.monotonic_ns() - begin_ns) * 1e-9
        print(json.dumps({"sent": ticks * len(rigs), "wall_s": wall_s}), flush=True)
        # The publisher cache is in this process: keep it available for the recorder's queries.
        for _ in range(100):
            rate.wait()
            service.recording_stream.flush_if_due(SYSTEM_CLOCK.monotonic_ns())


def wait_for(service: Service, lab: LabConfig) -> None:
    """Block until a recorder is alive."""
    while not service.bus.get_liveliness(alive_key(lab.name, "recorder", "*"), timeout_s=0.2):
        time.sleep(0.05)


def emit(service: Service, sessions: list[OpenSession], kind: Event.Kind) -> None:
    """Emit an event of each session."""
    for session in sessions:
        service.emit(Event(rig=session.rig, session=session.session, kind=kind))
    service.recording_stream.flush(SYSTEM_CLOCK.monotonic_ns())


# -- the measurement ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RecorderRun:
    """Results of one run of the recorder."""

    sent: int
    recorded: int
    lost_transport: int
    lost_recorder: int
    size: int
    wall_s: float
    cpu_s: float
    memory_early: float
    memory_late: float
    memory_max: int


def standard_writer_with_sender(rigs: int, runs: int) -> list[tuple[float, float]]:
    """Measure the standard writer several times while a sender loads the machine as it does for the recorder."""
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        config = write_lab(Path(folder), rigs)
        command = [sys.executable, __file__, "--send", str(config), "600", "--without-recorder"]
        sender = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert sender.stdout is not None
        try:
            sender.stdout.readline()
            return [standard_writer() for _ in range(runs)]
        finally:
            sender.terminate()
            sender.wait(15)
            sender.stdout.close()


def standard_writer() -> tuple[float, float]:
    """Return messages per CPU second and bytes per message of the standard writer, with the recorder's chunk size."""
    pool = [states(f"rig{number}", number) for number in range(5)]
    payloads = [payload for step in zip(*pool, strict=True) for payload in step] * 60
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        path = Path(folder) / "raw.mcap"
        begin = time.process_time()
        with path.open("wb") as stream:
            writer = Writer(stream, chunk_size=64 * 1024)
            writer.start()
            schema = writer.register_schema("hilrig.v1.JointState", "protobuf", b"")
            channel = writer.register_channel("/state", "protobuf", schema)
            for number, payload in enumerate(payloads):
                stamp = 1_790_000_000_000_000_000 + number
                writer.add_message(channel, stamp, payload, stamp, number)
            writer.finish()
        spent = time.process_time() - begin
        return len(payloads) / spent, path.stat().st_size / len(payloads)


def record(folder: Path, rigs: int, seconds: float) -> RecorderRun:
    """Record a lab and return the recorder's resources and the content of its files."""
    config = write_lab(folder, rigs)
    lab = load_lab(config)
    healths: list[Health] = []
    command = [sys.executable, "-m", "hilrig_cli", "recorder", "-c", str(config)]
    recorder = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    command = [sys.executable, __file__, "--send", str(config), str(seconds)]
    sender = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert sender.stdout is not None
    try:
        with ZenohBus(lab.bus, "tool") as bus:
            bus.subscribe(
                HEALTH.key(lab.name, "recorder", "*"), lambda _, payload: healths.append(Health.FromString(payload))
            )
            sender_result = json.loads(sender.stdout.readline())
            paths = finished_files(lab, recorder, rigs)
            sender.wait(30)
    finally:
        for process in (sender, recorder):
            process.terminate()
        for process in (sender, recorder):
            process.wait(15)
        sender.stdout.close()
    busy = [health for health in healths if health.recordings]
    memory = [health.resident_bytes for health in busy]
    idle = healths[: healths.index(busy[0])]
    recorded, lost_transport, lost_recorder = contents(paths)
    return RecorderRun(
        sent=sender_result["sent"],
        recorded=recorded,
        lost_transport=lost_transport,
        lost_recorder=lost_recorder,
        size=sum(path.stat().st_size for path in paths),
        wall_s=sender_result["wall_s"],
        # The CPU time before the first session (imports, start) is not counted.
        cpu_s=(healths[-1].cpu_ns - (idle[-1].cpu_ns if idle else 0)) * 1e-9,
        memory_early=statistics.median(memory[len(busy) // 5 : 2 * len(busy) // 5 + 1]),
        memory_late=statistics.median(memory[-(len(busy) // 5 + 1) :]),
        memory_max=max(memory),
    )


def write_lab(folder: Path, rigs: int) -> Path:
    """Write a lab.toml with free bus ports."""
    config = folder / "lab.toml"
    names = "".join(f'[[rigs]]\nname = "rig{number}"\n' for number in range(rigs))
    config.write_text(
        f"[bus]\nfirst_port = {free_ports(7447, 3)}\n[recorder]\nfolder = '{folder / 'recordings'}'\n{names}"
    )
    return config


def finished_files(lab: LabConfig, recorder: subprocess.Popen[bytes], rigs: int) -> list[Path]:
    """Wait until each rig has a complete recording and return the paths."""
    deadline = time.monotonic() + 60
    while True:
        paths = list((lab.recorder.folder / lab.name).glob("*/*.mcap"))
        if len(paths) >= rigs:
            return paths
        if recorder.poll() is not None or time.monotonic() > deadline:
            raise SystemExit(f"only {len(paths)} of {rigs} recordings were completed")
        time.sleep(0.1)


def contents(paths: list[Path]) -> tuple[int, int, int]:
    """Return the number of states in the files, and of messages reported lost in transport and in the recorder."""
    found = lost_transport = lost_recorder = 0
    for path in paths:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise SystemExit(f"{path}: no summary section")
            states_id = next(channel.id for channel in summary.channels.values() if channel.topic == "/state")
            found += summary.statistics.channel_message_counts.get(states_id, 0)
            for record in reader.iter_metadata():
                if record.name == "hilrig.summary":
                    lost_transport += int(record.metadata["lost_transport"])
                    lost_recorder += int(record.metadata["lost_recorder"])
    return found, lost_transport, lost_recorder


if __name__ == "__main__":
    sys.exit(main())
