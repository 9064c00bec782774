"""Checks that a lab of 64 rigs runs for half an hour while controllers connect, disconnect, crash and misbehave.

One process plays all controllers: some control their rig, some reset the connection, send garbage or half a request,
flood, compete for a lease, or connect and stay idle. Memory, file descriptors and threads of each service are sampled
every few seconds. The memory growth is the median slope of all pairs of samples after the warm-up, because it does not
depend on the number of files that are open at the first and last sample. At the end, all torques must be zero, all
recordings complete, and re-simulations identical bit for bit. `--minutes` sets the duration; after an interruption the
data collected so far are evaluated and their duration is reported.
"""

import argparse
import asyncio
import json
import random
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import harness
import numpy as np
from harness import Report, percentile, services_log, write_lab

from hilrig_cli.local.local_lab import POLL_S, running_lab
from hilrig_cli.local.supervisor import Supervisor
from hilrig_replay.analysis.verify import verify
from hilrig_replay.io.run import open_run
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError
from hilrig_schemas import JointState, RigBatch
from hilrig_schemas.topics import STATES

QUESTION = "Does a lab of 64 rigs run for a long time while controllers connect, disconnect, crash and misbehave?"
RIGS = 64
READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
SAMPLE_S = 2.0
WARM_UP_FRACTION = 0.3
"""Warm-up as a fraction of the run, at most `WARM_UP_S`; memory growth is measured after it."""
WARM_UP_S = 300.0
GRACE_MS = 500
"""Short, so that each controller starts a new session."""
SESSION_END_WAIT_S = 6.0
"""Time after which the session of the last controller has ended and its file is closed."""
MAX_GROWTH_MIB_H = 12.0
"""Largest memory growth of a service; smaller values can't be distinguished from noise within half an hour."""
MIN_GROWTH_RUN_S = 600.0
"""Shortest time after the warm-up for which memory growth is checked; noise dominates in shorter runs."""
MAX_RESIMULATED = 200
"""Number of recordings that are re-simulated, spread over all; each takes as long as reading about twenty."""


def write(torque: int) -> bytes:
    """Return a request that writes a torque of the first joint."""
    return struct.pack(">HHHBBHHB4h", 1, 0, 15, 1, 16, 0, 4, 8, torque, 0, 0, 0)


# -- the controllers, a separate process -----------------------------------------------------------------------------


