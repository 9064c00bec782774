"""Does a class of 64 rigs run for half an hour with controllers that come, go, die and misbehave?

A process plays all the controllers: some hold their rig and work, some vanish without a word, send rubbish or half a
request, flood, fight for a rig that another holds, or connect and say nothing. Once every few seconds memory, handles
and threads of each service are read; growth is the median slope of all pairs of samples after the warm-up, so that a
recorder that has more files open at one moment than at another counts as neither. At the end every torque must be zero,
every recording whole, and what is re-simulated the same bit for bit. `--minutes` says how long; interrupted, it judges
what it has until then, and says how long that was.
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

QUESTION = "Does a class of 64 rigs run for long with controllers that come, go, die and misbehave?"
RIGS = 64
READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
SAMPLE_S = 2.0
WARM_UP_SHARE = 0.3
"""Of the run, and no more than `WARM_UP_S`: what memory grows later is growth."""
WARM_UP_S = 300.0
GRACE_MS = 500
"""Short, so that each controller has a session of its own."""
ENDING_S = 6.0
"""After the last controller: until its session has ended and its file is closed."""
GROWTH_MIB_H = 12.0
"""What a service may grow in an hour; what is below can't be told from noise in half an hour."""
LONG_S = 600.0
"""After the warm-up: in less, noise is more than that."""
RESIMULATED = 200
"""Recordings, evenly out of all; each takes as long as reading some twenty."""


def write(torque: int) -> bytes:
    return struct.pack(">HHHBBHHB4h", 1, 0, 15, 1, 16, 0, 4, 8, torque, 0, 0, 0)


# -- the controllers, a process of its own ---------------------------------------------------------------------------


