"""Random faults in a lab on five hosts, with a controller of each rig, for minutes; run it as root.

Kills, stops, link cuts, router restarts, clock steps and a slow disk follow each other at random times. Afterwards the
recordings are compared with the guarantees of docs/several-hosts.md: the torque was zero within the timeouts, no
message is lost that a witness at the router has received, each loss is stated, every file verifies, every fault is
reported.
"""

import argparse
import json
import mmap
import os
import random
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from mcap.reader import make_reader

from hilrig_replay.io.run import open_run
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import load_lab
from hilrig_schemas import Event, JointState
from hilrig_schemas.topics import STATE, parse_rig_key
from support.multi_host_lab import TIMEOUT_NS, TOLERANCE_NS, MultiHostLab, RigAddress
from support.namespaces import Network, require_namespaces
from support.waiting import eventually

SUPPORT = Path(__file__).with_name("support")
RIGS = 8
SERVICES = ("sim", "edge", "recorder")
COMMANDS = {
    "router": ["router", "--listen", "tcp/0.0.0.0:7447"],
    "sim": ["sim"],
    "edge": ["edge"],
    "recorder": ["recorder"],
}
WATCHDOG_NS = 1_000_000_000
CACHED_S = 25.0
"""An outage of at most this time loses nothing (the caches have 30 s)."""
LOST_BEFORE_KILL_NS = 1_000_000_000
"""Last messages of a killed simulation that it had not added to its recording stream."""
FETCHED_NS = 3_000_000_000
"""Time from the restart of a recorder in which it has fetched the messages of its outage (docs/several-hosts.md)."""
RECOVERY_S = 60.0
SEEN = np.dtype([("rig", "u1"), ("incarnation", "u8"), ("step", "u8"), ("flags", "u1"), ("sampled_ns", "i8")])
IN_SESSION, HAS_TORQUE = 1, 2


@dataclass
class Fault:
    """A fault; times of the monotonic clock, ns, which all hosts share here."""

    kind: str
    host: str
    duration_s: float
    begin_ns: int = 0
    end_ns: int = 0
    begin_wall_ns: int = 0

    def __str__(self) -> str:
        return f"{self.kind} {self.host} {self.duration_s:.1f} s"

    @property
    def interrupts_commands(self) -> bool:
        """Whether the simulation receives no commands for longer than the timeout."""
        return self.host in ("edge", "router") or (self.host == "sim" and self.kind == "cut")


