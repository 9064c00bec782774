"""Does a class of 64 rigs run for half an hour with controllers that come, go, die and misbehave?

A process plays all the controllers: some hold their rig and work, some vanish without a word, send rubbish or half a
request, flood, fight for a rig that another holds, or connect and say nothing. Once every few seconds memory, handles
and threads of each service are read. At the end every recording must be whole. `--minutes` says how long.
"""

import argparse
import asyncio
import json
import random
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import harness
from harness import Report, progress

from hilrig_cli.demo import free_ports
from hilrig_cli.lab import POLL_S, running_lab
from hilrig_replay.run import open_run
from hilrig_runtime.config import load_lab
from hilrig_runtime.errors import InputError

QUESTION = "Does a class of 64 rigs run for long with controllers that come, go, die and misbehave?"
RIGS = 64
READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
SAMPLE_S = 2.0
SETTLED_SHARE = 0.3
"""Of the run: what memory grows later is growth."""


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
        await asyncio.gather(*(self._seat(self._first_port + rig) for rig in range(RIGS)))

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

    resident_mib: float
    handles: int
    threads: int


def sample(pid: int) -> Sample:
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    handles = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    return Sample(int(status["VmRSS"].split()[0]) / 1024, handles, int(status["Threads"].split()[0]))


def measure(minutes: float, report: Report, quick: bool) -> None:
    seconds = 60.0 * (1.0 if quick else minutes)
    said: list[str] = []
    samples: dict[str, list[Sample]] = {}
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        config = Path(folder) / "lab.toml"
        port, bus_port = free_ports(24_000, RIGS), free_ports(7447, 3)
        config.write_text(
            f"[edge]\nfirst_port = {port}\nsession_grace_ms = 0\n[bus]\nfirst_port = {bus_port}\n"
            f"[recorder]\nfolder = '{folder}'\n[rigs]\ncount = {RIGS}\n"
        )
        lab = load_lab(config)
        with running_lab(lab, config, said.append, threading.Event()) as supervisor:
            before = {name: sample(pid) for name, pid in supervisor.pids.items()}
            command = [sys.executable, __file__, "--chaos", str(port), str(seconds)]
            with subprocess.Popen(command, stdout=subprocess.PIPE) as chaos:
                due_s = time.monotonic()
                while chaos.poll() is None:
                    supervisor.poll()
                    if time.monotonic() >= due_s:
                        due_s += SAMPLE_S
                        for name, pid in supervisor.pids.items():
                            samples.setdefault(name, []).append(sample(pid))
                    time.sleep(POLL_S)
                assert chaos.stdout is not None
                counts = json.loads(chaos.stdout.read())
            progress("what is left goes")
            for _ in range(100):
                supervisor.poll()
                time.sleep(POLL_S)
            after = {name: sample(pid) for name, pid in supervisor.pids.items()}
        files, torn, lost = whole(Path(folder))
        parts = len(list(Path(folder).rglob("*.part")))
    case = f"{RIGS} rigs for {seconds / 60:g} min"
    for kind, count in sorted(counts.items()):
        report.add(case, f"controllers that {kind.replace('_', ' ')}", count, "count")
    report.add(case, "recordings", files, "count")
    for name, all_samples in sorted(samples.items()):
        settled = all_samples[int(SETTLED_SHARE * len(all_samples))]
        last = all_samples[-1]
        report.add(case, f"{name}: memory when settled", settled.resident_mib, "MiB")
        report.add(case, f"{name}: memory at the end", last.resident_mib, "MiB")
        report.add(case, f"{name}: handles before", before[name].handles, "count")
        report.add(case, f"{name}: handles at most", max(one.handles for one in all_samples), "count")
        report.add(case, f"{name}: handles after", after[name].handles, "count")
        report.bar(f"{name}: growth of memory", 100 * (last.resident_mib / settled.resident_mib - 1), "<=", 10, "%")
        report.bar(f"{name}: handles left behind", after[name].handles - before[name].handles, "<=", 2)
        report.bar(f"{name}: threads left behind", after[name].threads - before[name].threads, "<=", 2)
    report.bar("services that died", sum("restarting" in line for line in said), "<=", 0)
    report.bar("recordings that are not whole", torn + parts, "<=", 0)
    report.bar("messages lost", lost, "<=", 0)


def whole(folder: Path) -> tuple[int, int, int]:
    """Recordings, those of them that can't be read or had to be recovered, and messages that they state as lost."""
    files = torn = lost = 0
    for path in folder.rglob("*.mcap"):
        files += 1
        try:
            run = open_run(path)
            torn += run.recovered
            losses = run.losses
            lost += 0 if losses is None else losses.transport + losses.recorder
        except InputError:
            torn += 1
    return files, torn, lost


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
