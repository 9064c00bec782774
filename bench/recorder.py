"""How much does the recorder take, and what does it cost beside the raw MCAP writer?

A sender process publishes the log stream of a whole lab (500 rigs at 50 Hz by default) over the real bus; the
recorder, as a user starts it, writes a file for each rig. Its processor time comes from its own health reports. The
same messages go through the stock `mcap` writer in this process, in the same run: no bus, no sessions, one file, and
a sender at work beside it, so that both are measured on a machine that is equally busy.
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

from hilrig_cli.local.demo import free_ports
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_runtime.timing.rate import Rate
from hilrig_runtime.timing.realtime import REALTIME_PRIORITIES, go_realtime
from hilrig_schemas import Event, Health, JointState, OpenSession
from hilrig_schemas.topics import HEALTH, STATE, alive_key

HZ = 50.0
"""States a second of each rig."""
SETTLED_SECONDS = 60
"""From this length of a run on, a fifth of it is enough for memory to settle. What waits while the host takes the
processors away is in memory for a moment: so it is the median of a fifth that counts."""
VARIANTS = 200
"""Different states a rig has; then they repeat."""


def main() -> int:
    if len(sys.argv) > 1 and sys.argv[1] == "--send":
        send(load_lab(Path(sys.argv[2])), float(sys.argv[3]), to_nobody="--to-nobody" in sys.argv)
        return 0
    return run(measure, "What does the recorder take without loss, and what does a message cost it?")


def measure(report: Report, quick: bool) -> None:
    seconds = float(os.environ.get("HILRIG_BENCH_SECONDS", "10" if quick else "60"))
    rigs = int(os.environ.get("HILRIG_BENCH_RIGS", "500"))
    raw_runs = 2 if quick else 5
    raw = raw_writer_beside_a_sender(rigs, raw_runs)
    progress(f"{rigs} rigs at {HZ:g} Hz for {seconds:g} s")
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        found = record(Path(folder), rigs, seconds)
    # Before and after: the speed of a shared machine is not the same all the time.
    raw += raw_writer_beside_a_sender(rigs, raw_runs)
    raw_rate = report.add("raw mcap writer", "messages a CPU second", statistics.median(rate for rate, _ in raw), "1/s")
    report.add("raw mcap writer", "a message on disk", raw[0][1], "bytes")
    case = f"recorder, {rigs} rigs at {HZ:g} Hz for {seconds:g} s"
    rate = report.add(case, "sent", found.sent / found.wall_s, "messages/s")
    per_core = report.add(case, "messages a CPU second, bus included", found.sent / found.cpu_s, "1/s")
    report.add(case, "processor", 100 * found.cpu_s / found.wall_s, "% of a core")
    report.add(case, "a message on disk, everything included", found.size / found.recorded, "bytes")
    report.add(case, "stated as lost in transport", found.lost_transport, "messages")
    report.add(case, "stated as lost in the recorder", found.lost_recorder, "messages")
    report.add(case, "memory, second fifth of the run", found.memory_early / 2**20, "MiB")
    report.add(case, "memory, last fifth of the run", found.memory_late / 2**20, "MiB")
    report.add(case, "memory, most", found.memory_most / 2**20, "MiB")
    report.bar("messages a CPU second, recorder with its bus over raw writer", per_core / raw_rate, ">=", 0.6)
    report.bar("messages missing in the files", found.sent - found.recorded, "<=", 0)
    report.bar("sent, of what was meant to be sent", rate / (rigs * HZ), ">=", 0.98)
    if seconds >= SETTLED_SECONDS:
        growth = found.memory_late - found.memory_early
        # From the middle of the second fifth to the middle of the last.
        report.add(case, "growth of memory, if it went on", growth / 2**20 * 3600 / (0.6 * seconds), "MiB an hour")
        report.bar("growth of memory, second to last fifth", 100 * growth / found.memory_early, "<=", 10, "%")
    report.say(f"HILRIG_BENCH_SECONDS and HILRIG_BENCH_RIGS change the run; this one sent {found.sent} messages.")


# -- the sender, a process of its own -------------------------------------------------------------------------------


def states(rig: str, number: int) -> list[bytes]:
    """Encoded states as a moving arm sends them."""
    made = []
    for step in range(1, VARIANTS + 1):
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
        made.append(state.SerializeToString())
    return made


def send(lab: LabConfig, seconds: float, *, to_nobody: bool) -> None:
    """Send the states of every rig of a lab within a session each, and say how many."""
    # As the simulations do for which it stands.
    go_realtime(REALTIME_PRIORITIES["sim"])
    rigs = [rig.name for rig in lab.rigs]
    pool = [(STATE.key(lab.name, rig), states(rig, number)) for number, rig in enumerate(rigs)]
    stopping = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    with Service("sim", lab, ZenohBus(lab.bus, "sim")) as service:
        service.ready()
        if to_nobody:
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
            variant = tick % VARIANTS
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
        # The cache is here: what the recorder still asks for must be answered.
        for _ in range(100):
            rate.wait()
            service.recording_stream.flush_if_due(SYSTEM_CLOCK.monotonic_ns())


def wait_for(service: Service, lab: LabConfig) -> None:
    while not service.bus.get_liveliness(alive_key(lab.name, "recorder", "*"), timeout_s=0.2):
        time.sleep(0.05)


def emit(service: Service, sessions: list[OpenSession], kind: Event.Kind) -> None:
    for session in sessions:
        service.emit(Event(rig=session.rig, session=session.session, kind=kind))
    service.recording_stream.flush(SYSTEM_CLOCK.monotonic_ns())


# -- the measurement ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Found:
    """What a run of the recorder gave."""

    sent: int
    recorded: int
    lost_transport: int
    lost_recorder: int
    size: int
    wall_s: float
    cpu_s: float
    memory_early: float
    memory_late: float
    memory_most: int


def raw_writer_beside_a_sender(rigs: int, runs: int) -> list[tuple[float, float]]:
    """The raw writer, measured while a sender keeps the machine as busy as it is while the recorder is measured."""
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        config = write_lab(Path(folder), rigs)
        command = [sys.executable, __file__, "--send", str(config), "600", "--to-nobody"]
        sender = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert sender.stdout is not None
        try:
            sender.stdout.readline()
            return [raw_writer() for _ in range(runs)]
        finally:
            sender.terminate()
            sender.wait(15)
            sender.stdout.close()


def raw_writer() -> tuple[float, float]:
    """Messages a CPU second and bytes a message of the stock writer, with the recorder's chunks and compression."""
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


