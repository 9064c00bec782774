"""A recorder process, and fake services that publish to it on the zenoh bus and keep the published messages."""

import os
import pickle
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.reader import make_reader

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_runtime.timing.rate import Rate
from hilrig_schemas import Event, JointState, OpenSession, RigConfig, TorqueCommand
from hilrig_schemas.topics import COMMAND, CONFIG, STATE, alive_key
from support.hilrig_process import HILRIG, ForkedPopen
from support.labs import free_ports, write_lab
from support.waiting import LONG_TIMEOUT_S, eventually

Key = tuple[str, int, bytes]
"""(channel, sequence of the publisher, payload)."""


ZERO_TORQUE = "no command received for 612 ms: torque set to zero until the next command"


class RecorderProcess:
    """A `hilrig recorder` process; the context manager ends it."""

    def __init__(self, config: Path, *options: str, program: Sequence[str] = HILRIG) -> None:
        self.log = config.parent / f"recorder{''.join(options[:2])}.log"
        command = [*program, "recorder", "--config", str(config), *options]
        with self.log.open("a") as log:
            self.process = ForkedPopen(command, stdout=log, stderr=log, cwd=config.parent)

    def kill(self) -> None:
        """Kill the process with SIGKILL."""
        self.process.kill()
        self.process.wait()

    def stop(self, timeout_s: float = 10.0) -> int:
        """Send SIGTERM and return the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.stop()
        except subprocess.TimeoutExpired:
            self.kill()


@dataclass
class Senders:
    """A fake simulation and a fake edge that publish 50 states and commands per second and rig."""

    lab: LabConfig
    rigs: list[str]
    step_ms: float = 20.0
    sent: dict[str, list[Key]] = field(default_factory=dict)
    """Messages published while a session of the rig was open, by rig."""
    sessions: dict[str, str] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    """Events that the simulation emits at the next tick."""
    stopping: threading.Event = field(default_factory=threading.Event)

    def begin(self, rig: str) -> str:
        """Start a session of a rig at the next tick; returns its id."""
        session = f"20260101T000000Z-{rig}-{''.join(random.choices('abcdefghij', k=4))}"
        self.sessions[rig] = session
        return session

    def end(self, rig: str) -> None:
        """End the session of a rig at the next tick."""
        del self.sessions[rig]

    def emit(self, rig: str, text: str = ZERO_TORQUE) -> None:
        """Emit an event of a rig at the next tick."""
        self.events.append(Event(rig=rig, session=self.sessions[rig], kind=Event.COMMAND_LOST, text=text))

    def count(self, rig: str) -> int:
        """Number of messages of a rig published within sessions."""
        return len(self.sent.get(rig, ()))

    def run(self) -> None:
        """Publish until `stopping` is set."""
        lab = self.lab
        with (
            Service("sim", lab, ZenohBus(lab.bus, "sim"), stopping=self.stopping) as sim,
            Service("edge", lab, ZenohBus(lab.bus, "edge"), stopping=self.stopping) as edge,
        ):
            states = {rig: sim.rig_publisher(STATE, rig) for rig in self.rigs}
            commands = {rig: edge.rig_publisher(COMMAND, rig) for rig in self.rigs}
            for rig in self.rigs:
                config = RigConfig(rig=rig, incarnation=sim.incarnation, step_ns=20_000_000, urdf="<robot/>")
                sim.bus.declare_queryable(CONFIG.key(lab.name, rig), partial(self._reply, config.SerializeToString()))
            sim.ready()
            edge.ready()
            rate = Rate(round(self.step_ms * 1e6))
            open_sessions: dict[str, str] = {}
            step = 0
            while not self.stopping.is_set():
                tick = rate.wait()
                step += 1
                self._begin_and_end(edge, open_sessions)
                for number, rig in enumerate(self.rigs):
                    session = open_sessions.get(rig, "")
                    state = JointState(rig=rig, session=session, step=step, sampled_ns=tick.deadline_ns)
                    state.position.extend((step * 1e-3 + number, 0.5, 0.1, 0.2))
                    command = TorqueCommand(rig=rig, session=session, seq=step, effort=(step * 1e-3, 0, 0, 0))
                    states[rig].publish(state)
                    commands[rig].publish(command)
                    if session:
                        self.sent[rig] += [
                            ("/state", step, state.SerializeToString()),
                            ("/command", step, command.SerializeToString()),
                        ]
                while self.events:
                    sim.emit(self.events.pop())
                now_ns = SYSTEM_CLOCK.monotonic_ns()
                sim.beat(now_ns)
                edge.beat(now_ns)

    @staticmethod
    def _reply(config: bytes, _: bytes) -> bytes:
        return config

    def _begin_and_end(self, edge: Service, open_sessions: dict[str, str]) -> None:
        wanted = dict(self.sessions)
        if wanted == open_sessions:
            return
        for rig in self.rigs:
            if open_sessions.get(rig) == wanted.get(rig):
                continue
            for kind, sessions in ((Event.SESSION_END, open_sessions), (Event.SESSION_START, wanted)):
                if rig in sessions:
                    edge.emit(Event(rig=rig, session=sessions[rig], kind=kind))
            self.sent.setdefault(rig, [])
        open_sessions.clear()
        open_sessions.update(wanted)
        edge.recording_stream.set_sessions([OpenSession(rig=rig, session=session) for rig, session in wanted.items()])


@contextmanager
def sending(lab: LabConfig, rigs: list[str], step_ms: float = 20.0) -> Iterator[Senders]:
    """Senders that run in a thread."""
    senders = Senders(lab, rigs, step_ms)
    errors: list[BaseException] = []

    def body() -> None:
        try:
            senders.run()
        except BaseException as error:  # raised in the test's thread
            errors.append(error)

    thread = threading.Thread(target=body)
    thread.start()
    try:
        yield senders
    finally:
        senders.stopping.set()
        thread.join(20)
    assert not thread.is_alive()
    if errors:
        raise errors[0]


@contextmanager
def router() -> Iterator[str]:
    """A zenoh router process; yields its endpoint."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)}"
    command = [sys.executable, str(Path(__file__).with_name("zenoh_router.py")), "--listen", endpoint]
    command.append("--no-multicast-scouting")
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        assert process.stdout.readline().strip() == "ready"
        yield endpoint
    finally:
        process.stdin.close()
        process.wait(LONG_TIMEOUT_S)
        process.stdout.close()