class Chaos:
    """Controllers of all kinds, until the time is over."""

    def __init__(self, first_port: int, seconds: float, seed: int) -> None:
        self._first_port = first_port
        self._end_s = time.monotonic() + seconds
        self._random = random.Random(seed)
        self.counts: dict[str, int] = {}
        self._kinds: tuple[Callable[[int], Awaitable[None]], ...] = (
            self.work,
            self.work,
            self.work,
            self.vanish,
            self.say_rubbish,
            self.say_half,
            self.flood,
            self.fight,
            self.be_silent,
        )

    async def run(self) -> None:
        loop = asyncio.get_running_loop()

        def stop_with_parent() -> None:
            sys.stdin.read()
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(self.stop)

        threading.Thread(target=stop_with_parent, daemon=True).start()
        await asyncio.gather(*(self._seat(self._first_port + rig) for rig in range(RIGS)))

    def stop(self) -> None:
        """Nobody comes any more; who is there goes when he is done."""
        self._end_s = 0.0

    async def _seat(self, port: int) -> None:
        while time.monotonic() < self._end_s:
            kind = self._random.choice(self._kinds)
            name = getattr(kind, "__name__", "")
            self.counts[name] = self.counts.get(name, 0) + 1
            try:
                await asyncio.wait_for(kind(port), 30)
            except (OSError, TimeoutError, asyncio.IncompleteReadError):
                self.counts["broken"] = self.counts.get("broken", 0) + 1
            await asyncio.sleep(self._random.uniform(0, 1))

    async def work(self, port: int) -> None:
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

    async def vanish(self, port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(write(500))
        await reader.readexactly(12)
        # A reset, as of a program that was killed.
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        writer.close()

    async def say_rubbish(self, port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(self._random.randbytes(self._random.randint(7, 400)))
        await asyncio.wait_for(reader.read(), 5)
        writer.close()

    async def say_half(self, port: int) -> None:
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

    async def fight(self, port: int) -> None:
        both = [await asyncio.open_connection("127.0.0.1", port) for _ in range(2)]
        for _ in range(20):
            for reader, writer in both:
                writer.write(write(100))
                head = await reader.readexactly(6)
                await reader.readexactly(int.from_bytes(head[4:], "big"))
            await asyncio.sleep(0.05)
        for _, writer in both:
            writer.close()

    async def be_silent(self, port: int) -> None:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        await asyncio.sleep(self._random.uniform(0, 8))
        writer.close()


# -- the measurement -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Sample:
    """One service at one moment."""

    at_s: float
    resident_mib: float
    handles: int
    threads: int


@dataclass
class Watched:
    """What was seen while it ran."""

    samples: dict[str, list[Sample]] = field(default_factory=dict)
    """Of each service."""
    counts: dict[str, int] = field(default_factory=dict)
    """Controllers of each kind."""
    seconds: float = 0.0
    """How long the controllers were at it."""

    def look(self, supervisor: Supervisor) -> None:
        for name, pid in supervisor.pids.items():
            # One that has just died is looked at again when it is back.
            with suppress(OSError, KeyError):
                self.samples.setdefault(name, []).append(sample(pid))


def sample(pid: int) -> Sample:
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    handles = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    resident_mib = int(status["VmRSS"].split()[0]) / 1024
    return Sample(time.monotonic(), resident_mib, handles, int(status["Threads"].split()[0]))


def measure(minutes: float, report: Report, quick: bool) -> None:
    seconds = 60.0 * (1.0 if quick else minutes)
    said: list[str] = []
    with (
        tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder,
        interruptions() as interrupted,
        services_log(Path(folder) / "log"),
    ):
        lab, config, port = write_lab(Path(folder), rigs=RIGS, session_grace_ms=GRACE_MS)
        with running_lab(lab, config, said.append, threading.Event()) as supervisor:
            before = Watched()
            before.look(supervisor)
            watched = watch(supervisor, port, seconds, interrupted)
            tell("what is left goes")
            end_s = time.monotonic() + ENDING_S
            while time.monotonic() < end_s:
                supervisor.poll()
                time.sleep(POLL_S)
            after = Watched()
            after.look(supervisor)
            moving = standing_torques(lab)
        for line in (*said, *troubles(Path(folder) / "log")):
            tell(line)
        tell("recordings are read")
        found = whole(Path(folder))
        parts = len(list(Path(folder).rglob("*.part")))
    case = f"{RIGS} rigs for {watched.seconds / 60:.3g} min"
    for kind, count in sorted(watched.counts.items()):
        report.add(case, f"controllers that {kind.replace('_', ' ')}", count, "count")
    report.add(case, "recordings", found.files, "count")
    report.add(case, "recordings re-simulated", found.resimulated, "count")
    for name, samples in sorted(watched.samples.items()):
        judge(report, case, name, before.samples[name][0], samples, after.samples.get(name, samples)[-1])
    report.bar("minutes made, of those meant", watched.seconds / seconds, ">=", 0.99)
    report.bar("services that died", sum("restarting" in line for line in said), "<=", 0)
    report.bar("rigs with a torque when all have gone", moving, "<=", 0)
    report.bar("recordings that are not whole", found.torn + parts, "<=", 0)
    report.bar("recordings that re-simulate to something else", found.different, "<=", 0)
    report.bar("messages lost", found.lost, "<=", 0)


def troubles(log: Path) -> Iterator[str]:
    """What the services warned of, rubbish that was meant as such apart; not all of it."""
    expected = (": INFO: ", "did not send Modbus TCP")
    lines = [
        line for line in log.read_text(errors="replace").splitlines() if not any(word in line for word in expected)
    ]
    yield from lines[:40]
    if len(lines) > 40:
        yield f"and {len(lines) - 40} more lines"


@contextmanager
def interruptions() -> Iterator[threading.Event]:
    """Set by the first Ctrl-C or SIGTERM; the second ends the process as usual."""
    interrupted = threading.Event()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def interrupt(number: int, _: object) -> None:
        tell("interrupted: what there is until now is judged; once more ends at once")
        interrupted.set()
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, interrupt)
    yield interrupted
    for number, handler in before.items():
        signal.signal(number, handler)


def watch(supervisor: Supervisor, port: int, seconds: float, interrupted: threading.Event) -> Watched:
    """Let the controllers loose, and look at the services until they have gone."""
    watched = Watched()
    command = [sys.executable, __file__, "--chaos", str(port), str(seconds)]
    begin_s = due_s = tell_s = time.monotonic()
    # In a group of its own: a terminal's Ctrl-C is for us. It ends with its standard input.
    chaos = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
    with chaos:
        assert chaos.stdin is not None
        assert chaos.stdout is not None
        while chaos.poll() is None:
            supervisor.poll()
            now_s = time.monotonic()
            if not interrupted.is_set():
                watched.seconds = min(seconds, now_s - begin_s)
            elif not chaos.stdin.closed:
                chaos.stdin.close()
            if now_s >= due_s:
                due_s += SAMPLE_S
                watched.look(supervisor)
            if now_s >= tell_s:
                tell_s += 60.0
                newest = {name: samples[-1] for name, samples in watched.samples.items()}
                tell(
                    f"{(now_s - begin_s) / 60:.0f} min: "
                    + ", ".join(f"{n} {s.resident_mib:.1f} MiB, {s.handles} handles" for n, s in newest.items())
                )
            time.sleep(POLL_S)
        watched.counts = json.loads(chaos.stdout.read())
    return watched


def judge(report: Report, case: str, name: str, before: Sample, samples: Sequence[Sample], after: Sample) -> None:
    """Memory, handles and threads of one service."""
    begin_s, end_s = samples[0].at_s, samples[-1].at_s
    warm_s = begin_s + min(WARM_UP_S, WARM_UP_SHARE * (end_s - begin_s))
    settled = [one for one in samples if one.at_s >= warm_s]
    report.add(case, f"{name}: memory when settled", settled[0].resident_mib, "MiB")
    report.add(case, f"{name}: memory at the end", settled[-1].resident_mib, "MiB")
    report.add(case, f"{name}: handles before", before.handles, "count")
    report.add(case, f"{name}: handles p95", percentile([one.handles for one in samples], 0.95), "count")
    report.add(case, f"{name}: handles after", after.handles, "count")
    report.add(case, f"{name}: threads before", before.threads, "count")
    report.add(case, f"{name}: threads after", after.threads, "count")
    growth = report.add(case, f"{name}: growth of memory", growth_mib_h(settled), "MiB/h")
    if settled[-1].at_s - settled[0].at_s >= LONG_S:
        report.bar(f"{name}: growth of memory", growth, "<=", GROWTH_MIB_H, "MiB/h")
    else:
        report.say(f"{name}: too short a run to judge the growth of memory; it takes {LONG_S / 60:g} min after warm-up")
    report.bar(f"{name}: handles left behind", after.handles - before.handles, "<=", 2)
    report.bar(f"{name}: threads left behind", after.threads - before.threads, "<=", 2)


def growth_mib_h(samples: Sequence[Sample]) -> float:
    """Median of the slopes between all pairs of samples (Theil and Sen), MiB an hour."""
    at_s = np.array([one.at_s for one in samples])
    mib = np.array([one.resident_mib for one in samples])
    first, second = np.triu_indices(len(samples), 1)
    return 3600 * float(np.median((mib[second] - mib[first]) / (at_s[second] - at_s[first])))


def standing_torques(lab: LabConfig) -> int:
    """Rigs whose arm has a torque now, or of which nothing is heard."""
    zero: dict[str, bool] = {}
    complete = threading.Event()

    def hear(_: str, payload: bytes) -> None:
        batch = RigBatch.FromString(payload)
        for rig, message in zip(batch.rigs, batch.messages, strict=True):
            zero[rig] = not any(JointState.FromString(message).effort)
        if len(zero) == len(lab.rigs):
            complete.set()

    with ZenohBus(lab.bus, "tool") as bus, bus.subscribe(STATES.key(lab.name, "*", "*"), hear):
        complete.wait(3.0)
    return sum(not zero.get(rig.name, False) for rig in lab.rigs)


@dataclass(frozen=True, slots=True)
class Found:
    """What the recordings are."""

    files: int
    torn: int
    """They can't be read, had to be recovered, or miss states."""
    lost: int
    """Messages that they state as lost."""
    resimulated: int
    different: int


def whole(folder: Path) -> Found:
    """Read every recording, and re-simulate some."""
    paths = sorted(folder.rglob("*.mcap"))
    some = paths[:: max(1, len(paths) // RESIMULATED)]
    with ProcessPoolExecutor() as pool:
        read = list(pool.map(read_one, paths, chunksize=16))
        same = list(pool.map(resimulate_one, some, chunksize=4))
    return Found(len(paths), sum(torn for torn, _ in read), sum(lost for _, lost in read), len(some), same.count(False))


def read_one(path: Path) -> tuple[bool, int]:
    """Whether it is torn, and how many messages it states as lost."""
    try:
        run = open_run(path)
    except InputError as error:
        tell(str(error))
        return True, 0
    losses = run.losses
    steps = run.states["step"].astype(np.int64)
    gaps = int((np.diff(steps) != 1).sum())
    torn = run.recovered or losses is None or gaps > 0 or not run.parameters_json
    if torn:
        tell(f"{path.name}: recovered {run.recovered}, {gaps} gaps, parameters {bool(run.parameters_json)}")
    return torn, 0 if losses is None else losses.transport + losses.recorder


def resimulate_one(path: Path) -> bool:
    """Whether it re-simulates to what was recorded; what is too short to be re-simulated does."""
    try:
        found = verify(path)
    except InputError as error:
        tell(str(error))
        return False
    return found.same or found.steps == 0


def tell(text: str) -> None:
    """Say how it goes, also where nobody watches: it is kept if this process is ended."""
    print(f"  {text}", file=sys.stderr, flush=True)


def main() -> int:
    if "--chaos" in sys.argv:
        chaos = Chaos(int(sys.argv[2]), float(sys.argv[3]), seed=1)
        asyncio.run(chaos.run())
        print(json.dumps(chaos.counts))
        return 0
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--minutes", type=float, default=30.0)
    arguments, sys.argv[1:] = parser.parse_known_args()
    return harness.run(partial(measure, arguments.minutes), QUESTION)


if __name__ == "__main__":
    sys.exit(main())
