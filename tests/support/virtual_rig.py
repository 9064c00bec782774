"""Simulation service in simulated time: real ticks, commands, states and events, with a manual clock and no sockets."""

import importlib.util
import sys
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Self

import numpy as np

from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import ManualClock
from hilrig_runtime.timing.rate import Rate
from hilrig_schemas import Event, JointState, RigBatch, TorqueCommand
from hilrig_schemas.topics import COMMANDS, EVENT, STATE
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from support.recordings import TimedMessage

REGISTERS = np.array([18000 / np.pi, 18000 / np.pi, 100_000.0, 18000 / np.pi])
"""Factors from rad and m to the position registers."""


class VirtualRig:
    """Simulation of a lab; `states` and `events` have everything that it has published."""

    def __init__(self, lab: LabConfig | None = None) -> None:
        self.lab = lab or LabConfig()
        hub = MemoryHub()
        self.clock = ManualClock()
        self.service = Service("sim", self.lab, MemoryBus(hub), clock=self.clock)
        self.parameters = [rig_parameters(self.lab, rig) for rig in self.lab.rigs]
        self.simulation = Simulation(self.service, self.parameters)
        self.states: list[JointState] = []
        self.events: list[Event] = []
        witness = MemoryBus(hub)
        witness.subscribe(STATE.key(self.lab.name, "*"), lambda _, payload: self.states.append(STATE.decode(payload)))
        witness.subscribe(EVENT.key(self.lab.name, "*"), lambda _, payload: self.events.append(EVENT.decode(payload)))
        self._commands = witness.publisher(COMMANDS.key(self.lab.name, "edge", "1"), COMMANDS.traffic)
        self._rate = Rate(self.lab.sim.step_ns, self.clock)
        self._seq = 0

    def tick(self, count: int = 1) -> JointState:
        """Simulate steps; return the last published state."""
        for _ in range(count):
            self.simulation.pre_encode(self._rate.next_ns)
            self.simulation.tick(self._rate.wait())
        return self.states[-1]

    def command(
        self,
        effort: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0, 0.0),
        *,
        magnet: bool = False,
        basis_step: int = 0,
        basis_incarnation: int | None = None,
        resets: int = 0,
        repeat: bool = False,
        session: str = "session",
        rig: str = "rig1",
    ) -> None:
        """Publish a command; with `repeat` it has the number of the previous one."""
        self._seq += not repeat
        command = TorqueCommand(
            rig=rig,
            session=session,
            seq=self._seq,
            effort=effort,
            magnet=magnet,
            basis_step=basis_step,
            basis_incarnation=self.service.incarnation if basis_incarnation is None else basis_incarnation,
            resets=resets,
        )
        self.send(command.SerializeToString(), rig)

    def send(self, payload: bytes, rig: str = "rig1") -> None:
        """Publish arbitrary bytes as the command of a rig."""
        self._commands.put(RigBatch(source="edge/1", rigs=[rig], messages=[payload]).SerializeToString())

    def kinds(self) -> list[str]:
        """Kinds of the events so far."""
        return [Event.Kind.Name(event.kind) for event in self.events]

    def recorded(self) -> list[TimedMessage]:
        """Return everything that was published, in the format of `recordings.write`."""
        made = [TimedMessage("state", state.wall_ns, state) for state in self.states]
        made += [TimedMessage("event", event.wall_ns, event) for event in self.events]
        return sorted(made, key=lambda one: one.publish_wall_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.service.close()


def pick_and_place() -> ModuleType:
    """Return the example controller as a module."""
    path = Path(__file__).parents[2] / "examples" / "pick_and_place.py"
    spec = importlib.util.spec_from_file_location("pick_and_place", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module there.
    sys.modules["pick_and_place"] = module
    spec.loader.exec_module(module)
    return module


def run_controller(
    rig: VirtualRig, seconds: float, *, state_delay_ms: int = 0, command_delay_ms: int = 0
) -> float | None:
    """Run the example controller with int16 registers, twice per step; return when it was done, s, or None.

    The delays are added to the step that a loop through the rig takes.
    """
    example = pick_and_place()
    controller = example.Controller(example.task_of({}))
    half_ns = rig.lab.sim.step_ns // 2
    seen: deque[tuple[int, np.ndarray]] = deque()
    coming: deque[tuple[int, np.ndarray, bool]] = deque()
    registers = None
    done_s = None
    for _ in range(round(seconds * 1e9 / rig.lab.sim.step_ns)):
        while coming and coming[0][0] <= rig.clock.monotonic_ns() + half_ns * 2:
            _, effort, magnet = coming.popleft()
            rig.command(effort, magnet=magnet)
        state = rig.tick()
        now_ns = rig.clock.monotonic_ns()
        seen.append((now_ns + state_delay_ms * 1_000_000, np.rint(np.array(state.position) * REGISTERS)))
        for half in (0, 1):
            at_ns = now_ns + half * half_ns + 1_000_000
            while seen and seen[0][0] <= at_ns:
                registers = seen.popleft()[1]
            if registers is None:
                continue
            effort = np.rint(controller.update(at_ns / 1e9, registers / REGISTERS) * 1000) / 1000
            coming.append((at_ns + command_delay_ms * 1_000_000, effort, controller.magnet))
        if controller.done and done_s is None:
            done_s = len(rig.states) * rig.lab.sim.step_ms / 1e3
    return done_s


class RemoteRig:
    """A rig behind a slow network, in simulated time; the controller waits for each response.

    It replaces the example's `Rig` and its `time`: only requests and sleeping advance the time. With probability
    `stalls` per one-way transfer, the controller, the rig, or both stall for 50 to 100 ms.
    """

    def __init__(self, rig: VirtualRig, one_way_ms: float, seed: int, *, stalls: float = 0.0) -> None:
        self._rig = rig
        self._one_way_ms = one_way_ms
        self._stalls = stalls
        self._random = np.random.default_rng(seed)
        self._step_ms = rig.lab.sim.step_ms
        self._now_ms = self._next_ms = 0.0
        self._effort, self._magnet = np.zeros(4), False
        self._pass(float(self._random.uniform(0, self._step_ms)))

    def _pass(self, duration_ms: float) -> None:
        self._now_ms += duration_ms
        while self._next_ms <= self._now_ms:
            self._rig.tick()
            self._next_ms += self._step_ms

    def _transfer(self) -> None:
        self._pass(self._one_way_ms + 0.1 + self._random.exponential(0.5))
        if self._random.random() < self._stalls:
            stall_ms = float(self._random.uniform(50, 100))
            rig, controller = ((True, False), (False, True), (True, True))[self._random.integers(3)]
            if rig:
                # The missed ticks are skipped.
                missed = int(np.ceil(stall_ms / self._step_ms))
                self._rig.clock.advance(round(missed * self._step_ms * 1e6))
                self._next_ms += missed * self._step_ms
            if controller:
                self._pass(stall_ms)

    def _command(self) -> None:
        self._rig.command(self._effort, magnet=self._magnet)

    def read(self) -> np.ndarray:
        self._transfer()
        position = np.rint(np.array(self._rig.states[-1].position) * REGISTERS) / REGISTERS
        self._transfer()
        return position

    def write(self, effort: np.ndarray) -> None:
        self._transfer()
        self._effort = np.rint(effort * 1000) / 1000
        self._command()
        self._transfer()

    def exchange(self, effort: np.ndarray) -> np.ndarray:
        self._transfer()
        self._effort = np.rint(effort * 1000) / 1000
        self._command()
        position = np.rint(np.array(self._rig.states[-1].position) * REGISTERS) / REGISTERS
        self._transfer()
        return position

    def switch(self, magnet: bool) -> None:
        self._transfer()
        self._magnet = magnet
        self._command()
        self._transfer()

    def monotonic(self) -> float:
        return self._now_ms / 1000

    def sleep(self, duration_s: float) -> None:
        self._pass(duration_s * 1000)