def record(folder: Path, rigs: int, seconds: float) -> Found:
    """Let the recorder record a lab; what it cost and what is in its files."""
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
            said = json.loads(sender.stdout.readline())
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
    return Found(
        sent=said["sent"],
        recorded=recorded,
        lost_transport=lost_transport,
        lost_recorder=lost_recorder,
        size=sum(path.stat().st_size for path in paths),
        wall_s=said["wall_s"],
        # Importing is not recording: what it took before the first session is not counted.
        cpu_s=(healths[-1].cpu_ns - (idle[-1].cpu_ns if idle else 0)) * 1e-9,
        memory_early=statistics.median(memory[len(busy) // 5 : 2 * len(busy) // 5 + 1]),
        memory_late=statistics.median(memory[-(len(busy) // 5 + 1) :]),
        memory_most=max(memory),
    )


def write_lab(folder: Path, rigs: int) -> Path:
    config = folder / "lab.toml"
    names = "".join(f'[[rigs]]\nname = "rig{number}"\n' for number in range(rigs))
    config.write_text(
        f"[bus]\nfirst_port = {free_ports(7447, 3)}\n[recorder]\nfolder = '{folder / 'recordings'}'\n{names}"
    )
    return config


def finished_files(lab: LabConfig, recorder: subprocess.Popen[bytes], rigs: int) -> list[Path]:
    deadline = time.monotonic() + 60
    while True:
        paths = list((lab.recorder.folder / lab.name).glob("*/*.mcap"))
        if len(paths) >= rigs:
            return paths
        if recorder.poll() is not None or time.monotonic() > deadline:
            raise SystemExit(f"only {len(paths)} of {rigs} recordings were finished")
        time.sleep(0.1)


def contents(paths: list[Path]) -> tuple[int, int, int]:
    """States in the files, and the losses that they state."""
    found = lost_transport = lost_recorder = 0
    for path in paths:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise SystemExit(f"{path} has no index")
            states_id = next(channel.id for channel in summary.channels.values() if channel.topic == "/state")
            found += summary.statistics.channel_message_counts.get(states_id, 0)
            for record in reader.iter_metadata():
                if record.name == "hilrig.summary":
                    lost_transport += int(record.metadata["lost_transport"])
                    lost_recorder += int(record.metadata["lost_recorder"])
    return found, lost_transport, lost_recorder


if __name__ == "__main__":
    sys.exit(main())
