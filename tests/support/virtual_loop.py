"""Recordings of a closed loop in simulated time, in memory: the real plant, a program with known timing and law.

The timing of a program does not depend on the motion, so its polls are planned first; then the plants of many runs step
together, and each poll computes its torques from the registers that it was served.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from hilrig_replay.io.columns import (
    COMMAND_DTYPE,
    CONNECTION_DTYPE,
    PART_DTYPE,
    STATE_DTYPE,
    TRAFFIC_DTYPE,
    Rows,
    StringTable,
)
from hilrig_replay.io.records import EVENT_DTYPE, Records
from hilrig_replay.io.run import Run
from hilrig_replay.io.timebase import Timebase
from hilrig_runtime.config.lab import LabConfig, RigSettings
from hilrig_schemas import Event
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.plant import Plant
from support.recordings import CONTROLLER, EDGE_FROM_WALL_NS, PARAMETERS, REGISTER_SCALE, START_WALL_NS

MS = 1_000_000
SESSION = "20260101T000000Z-rig1-abcd"
SIM_FROM_WALL_NS = 9_000_000_000_000 - START_WALL_NS
BEGIN_NS = 200 * MS
"""Start of the program; before, no command acts."""

Law = Callable[[float, np.ndarray], np.ndarray]
"""Torques, N·m or N, of the time, s, and the positions in the registers, degrees and mm; may keep values of its own."""


@dataclass
class Program:
    """A program and its loop; times in ms."""

    law: Law
    seconds: float = 20.0
    step_ms: float = 20.0
    period_ms: float = 20.0
    """0: the next poll follows at once."""
    deadline: bool = True
    """Whether the period is kept with absolute deadlines; else the program sleeps for `period_ms` after its write."""
    phase_ms: float = 3.0
    compute_ms: float = 0.5
    compute_spread: float = 0.1
    """Standard deviation of the computing time, as a share of it (gamma distribution)."""
    wait_ms: float = 0.0
    """Sleep between reading and writing."""
    write_first: bool = False
    """Whether each cycle writes the result of the cycle before, then reads, then waits."""
    behind: int = 0
    """Polls by which the torques are late: `write(old); old = new`."""
    reads_once: bool = False
    network_ms: float = 0.1
    """One-way network delay."""
    ack_ms: float = 0.0
    """Time that each request waits for a delayed acknowledgment."""
    pauses: Mapping[float, float] = field(default_factory=dict)
    """Pauses of the program after a write: time, s → duration."""
    injected_state_ms: float = 0.0
    injected_command_ms: float = 0.0
    stalls: Mapping[float, float] = field(default_factory=dict)
    """Stalls of the simulation: time, s → duration."""
    edge_stalls: Mapping[float, float] = field(default_factory=dict)
    """Stalls of the edge, which it reports: time, s → duration."""
    starved_share: float = 0.0
    """Part of each stall in which the service is ready to run and has no processor."""
    watchdog_ms: float = 500.0
    start: tuple[float, float, float, float] = (0.0, 0.0, 0.05, 0.0)
    task: str = ""
    """Content of the recorded `lab.toml`."""
    seed: int = 1


class VirtualRun(Run):
    """A run whose messages are in memory."""

    def __init__(self, records: Records, names: StringTable, program: Program) -> None:
        self.records = records
        self.names = names
        self.path = Path("virtual.mcap")
        self.timebase = Timebase()
        counts = {"state": len(records.states), "command": len(records.commands), "event": len(records.events)}
        duration_s = float(records.states["sampled_ns"][-1] - records.states["sampled_ns"][0]) / 1e9
        self.file = SimpleNamespace(  # type: ignore[assignment]
            counts=counts,
            attachments={"lab.toml": program.task.encode()},
            extent=SimpleNamespace(duration_s=duration_s),
        )
        self.metadata = {
            "hilrig.session": {"session": SESSION, "rig": "rig1", "controller": CONTROLLER},
            "hilrig.config": {"step_ns": str(round(program.step_ms * MS)), "parameters_json": PARAMETERS.to_json()},
            "hilrig.summary": {"ended": "session ended", "lost_transport": "0", "lost_recorder": "0"},
        }
        self.timebase.update(records.states)
        self.timebase.update_commands(records.commands)

    def blocks(self, *_: object, **__: object) -> Iterator[Records]:
        yield self.records


def virtual_runs(programs: Sequence[Program]) -> list[VirtualRun]:
    """Run programs that have the same step and duration, all at once."""
    [(_, step_ms)] = {(one.seconds, one.step_ms) for one in programs}
    count = len(programs)
    loops = [_Loop(program) for program in programs]
    parameters = rig_parameters(LabConfig.model_validate({"sim": {"step_ms": step_ms}}), RigSettings())
    plant = Plant([parameters] * count)
    for number, program in enumerate(programs):
        plant.set_state(number, tuple(np.array(program.start) / REGISTER_SCALE), (0.0, 0.0, 0.0, 0.0))
    magnet = np.zeros(count, np.bool_)
    effort = np.zeros((4, count))
    for step in range(min(len(loop.ticks) for loop in loops)):
        for number, loop in enumerate(loops):
            effort[:, number] = loop.tick(step, plant.position[:, number], plant.velocity[:, number])
            loop.states["limit_flags"][step] = plant.limit_flags[number]
        plant.step(effort, magnet)
    return [loop.run(step + 1) for loop in loops]


class _Loop:
    """Plan and record of one run."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.random = np.random.default_rng(program.seed)
        self.ticks = self._plan_ticks()
        self.polls = self._plan_polls()
        self.states = np.zeros(len(self.ticks), STATE_DTYPE)
        self.commands = np.zeros(len(self.polls), COMMAND_DTYPE)
        self.registers = np.zeros((len(self.ticks), 4))
        self.next = 0
        self.torques: list[np.ndarray] = []

    def _plan_ticks(self) -> np.ndarray:
        """Times, lateness and missed steps of the ticks, ns, shape (n, 3)."""
        step_ns, ticks, at_ns = round(self.program.step_ms * MS), [], 0
        stalls = sorted((round(at_s * 1e9), round(ms * MS)) for at_s, ms in self.program.stalls.items())
        while at_ns < self.program.seconds * 1e9:
            late_ns, missed = int(self.random.integers(50_000, 150_000)), 0
            while stalls and stalls[0][0] <= at_ns:
                late_ns += stalls.pop(0)[1]
                missed = late_ns // step_ns
                at_ns += missed * step_ns
                late_ns -= missed * step_ns
            ticks.append((at_ns + late_ns, late_ns, missed))
            at_ns += step_ns
        return np.array(ticks, np.int64)

    def _edge_free(self, at_ns: float) -> float:
        for start_s, stall_ms in self.program.edge_stalls.items():
            if start_s * 1e9 <= at_ns < start_s * 1e9 + stall_ms * MS:
                return start_s * 1e9 + stall_ms * MS
        return at_ns

    def _plan_polls(self) -> np.ndarray:
        """Polls: request, served, write received, sent and arrived at the simulation, ns; row of the basis."""
        program, random = self.program, self.random
        self.at_edge = self.ticks[:, 0] + random.integers(200_000, 300_000, len(self.ticks))
        at_edge = self.at_edge + round(program.injected_state_ms * MS)
        network, ack = program.network_ms * MS, program.ack_ms * MS
        pauses = sorted((at_s * 1e9, ms * MS) for at_s, ms in program.pauses.items())
        polls, at = [], BEGIN_NS + program.phase_ms * MS
        due = at
        served = basis = requested = None
        while at < program.seconds * 1e9 - 60 * MS:
            if not program.write_first and not (program.reads_once and served is not None):
                requested = at + network + ack + self._jitter()
                served = self._edge_free(requested)
                at = served + network
                basis = int(np.searchsorted(at_edge, served, side="right")) - 1
            spread = program.compute_spread
            computed = program.compute_ms * (random.gamma(1 / spread**2, spread**2) if spread else 1.0) * MS
            waited = program.wait_ms * MS + (abs(random.normal(80_000, 40_000)) if program.wait_ms else 0.0)
            at += computed + (0 if program.write_first else waited)
            received = at + network + ack + self._jitter()
            sent = self._edge_free(received) + random.integers(20_000, 60_000)
            if served is not None:
                arrived = sent + program.injected_command_ms * MS + random.integers(150_000, 250_000)
                polls.append((requested, served, received, sent + program.injected_command_ms * MS, arrived, basis))
            at = sent + network
            if program.write_first:
                requested = at + network + ack + self._jitter()
                served = self._edge_free(requested)
                at = served + network
                basis = int(np.searchsorted(at_edge, served, side="right")) - 1
            while pauses and pauses[0][0] <= at:
                at += pauses.pop(0)[1]
                due = at
            overslept = abs(random.normal(80_000, 40_000))
            if program.deadline:
                due += program.period_ms * MS
                at = max(at, due + overslept)
            else:
                at += program.period_ms * MS + overslept
        return np.array(polls, np.float64).astype(np.int64).reshape(-1, 6)

    def _jitter(self) -> float:
        return float(self.random.gamma(2.0, 15_000))

    def _compute(self, poll: int) -> None:
        """Compute the torques of the next poll."""
        served_ns, basis = self.polls[poll, 1], self.polls[poll, 5]
        torque = np.asarray(self.program.law(served_ns / 1e9, self.registers[basis]), np.float64)
        self.torques.append(np.rint(np.clip(torque, -32.767, 32.767) * 1000) / 1000)
        self.commands["effort"][poll] = self.torques[max(poll - self.program.behind, 0)]

    def tick(self, step: int, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Latch the newest command, record the state; return the effort."""
        tick_ns, late_ns, missed = self.ticks[step].tolist()
        state = self.states[step]
        while self.next < len(self.polls) and self.polls[self.next, 4] <= tick_ns:
            self._compute(self.next)
            self.next += 1
        newest = self.next - 1
        state["step"], state["incarnation"], state["sequence"] = step + 1, 7, step + 1
        state["sampled_ns"] = tick_ns + START_WALL_NS + SIM_FROM_WALL_NS
        state["wall_ns"] = state["log_ns"] = tick_ns + START_WALL_NS
        state["lateness_ns"], state["missed_steps"] = late_ns, missed
        stalled_ms = late_ns / MS + missed * self.program.step_ms
        state["run_delay_ns"] = self.program.starved_share * stalled_ms * MS if missed else 0
        state["position"], state["velocity"] = position, velocity
        self.registers[step] = np.rint(position * REGISTER_SCALE * 100) / 100
        if newest < 0:
            return np.zeros(4)
        state["session"], state["command_seq"] = 1, newest + 1
        if tick_ns - self.polls[newest, 4] > self.program.watchdog_ms * MS:
            # The zero torque of the watchdog has no basis.
            state["safe"] = True
            return np.zeros(4)
        effort = self.commands["effort"][newest]
        state["effort"] = effort
        if step and self.states["command_seq"][step - 1] != newest + 1:
            basis = self.polls[newest, 5]
            state["basis_step"] = basis + 1
            state["command_arrived_ns"] = self.polls[newest, 4] + START_WALL_NS + SIM_FROM_WALL_NS
            state["loop_latency_ns"] = tick_ns - self.ticks[basis, 0]
        return np.asarray(effort)

    def run(self, steps: int) -> VirtualRun:
        """Return the recorded run."""
        names = StringTable()
        assert names.code(SESSION) == 1
        controller = names.code(CONTROLLER)
        states, commands, polls = self.states[:steps], self.commands[: self.next], self.polls[: self.next]
        to_edge = START_WALL_NS + EDGE_FROM_WALL_NS
        commands["seq"] = commands["sequence"] = np.arange(1, len(commands) + 1)
        commands["basis_incarnation"], commands["basis_step"] = 7, polls[:, 5] + 1
        commands["state_served_ns"], commands["write_received_ns"] = polls[:, 1] + to_edge, polls[:, 2] + to_edge
        commands["state_arrived_ns"] = self.at_edge[polls[:, 5]] + to_edge
        commands["write_arrived_ns"] = commands["write_received_ns"] + 20_000
        commands["sent_ns"], commands["wall_ns"] = polls[:, 3] + to_edge, polls[:, 3] + START_WALL_NS
        commands["log_ns"] = commands["wall_ns"]
        commands["state_injected_ns"] = round(self.program.injected_state_ms * MS)
        commands["command_injected_ns"] = round(self.program.injected_command_ms * MS)
        commands["session"], commands["controller"] = 1, controller
        traffic = np.zeros(2 * len(polls), TRAFFIC_DTYPE)
        traffic["arrived_ns"] = polls[:, (0, 2)].ravel() + to_edge
        traffic["answered_ns"] = polls[:, (1, 3)].ravel() + to_edge + 15_000
        traffic["wall_ns"] = traffic["arrived_ns"] - EDGE_FROM_WALL_NS
        traffic["function"], traffic["controller"] = np.tile((3, 16), len(polls)), controller
        records = Records(
            states,
            commands,
            self._events(states),
            traffic[np.argsort(traffic["arrived_ns"], kind="stable")],
            np.empty(0, PART_DTYPE),
            np.empty(0, CONNECTION_DTYPE),
        )
        return VirtualRun(records, names, self.program)

    def _events(self, states: Rows) -> Rows:
        events = []
        for at_s, ms in self.program.edge_stalls.items():
            event = Event(kind=Event.OVERRUN, severity=Event.WARNING, source="edge/1", session=SESSION)
            event.wall_ns = round(at_s * 1e9 + ms * MS) + START_WALL_NS
            event.overrun_data.lateness_ns, event.overrun_data.stalls = round(ms * MS), 1
            event.overrun_data.run_delay_ns = round(self.program.starved_share * ms * MS)
            events.append(event)
        change = np.diff(states["safe"].astype(np.int8))
        for row in np.flatnonzero(change).tolist():
            kind = Event.WATCHDOG_TRIP if change[row] > 0 else Event.WATCHDOG_REARM
            event = Event(kind=kind, severity=Event.WARNING, source="edge/1", session=SESSION)
            event.wall_ns = int(states["wall_ns"][row + 1])
            events.append(event)
        rows = [
            (one.wall_ns, 0, Event.Kind.Name(one.kind), Event.Severity.Name(one.severity), "", one.source, one)
            for one in sorted(events, key=lambda one: one.wall_ns)
        ]
        return np.array(rows, EVENT_DTYPE)