@dataclass
class Chaos:
    """The running lab and its faults."""

    lab: MultiHostLab
    rng: random.Random
    shared: dict[str, mmap.mmap]
    """Clock offset (ns) and sync delay (ms) of each service, see `chaos_preload.c`."""
    witness: Path
    faults: list[Fault] = field(default_factory=list)

    def draw(self) -> Fault:
        """Draw the next fault."""
        kind = self.rng.choice(["kill", "stop", "cut", "kill router", "clock", "slow disk"])
        if kind == "cut":
            return Fault(kind, self.rng.choice(["sim", "edge", "recorder", "pc"]), self.rng.choice([1.0, 5.0, 30.0]))
        if kind == "kill router":
            return Fault("kill", "router", self.rng.uniform(1.0, 5.0))
        if kind == "clock":
            return Fault(kind, self.rng.choice(SERVICES), 3.0)
        if kind == "slow disk":
            return Fault(kind, "recorder", 15.0)
        return Fault(kind, self.rng.choice(SERVICES), self.rng.uniform(1.0, 8.0))

    def inject(self, fault: Fault) -> None:
        """Inject a fault, and end it after its duration."""
        begin, end = {
            "kill": (self._kill, self._start),
            "stop": (lambda host: self._signal(host, "STOP"), lambda host: self._signal(host, "CONT")),
            "cut": (lambda host: self.lab.network.set_link(host, False), self._link),
            "clock": (lambda host: self._share(host, self.rng.choice([-5, 3600]) * 10**9, 0), self._reset),
            "slow disk": (lambda host: self._share(host, 0, 8_000), self._reset),
        }[fault.kind]
        fault.begin_ns, fault.begin_wall_ns = time.monotonic_ns(), time.time_ns()
        begin(fault.host)
        time.sleep(fault.duration_s)  # the duration of the fault
        fault.end_ns = time.monotonic_ns()
        end(fault.host)
        self.faults.append(fault)

    def _kill(self, host: str) -> None:
        self.lab.kill(host)

    def _start(self, host: str) -> None:
        self.lab.start(host)

    def _signal(self, host: str, name: str) -> None:
        subprocess.run(["kill", f"-{name}", str(self.lab.processes[host].pid)], check=True)

    def _link(self, host: str) -> None:
        self.lab.network.set_link(host, True)

    def _share(self, host: str, offset_ns: int, delay_ms: int) -> None:
        self.shared[host][:16] = struct.pack("<qq", offset_ns, delay_ms)

    def _reset(self, host: str) -> None:
        self._share(host, 0, 0)

    def seen(self) -> np.ndarray:
        """States that the witness has received."""
        data = self.witness.read_bytes()
        return np.frombuffer(data[: len(data) // SEEN.itemsize * SEEN.itemsize], SEEN)

    def is_recovered(self) -> bool:
        """Whether the torque of every rig acted in the last half second, and each rig is recorded."""
        newest = self.seen()[-50 * RIGS :]
        after_ns = time.monotonic_ns() - 500_000_000
        active = newest[(newest["sampled_ns"] > after_ns) & (newest["flags"] & HAS_TORQUE > 0)]
        return len(np.unique(active["rig"])) == RIGS and len(self.lab.unfinished()) >= RIGS


def observe(config: Path, out: Path) -> None:
    """Write every state that is received to a file, until standard input is closed."""
    lab = load_lab(config)
    numbers = {rig.name: number for number, rig in enumerate(lab.rigs)}
    with out.open("wb", buffering=0) as stream, ZenohBus(lab.bus, "tool") as bus:

        def on_state(key: str, payload: bytes) -> None:
            state = JointState.FromString(payload)
            flags = IN_SESSION * bool(state.session) + HAS_TORQUE * any(state.effort)
            row = (numbers[parse_rig_key(key).rig], state.incarnation, state.step, flags, state.sampled_ns)
            stream.write(np.array(row, SEEN).tobytes())

        bus.subscribe(STATE.key(lab.name, "*"), on_state)
        sys.stdin.read()


@contextmanager
def running(folder: Path, rng: random.Random) -> Iterator[Chaos]:
    """The lab with its controllers and the witness."""
    library = folder / "chaos_preload.so"
    source = str(SUPPORT / "chaos_preload.c")
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", str(library), source, "-ldl"], check=True)
    config, witness = folder / "lab.toml", folder / "witness"
    witness.touch()
    config.write_text(
        f"[rigs]\ncount = {RIGS}\n[bus]\ntopology = 'router'\nrouter = 'tcp/router:7447'\n[edge]\nhost = '0.0.0.0'\n"
        f"[recorder]\nfolder = '{folder / 'recordings'}'\n"
    )
    lab_config = load_lab(config)
    with ExitStack() as closing:
        network = closing.enter_context(Network([*COMMANDS, "pc"]))
        lab = MultiHostLab(network, config, lab_config, COMMANDS)
        shared = {}
        for host in SERVICES:
            path = folder / f"{host}.shared"
            path.write_bytes(bytes(16))
            with path.open("r+b") as stream:
                shared[host] = closing.enter_context(mmap.mmap(stream.fileno(), 16))
            lab.environ[host] = {**os.environ, "LD_PRELOAD": str(library), "CHAOS_FILE": str(path)}
        for host in COMMANDS:
            lab.start(host)
        program = [sys.executable, __file__, "--witness", str(config), str(witness)]
        network.popen("router", program, stdin=subprocess.PIPE)
        chaos = Chaos(lab, rng, shared, witness)
        for rig, port in lab_config.ports.items():
            lab.controller(RigAddress(rig, "edge", port))
        eventually(chaos.is_recovered, timeout_s=RECOVERY_S, every_s=0.2)
        yield chaos
        # The files of the last sessions are completed.
        time.sleep(2.0)
        for host in ("edge", "sim", "recorder", "router"):
            lab.processes[host].terminate()
            lab.processes[host].wait(20)


@dataclass
class Recorded:
    """All recordings of the run."""

    paths: list[Path]
    states: dict[int, np.ndarray] = field(default_factory=dict)
    """Incarnation, step, sampling time and torque of the states of each rig."""
    events: list[Event] = field(default_factory=list)
    stated: int = 0
    clock_steps: int = 0
    endings: list[str] = field(default_factory=list)

    def read(self, rigs: list[str]) -> None:
        """Read all files."""
        columns: dict[int, list[np.ndarray]] = {}
        for path in self.paths:
            run = open_run(path)
            states = run.states
            kept = np.empty(len(states), [("incarnation", "u8"), ("step", "u8"), ("sampled_ns", "i8"), ("torque", "?")])
            for name in ("incarnation", "step", "sampled_ns"):
                kept[name] = states[name]
            kept["torque"] = np.abs(states["effort"]).max(axis=1, initial=0.0) > 0
            columns.setdefault(rigs.index(run.rig), []).append(kept)
            losses = run.losses
            self.stated += 0 if losses is None else losses.transport + losses.recorder
            with path.open("rb") as stream:
                reader = make_reader(stream)
                self.events += [Event.FromString(m.data) for _, _, m in reader.iter_messages(topics=["/event"])]
                summary = next(m.metadata for m in reader.iter_metadata() if m.name == "hilrig.summary")
            self.clock_steps += int(summary.get("clock_steps", 0))
            self.endings.append(summary["ended"])
        self.states = {rig: np.concatenate(parts) for rig, parts in columns.items()}


def check_torque(faults: list[Fault], recorded: Recorded) -> Iterator[str]:
    """Yield each fault that interrupted the commands of a rig while its torque was not zero."""
    for fault in faults:
        if fault.kind in ("clock", "slow disk"):
            continue
        limit_ns = TIMEOUT_NS + TOLERANCE_NS
        if fault.host == "pc":
            limit_ns += WATCHDOG_NS
        elif not fault.interrupts_commands:
            continue
        for rig, states in recorded.states.items():
            times = states["sampled_ns"]
            during = states[(times > fault.begin_ns + limit_ns) & (times < fault.end_ns)]
            if during["torque"].any():
                torque = states["torque"]
                late_ns = times[(times < fault.end_ns) & torque].max() - fault.begin_ns
                yield f"{fault}: rig {rig + 1} has torque {late_ns / 1e6:.0f} ms after it, limit {limit_ns / 1e6:.0f}"


def check_losses(faults: list[Fault], recorded: Recorded, seen: np.ndarray) -> Iterator[str]:
    """Yield losses that docs/several-hosts.md excludes; print how many messages each fault lost."""
    lost = []
    for rig, states in recorded.states.items():
        known = set(zip(states["incarnation"].tolist(), states["step"].tolist(), strict=True))
        rigs, flags = seen["rig"], seen["flags"]
        own = seen[(rigs == rig) & (flags & IN_SESSION > 0)]
        keys = zip(own["incarnation"].tolist(), own["step"].tolist(), strict=True)
        lost += [int(ns) for key, ns in zip(keys, own["sampled_ns"], strict=True) if key not in known]
    remaining = np.array(sorted(lost), np.int64)
    witnessed = int((seen["flags"] & IN_SESSION > 0).sum())
    excused = sum(fault.kind == "kill" and fault.host == "sim" for fault in faults) * RIGS * 50
    for outage, fault in pairwise(faults):
        # The messages of an outage of the recorder are in the cache of the killed service only.
        if (outage.kind, outage.host) != ("kill", "recorder") or fault.kind != "kill" or fault.host == "router":
            continue
        if fault.begin_ns - outage.end_ns < FETCHED_NS:
            within = (remaining > outage.begin_ns - LOST_BEFORE_KILL_NS) & (remaining <= fault.begin_ns)
            print(f"{outage}, {fault}: {int(within.sum())} of the witnessed messages lost", flush=True)
            # The file of a killed simulation states them, that of a killed edge ends with the recorder.
            excused += int(within.sum()) if fault.host == "edge" else 0
            remaining = remaining[~within]
    for fault in faults:
        near = (remaining > fault.begin_ns - LOST_BEFORE_KILL_NS) & (remaining < fault.end_ns + 10 * 10**9)
        count = int(near.sum())
        if count:
            print(f"{fault}: {count} of the witnessed messages lost", flush=True)
        if fault.kind == "kill" and fault.host == "sim":
            near &= remaining <= fault.begin_ns
        elif fault.duration_s < CACHED_S:
            continue
        remaining = remaining[~near]
    print(f"{len(lost)} of {witnessed} witnessed messages lost; {recorded.stated} losses stated in the files")
    if len(remaining):
        yield f"{len(remaining)} messages lost that no fault explains, at {remaining[:5].tolist()}"
    if len(lost) > recorded.stated + excused:
        yield f"{len(lost)} messages lost, but only {recorded.stated} stated"


def check_reports(faults: list[Fault], recorded: Recorded, logs: dict[str, str]) -> Iterator[str]:
    """Yield each fault that is in no recording and no log."""

    def has(fault: Fault, kind: Event.Kind, text: str = "") -> bool:
        end_ns = fault.begin_wall_ns + fault.end_ns - fault.begin_ns + 5 * 10**9
        return any(
            (event.kind == kind and text in event.text and fault.begin_wall_ns <= event.wall_ns <= end_ns)
            # A fault soon after another one continues its outage.
            or (
                event.kind == Event.STATE_BACK
                and kind == Event.STATE_LOST
                and "interruptions" in event.text
                and event.wall_ns - event.watchdog_data.silent_ns - 10 * 10**9 <= fault.begin_wall_ns <= event.wall_ns
            )
            for event in recorded.events
        )

    for fault in faults:
        match fault.kind, fault.host:
            case "clock", _:
                reported = recorded.clock_steps > 0
            case "kill", "sim":
                reported = has(fault, Event.STATE_LOST)
            case "stop", "sim":
                reported = has(fault, Event.STATE_LOST) and has(fault, Event.OVERRUN, "simulation")
            case "kill", "edge":
                reported = has(fault, Event.COMMAND_LOST)
            case "stop", "edge":
                reported = has(fault, Event.COMMAND_LOST) and has(fault, Event.OVERRUN, "the edge")
            case ("cut", "sim" | "edge") | ("kill", "router"):
                reported = has(fault, Event.STATE_LOST) and has(fault, Event.COMMAND_LOST)
            case "kill", "recorder":
                reported = "recovered" in recorded.endings
            case "stop", "recorder":
                reported = "stalled for" in logs["recorder"]
            case "cut", "recorder":
                reported = has(fault, Event.RECORDING, "no messages of")
            case "slow disk", "recorder":
                reported = "slow disk" in logs["recorder"]
            case "cut", "pc":
                reported = has(fault, Event.WATCHDOG_TRIP)
            case _:
                raise AssertionError(f"no report is defined of {fault}")
        if not reported:
            yield f"{fault}: not reported"


def check_files(recorded: Recorded) -> Iterator[str]:
    """Yield each file that does not verify."""
    command = [sys.executable, "-m", "hilrig_cli", "verify", "--json", *map(str, recorded.paths)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    found = json.loads(done.stdout)
    yield from (f"unreadable: {one}" for one in found["unreadable"])
    # A recorder that was killed soon after it was started leaves a file with too few states to simulate one again.
    yield from (f"differs from its simulation: {one}" for one in found["runs"] if one["steps"] and not one["same"])


def main() -> int:
    """Run the lab with random faults, and print every violated guarantee."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 30))
    parser.add_argument("--folder", type=Path, help="keep recordings and logs here")
    parser.add_argument("--witness", type=Path, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.witness:
        observe(*options.witness)
        return 0
    try:
        require_namespaces()
    except pytest.skip.Exception as missing:
        print(f"not run: {missing}")
        return 0
    print(f"seed {options.seed}", flush=True)
    rng = random.Random(options.seed)
    with ExitStack() as closing:
        folder = options.folder or Path(closing.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        problems: list[str] = []
        with running(folder, rng) as chaos:
            end_s = time.monotonic() + options.seconds
            while time.monotonic() < end_s:
                time.sleep(rng.uniform(0.5, 8.0))
                fault = chaos.draw()
                chaos.inject(fault)
                recovering_s = time.monotonic()
                try:
                    eventually(chaos.is_recovered, timeout_s=RECOVERY_S, every_s=0.2)
                except AssertionError:
                    problems.append(f"{fault}: the loop is not closed {RECOVERY_S:.0f} s later")
                print(f"{fault}: recovered after {time.monotonic() - recovering_s:.1f} s", flush=True)
            seen = chaos.seen()
        recorded = Recorded(chaos.lab.recordings())
        recorded.read([rig.name for rig in chaos.lab.lab.rigs])
        logs = {host: chaos.lab.log(host).read_text() for host in COMMANDS}
        problems += [f"{host}: traceback in its log" for host, log in logs.items() if "Traceback" in log]
        problems += [f"not finished: {path.name}" for path in chaos.lab.unfinished()]
        problems += check_torque(chaos.faults, recorded)
        problems += check_losses(chaos.faults, recorded, seen)
        problems += check_reports(chaos.faults, recorded, logs)
        problems += check_files(recorded)
        print(json.dumps({"faults": len(chaos.faults), "files": len(recorded.paths), "problems": problems}, indent=1))
        return bool(problems)


if __name__ == "__main__":
    sys.exit(main())