class ControllerMix:
    """Runs controllers with random behaviors on all rigs for a given time."""

    def __init__(self, first_port: int, seconds: float, seed: int) -> None:
        self._first_port = first_port
        self._end_s = time.monotonic() + seconds
        self._random = random.Random(seed)
        self.counts: dict[str, int] = {}
        self._behaviors: tuple[Callable[[int], Awaitable[None]], ...] = (
            self.control,
            self.control,
            self.control,
            self.reset,
            self.send_garbage,
            self.send_partial_request,
            self.flood,
            self.compete_for_lease,
            self.stay_idle,
        )

    async def run(self) -> None:
        loop = asyncio.get_running_loop()

        def stop_with_parent() -> None:
            sys.stdin.read()
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(self.stop)

        threading.Thread(target=stop_with_parent, daemon=True).start()
        await asyncio.gather(*(self._run_port(self._first_port + rig) for rig in range(RIGS)))

    def stop(self) -> None:
        """Start no further controllers; those that run finish."""
        self._end_s = 0.0

    async def _run_port(self, port: int) -> None:
        while time.monotonic() < self._end_s:
            behavior = self._random.choice(self._behaviors)
            name = getattr(behavior, "__name__", "")
            self.counts[name] = self.counts.get(name, 0) + 1
            try:
                await asyncio.wait_for(behavior(port), 30)
            except (OSError, TimeoutError, asyncio.IncompleteReadError):
                self.counts["failed"] = self.counts.get("failed", 0) + 1
            await asyncio.sleep(self._random.uniform(0, 1))

    async def control(self, port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        for _ in range(self._random.randint(10, 150)):
            if time.monotonic() > self._end_s:
                break
            for request in (READ, write(self._random.randint(-400, 400))):
                writer.write(request)
                head = await reader.readexactly(6)
                await reader.readexactly(int.from_bytes(head[4:], "big"))
            await asyncio.sleep(0.08)
        writer.close()
        await writer.wait_closed()

    async def reset(self, port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(write(500))
        await reader.readexactly(12)
        # A TCP reset, as from a killed process.
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        writer.close()

    async def send_garbage(self, port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(self._random.randbytes(self._random.randint(7, 400)))
        await asyncio.wait_for(reader.read(), 5)
        writer.close()

    async def send_partial_request(self, port: int) -> None:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(READ[: self._random.randint(1, 11)])
        await asyncio.sleep(self._random.uniform(0, 3))
        writer.close()

    async def flood(self, port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        count = self._random.randint(20, 200)
        writer.write(READ * count)
        await reader.readexactly(17 * count)
        writer.close()

    async def compete_for_lease(self, port: int) -> None:
        connections = [await asyncio.open_connection("127.0.0.1", port) for _ in range(2)]
        for _ in range(20):
            for reader, writer in connections:
                writer.write(write(100))
                head = await reader.readexactly(6)
                await reader.readexactly(int.from_bytes(head[4:], "big"))
            await asyncio.sleep(0.05)
        for _, writer in connections:
            writer.close()

    async def stay_idle(self, port: int) -> None:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        await asyncio.sleep(self._random.uniform(0, 8))
        writer.close()


# -- the measurement -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Sample:
    """Resources of one service at one time."""

    at_s: float
    resident_mib: float
    descriptors: int
    threads: int


@dataclass
class Observation:
    """Samples of the services and counts of the controllers."""

    samples: dict[str, list[Sample]] = field(default_factory=dict)
    """Service → its samples."""
    counts: dict[str, int] = field(default_factory=dict)
    """Behavior → number of controllers."""
    seconds: float = 0.0
    """Time for which the controllers ran."""

    def sample_services(self, supervisor: Supervisor) -> None:
        """Add a sample of each service."""
        for name, pid in supervisor.pids.items():
            # A service that has just crashed is sampled again after its restart.
            with suppress(OSError, KeyError):
                self.samples.setdefault(name, []).append(sample(pid))


def sample(pid: int) -> Sample:
    """Read the resources of a process from /proc."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    descriptors = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    resident_mib = int(status["VmRSS"].split()[0]) / 1024
    return Sample(time.monotonic(), resident_mib, descriptors, int(status["Threads"].split()[0]))


def measure(minutes: float, report: Report, quick: bool) -> None:
    """Run the lab with the controllers, then check services and recordings."""
    seconds = 60.0 * (1.0 if quick else minutes)
    supervisor_lines: list[str] = []
    with (
        tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder,
        interruptions() as interrupted,
        services_log(Path(folder) / "log"),
    ):
        lab, config, port = write_lab(Path(folder), rigs=RIGS, session_grace_ms=GRACE_MS)
        with running_lab(lab, config, supervisor_lines.append, threading.Event()) as supervisor:
            before = Observation()
            before.sample_services(supervisor)
            observation = watch(supervisor, port, seconds, interrupted)
            log("waiting for the last sessions to end")
            end_s = time.monotonic() + SESSION_END_WAIT_S
            while time.monotonic() < end_s:
                supervisor.poll()
                time.sleep(POLL_S)
            after = Observation()
            after.sample_services(supervisor)
            active_rigs = rigs_with_torque(lab)
        for line in (*supervisor_lines, *service_warnings(Path(folder) / "log")):
            log(line)
        log("checking the recordings")
        found = check_recordings(Path(folder))
        part_files = len(list(Path(folder).rglob("*.part")))
    case = f"{RIGS} rigs for {observation.seconds / 60:.3g} min"
    for behavior, count in sorted(observation.counts.items()):
        report.add(case, f"controllers: {behavior.replace('_', ' ')}", count, "count")
    report.add(case, "recordings", found.files, "count")
    report.add(case, "recordings re-simulated", found.resimulated, "count")
    for name, samples in sorted(observation.samples.items()):
        check_service(report, case, name, before.samples[name][0], samples, after.samples.get(name, samples)[-1])
    report.require("duration, relative to the planned one", observation.seconds / seconds, ">=", 0.99)
    report.require("services that crashed", sum("restarting" in line for line in supervisor_lines), "<=", 0)
    report.require("rigs with a torque after the last controller", active_rigs, "<=", 0)
    report.require("incomplete recordings", found.incomplete + part_files, "<=", 0)
    report.require("recordings that differ from their re-simulation", found.mismatched, "<=", 0)
    report.require("messages lost", found.lost, "<=", 0)


def service_warnings(log: Path) -> Iterator[str]:
    """Yield the first warnings of the services, without those about intended garbage."""
    expected = (": INFO: ", "did not send Modbus TCP")
    lines = [
        line for line in log.read_text(errors="replace").splitlines() if not any(text in line for text in expected)
    ]
    yield from lines[:40]
    if len(lines) > 40:
        yield f"{len(lines) - 40} more lines"


@contextmanager
def interruptions() -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C or SIGTERM sets; the second one ends the process as usual."""
    interrupted = threading.Event()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def interrupt(number: int, _: object) -> None:
        log("interrupted: evaluating the data collected so far; press Ctrl-C again to stop immediately")
        interrupted.set()
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, interrupt)
    yield interrupted
    for number, handler in before.items():
        signal.signal(number, handler)


def watch(supervisor: Supervisor, port: int, seconds: float, interrupted: threading.Event) -> Observation:
    """Start the controllers and sample the services until the controllers have finished."""
    observation = Observation()
    command = [sys.executable, __file__, "--controllers", str(port), str(seconds)]
    begin_s = due_s = log_s = time.monotonic()
    # A new process group, so that Ctrl-C reaches only this process. The child stops when its standard input is closed.
    controllers = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
    with controllers:
        assert controllers.stdin is not None
        assert controllers.stdout is not None
        while controllers.poll() is None:
            supervisor.poll()
            now_s = time.monotonic()
            if not interrupted.is_set():
                observation.seconds = min(seconds, now_s - begin_s)
            elif not controllers.stdin.closed:
                controllers.stdin.close()
            if now_s >= due_s:
                due_s += SAMPLE_S
                observation.sample_services(supervisor)
            if now_s >= log_s:
                log_s += 60.0
                newest = {name: samples[-1] for name, samples in observation.samples.items()}
                log(
                    f"{(now_s - begin_s) / 60:.0f} min: "
                    + ", ".join(
                        f"{n} {s.resident_mib:.1f} MiB, {s.descriptors} file descriptors" for n, s in newest.items()
                    )
                )
            time.sleep(POLL_S)
        observation.counts = json.loads(controllers.stdout.read())
    return observation


def check_service(
    report: Report, case: str, name: str, before: Sample, samples: Sequence[Sample], after: Sample
) -> None:
    """Add and check memory, file descriptors and threads of one service."""
    begin_s, end_s = samples[0].at_s, samples[-1].at_s
    warm_s = begin_s + min(WARM_UP_S, WARM_UP_FRACTION * (end_s - begin_s))
    settled = [one for one in samples if one.at_s >= warm_s]
    report.add(case, f"{name}: memory after the warm-up", settled[0].resident_mib, "MiB")
    report.add(case, f"{name}: memory at the end", settled[-1].resident_mib, "MiB")
    report.add(case, f"{name}: file descriptors before", before.descriptors, "count")
    report.add(case, f"{name}: file descriptors p95", percentile([one.descriptors for one in samples], 0.95), "count")
    report.add(case, f"{name}: file descriptors after", after.descriptors, "count")
    report.add(case, f"{name}: threads before", before.threads, "count")
    report.add(case, f"{name}: threads after", after.threads, "count")
    growth = report.add(case, f"{name}: memory growth", growth_mib_h(settled), "MiB/h")
    if settled[-1].at_s - settled[0].at_s >= MIN_GROWTH_RUN_S:
        report.require(f"{name}: memory growth", growth, "<=", MAX_GROWTH_MIB_H, "MiB/h")
    else:
        report.add_note(f"{name}: memory growth not checked; it needs {MIN_GROWTH_RUN_S / 60:g} min after the warm-up")
    report.require(f"{name}: additional file descriptors", after.descriptors - before.descriptors, "<=", 2)
    report.require(f"{name}: additional threads", after.threads - before.threads, "<=", 2)


def growth_mib_h(samples: Sequence[Sample]) -> float:
    """Return the median of the slopes between all pairs of samples (Theil–Sen estimator), MiB/h."""
    at_s = np.array([one.at_s for one in samples])
    mib = np.array([one.resident_mib for one in samples])
    first, second = np.triu_indices(len(samples), 1)
    return 3600 * float(np.median((mib[second] - mib[first]) / (at_s[second] - at_s[first])))


def rigs_with_torque(lab: LabConfig) -> int:
    """Return the number of rigs that have a torque or whose state was not received."""
    zero: dict[str, bool] = {}
    complete = threading.Event()

    def on_states(_: str, payload: bytes) -> None:
        batch = RigBatch.FromString(payload)
        for rig, message in zip(batch.rigs, batch.messages, strict=True):
            zero[rig] = not any(JointState.FromString(message).effort)
        if len(zero) == len(lab.rigs):
            complete.set()

    with ZenohBus(lab.bus, "tool") as bus, bus.subscribe(STATES.key(lab.name, "*", "*"), on_states):
        complete.wait(3.0)
    return sum(not zero.get(rig.name, False) for rig in lab.rigs)


@dataclass(frozen=True, slots=True)
class RecordingCheck:
    """Results of reading and re-simulating the recordings."""

    files: int
    incomplete: int
    """Recordings that can't be read, were recovered or lack states."""
    lost: int
    """Messages that the recordings report as lost."""
    resimulated: int
    mismatched: int


def check_recordings(folder: Path) -> RecordingCheck:
    """Read all recordings and re-simulate some of them."""
    paths = sorted(folder.rglob("*.mcap"))
    some = paths[:: max(1, len(paths) // MAX_RESIMULATED)]
    with ProcessPoolExecutor() as pool:
        read = list(pool.map(read_one, paths, chunksize=16))
        same = list(pool.map(resimulate_one, some, chunksize=4))
    incomplete = sum(is_incomplete for is_incomplete, _ in read)
    lost = sum(lost_here for _, lost_here in read)
    return RecordingCheck(len(paths), incomplete, lost, len(some), same.count(False))


def read_one(path: Path) -> tuple[bool, int]:
    """Return whether a recording is incomplete, and the number of messages that it reports as lost."""
    try:
        run = open_run(path)
    except InputError as error:
        log(str(error))
        return True, 0
    losses = run.losses
    steps = run.states["step"].astype(np.int64)
    gaps = int((np.diff(steps) != 1).sum())
    incomplete = run.recovered or losses is None or gaps > 0 or not run.parameters_json
    if incomplete:
        log(f"{path.name}: recovered {run.recovered}, {gaps} gaps, parameters {bool(run.parameters_json)}")
    return incomplete, 0 if losses is None else losses.transport + losses.recorder


def resimulate_one(path: Path) -> bool:
    """Return whether the re-simulation equals the recording; true if it is too short to be re-simulated."""
    try:
        found = verify(path)
    except InputError as error:
        log(str(error))
        return False
    return found.same or found.steps == 0


def log(text: str) -> None:
    """Print the progress on standard error, also without a terminal."""
    print(f"  {text}", file=sys.stderr, flush=True)


def main() -> int:
    if "--controllers" in sys.argv:
        controllers = ControllerMix(int(sys.argv[2]), float(sys.argv[3]), seed=1)
        asyncio.run(controllers.run())
        print(json.dumps(controllers.counts))
        return 0
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--minutes", type=float, default=30.0)
    arguments, sys.argv[1:] = parser.parse_known_args()
    return harness.run(partial(measure, arguments.minutes), QUESTION)


if __name__ == "__main__":
    sys.exit(main())