def make_lab(folder: Path, *, rigs: int = 1, extra: str = "") -> tuple[Path, LabConfig]:
    """Write a lab file; returns its path and the configuration."""
    path = write_lab(folder, rigs=rigs, extra=extra)
    return path, load_lab(path)


def wait_ready(lab: LabConfig, recorder: RecorderProcess, instance: str = "*", timeout_s: float = 30.0) -> None:
    """Wait until the recorder announces that it is alive."""
    with ZenohBus(lab.bus, "tool") as bus:

        def ready() -> bool:
            assert recorder.process.poll() is None, recorder.log.read_text()
            return bool(bus.get_liveliness(alive_key(lab.name, "recorder", instance), timeout_s=0.2))

        eventually(ready, timeout_s=timeout_s)


def recorded(paths: list[Path]) -> list[Key]:
    """Every state and command in finished recordings, read with the mcap library; each file must have an index."""
    found: list[Key] = []
    for path in paths:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            assert summary is not None, path
            assert summary.statistics is not None, path
            found += [
                (channel.topic, message.sequence, message.data)
                for _, channel, message in reader.iter_messages(topics=["/state", "/command"])
            ]
    return found


def recorded_events(paths: list[Path], text: str) -> list[Event]:
    """Events with a text in finished recordings."""
    found: list[Event] = []
    for path in paths:
        with path.open("rb") as stream:
            for _, _, message in make_reader(stream).iter_messages(topics=["/event"]):
                event = Event.FromString(message.data)
                if event.text == text:
                    found.append(event)
    return found


def metadata(path: Path) -> dict[str, dict[str, str]]:
    """Metadata of a finished recording, by name."""
    with path.open("rb") as stream:
        return {record.name: record.metadata for record in make_reader(stream).iter_metadata()}


def files_of(lab: LabConfig, rig: str, pattern: str = "*.mcap") -> list[Path]:
    """The files of a rig, in the order of their segment numbers."""
    folder = lab.recorder.folder / lab.name / rig
    return sorted(folder.glob(pattern), key=lambda path: (len(path.name), path.name))


def times(name: str, default: int) -> int:
    """Number of repetitions, from an environment variable or a default."""
    return int(os.environ.get(name, default))


def main() -> None:
    """Run senders as a program: reads `begin`, `end` and `emit RIG` from standard input, then writes the messages."""
    lab, out = load_lab(Path(sys.argv[1])), Path(sys.argv[2])
    with sending(lab, [rig.name for rig in lab.rigs]) as senders:
        for line in sys.stdin:
            action, rig = line.split()
            {"begin": senders.begin, "end": senders.end, "emit": senders.emit}[action](rig)
    out.write_bytes(pickle.dumps(senders.sent))


if __name__ == "__main__":
    main()
