"""Verification of a recording: re-simulates it from the recorded efforts and compares the states bit for bit.

A run is read in blocks. Each block is split into intervals that are simulated in parallel, as if each were a separate
rig: the results of a rig do not depend on the number of rigs. An interval starts at a recorded state and then uses only
the recorded efforts and the magnet. Its last step must lead to the first state of the next interval, and the last
interval of a block continues in the next block, so the complete run is re-simulated. An hour takes seconds.

Every published field that the simulation computes is compared, effort and magnet of each state with its command, and
the times of its ticks with each other.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import JointValues, Rows, StringTable, joint_values
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.io.segments import RunFiles
from hilrig_runtime.errors import InputError
from hilrig_schemas import Event
from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_sim.arm.model import LARGEST_EFFORT, RigParameters
from hilrig_sim.plant.plant import Plant
from hilrig_sim.plant.world import NO_PART
from hilrig_sim.platform_fingerprint import machine_name

OTHER_PLATFORM_TOLERANCE: Final = 1e-9
"""Tolerance for a run of another platform, whose sine function can differ; rad, m, rad/s, m/s."""
PARTS_TOLERANCE: Final = 1e-9
"""Tolerance for parts, m: the offset of a held part from the magnet is not recorded, but computed from its pose."""
MAX_INTERVALS: Final = 64
"""Intervals per block without gaps."""
MIN_INTERVAL_STEPS: Final = 50
"""Minimum number of steps per interval, unless a gap ends it earlier."""
BLOCK_STATES: Final = 16_384
"""Number of states in memory."""

COMMAND_WINDOW_ROWS: Final = 1024
"""States and commands of previous blocks that are searched for a match."""
TIME_WINDOW_ROWS: Final = 8192
"""States of previous blocks that can be the basis of a loop latency, as many as the simulation remembers."""
_DRIVE: Final = np.dtype([("key", "<u8"), ("effort", "<f8", (4,)), ("magnet", "?")])
_TICK_FIELDS: Final = [
    "incarnation",
    "step",
    "sampled_ns",
    "lateness_ns",
    "missed_steps",
    "basis_step",
    "loop_latency_ns",
]
_OPTIONAL_FIELDS: Final = ("integration error", "sub-steps", "velocity of the parts")
_EFFORT_RANGE: Final = (-LARGEST_EFFORT, LARGEST_EFFORT)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of a re-simulation."""

    steps: int
    """Number of steps that were re-simulated and compared."""
    skipped: int
    """Number of steps that could not be re-simulated, because states around them are missing in the recording."""
    gaps: int
    """Number of gaps in the recorded states."""
    exact: bool
    """All compared fields are bit-identical to the recording."""
    tolerance: float
    """Allowed deviation; rad, m, rad/s, m/s."""
    largest_deviation: JointValues
    """Largest position deviation of each joint; rad, rad, m, rad."""
    largest_velocity_deviation: JointValues
    """Largest velocity deviation of each joint; rad/s, rad/s, m/s, rad/s."""
    largest_part_deviation: float
    """Largest deviation of the center of a part, m."""
    first_diverging_step: int | None
    """First step whose effort does not lead to the next recorded state; None: no divergence."""
    differing: dict[str, int]
    """Number of states with a deviation beyond the tolerance, by field; without the fields that agree."""
    not_checked: tuple[str, ...]
    """Fields that the recording lacks."""
    machine: str
    """Platform on which the run was recorded."""

    @property
    def same(self) -> bool:
        """Whether the re-simulation reproduces the recorded states."""
        return self.first_diverging_step is None and not self.differing and self.steps > 0

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"same": self.same} | asdict(self)

    def sentence(self) -> str:
        """The result as a human-readable sentence."""
        since = f"the start, a reset or one of {self.gaps} gaps" if self.gaps else "the start or a reset"
        skipped = f" ({self.skipped} more skipped: no state with all parts since {since})" if self.skipped else ""
        if self.steps == 0:
            return f"no step could be re-simulated{skipped}"
        missing = f"; not in the recording, not checked: {', '.join(self.not_checked)}" if self.not_checked else ""
        return self._result(f"{self.steps} steps re-simulated{skipped}") + missing

    def _result(self, head: str) -> str:
        fields = ", ".join(
            f"{name} ({count} {'state' if count == 1 else 'states'})" for name, count in self.differing.items()
        )
        if self.first_diverging_step is None and fields:
            return f"{head}; differing from the recording: {fields}"
        if self.first_diverging_step is not None:
            step = self.first_diverging_step
            return (
                f"{head}; step {step} does not lead to the recorded state of step {step + 1}; largest deviations "
                f"{self._deviations()}; differing fields: {fields}"
            )
        if self.exact:
            return f"{head}, bit-identical to the recording"
        return f"{head}, equal to the recording within {self.tolerance:g}; largest deviations {self._deviations()}"

    def _deviations(self) -> str:
        theta1, theta2, d3, theta4 = np.array(self.largest_deviation) * JOINT_SCALE
        return f"θ1 {theta1:.3g}°, θ2 {theta2:.3g}°, d3 {d3:.3g} mm, θ4 {theta4:.3g}°"


def verify(files: Path | RunFiles, tolerance: float | None = None) -> Verification:
    """Re-simulate a recording and compare it with the recorded states.

    Args:
        files: the recording, or the segments of a session.
        tolerance: allowed deviation of a joint; None: 0 if the run was recorded on the same platform as this one, else
            `OTHER_PLATFORM_TOLERANCE`.

    Raises:
        InputError: the file is not a recording, or it does not contain the parameters of the simulation.
    """
    run = open_run(files)
    if not run.parameters_json:
        raise InputError(
            f"{run.path}: can't be verified: the recording does not contain the parameters of the simulation"
        )
    parameters = RigParameters.from_json(run.parameters_json)
    machine = run.metadata.get("hilrig.config", {}).get("machine", "")
    if tolerance is None:
        tolerance = 0.0 if machine == machine_name() else OTHER_PLATFORM_TOLERANCE
    resimulation = _Resimulation(run, parameters, tolerance)
    for block in run.blocks(frozenset({"state", "command"}), rows=BLOCK_STATES):
        resimulation.check_commands(block.states, block.commands)
        resimulation.check_times(block.states)
        if len(block.states):
            resimulation.add(block.states, block.parts)
    return resimulation.result(machine)


@dataclass(frozen=True, slots=True)
class _Block:
    """A block of states of a run."""

    states: Rows
    parts: Rows
    held: Ints
    """Index of the held part in the scene, or `NO_PART`."""
    first_part: Ints
    """Row of `parts` with the first part of each state, -1 if the state contains no parts."""
    follows: NDArray[np.bool_]
    """Whether the next state is the next step of the same simulation, shape (states - 1,)."""

    def last(self) -> tuple[Rows, Rows]:
        """The last state and its parts."""
        own = self.parts["wall_ns"] == self.states["wall_ns"][-1]
        return self.states[-1:].copy(), self.parts[own].copy()


class _Resimulation:
    """Re-simulates a recording block by block and accumulates the result."""

    def __init__(self, run: Run, parameters: RigParameters, tolerance: float) -> None:
        self._names = run.names
        self._parameters = parameters
        self._tolerance = tolerance
        events = (block.events for block in run.blocks(frozenset({"event"})))
        self._resets = [
            int(step) for rows in events for step in rows["step"][rows["kind"] == Event.Kind.Name(Event.RESET)]
        ]
        self._before: tuple[Rows, Rows] | None = None
        self._probe, self._unfinished = Plant([parameters]), Plant([parameters])
        self._continues = False
        """Whether an interval reached the end of the previous block: `_unfinished` is its rig at this point."""
        self._gaps = self._verified = self._skipped = 0
        self._exact = True
        self._first: int | None = None
        self._largest, self._largest_velocity, self._largest_part = np.zeros(4), np.zeros(4), 0.0
        self._differing: Counter[str] = Counter()
        self._recorded: set[str] = set()
        """Optional fields that the recording contains."""
        self._commands = _CommandCheck()
        self._times = _TimeCheck(parameters.sim.step_ns)

    def check_commands(self, states: Rows, commands: Rows) -> None:
        """Compare the next block of commands with the states at which they act."""
        self._differing["effort or magnet of the command"] += self._commands.add(states, commands)

    def check_times(self, states: Rows) -> None:
        """Compare the tick times and loop latencies of the next block with each other."""
        self._differing.update(self._times.add(states))

    def add(self, states: Rows, parts: Rows) -> None:
        """Re-simulate the next block."""
        if self._before is not None:
            states, parts = np.concatenate((self._before[0], states)), np.concatenate((self._before[1], parts))
        block = self._block(states, parts)
        self._before = block.last()
        intervals = self._intervals(block)
        verified = sum(end - begin for begin, end in intervals)
        self._verified += verified
        self._skipped += int(np.count_nonzero(block.follows)) - verified
        continues = bool(intervals) and intervals[-1][1] == len(states) - 1
        if intervals:
            self._step(block, intervals, continues=continues)
        self._continues = continues

    def result(self, machine: str) -> Verification:
        """Result of all blocks."""
        return Verification(
            steps=self._verified,
            skipped=self._skipped,
            gaps=self._gaps,
            exact=self._exact,
            tolerance=self._tolerance,
            largest_deviation=joint_values(self._largest),
            largest_velocity_deviation=joint_values(self._largest_velocity),
            largest_part_deviation=self._largest_part,
            first_diverging_step=self._first,
            differing={name: count for name, count in self._differing.items() if count},
            not_checked=tuple(name for name in _OPTIONAL_FIELDS if name not in self._recorded),
            machine=machine,
        )

    def _block(self, states: Rows, parts: Rows) -> _Block:
        names = [part.name for part in self._parameters.scene.parts]
        follows = np.diff(states["step"].astype(np.int64)) == 1
        follows &= states["incarnation"][1:] == states["incarnation"][:-1]
        self._gaps += int(np.count_nonzero(~follows))
        # A reset changes the state of the rig before it is published.
        follows &= ~np.isin(states["step"][1:], self._resets)
        held = _indices(states["held_part"], self._names, names)
        return _Block(states, parts, held, _first_part_rows(states, parts, len(names)), follows)

    def _step(self, block: _Block, intervals: Sequence[tuple[int, int]], *, continues: bool) -> None:
        plant = Plant([self._parameters] * len(intervals))
        for rig, (begin, _) in enumerate(intervals):
            if begin == 0 and self._continues:
                plant.copy_state_from(self._unfinished, [rig], [0])
            else:
                self._place(plant, rig, block, begin)
        begins, ends = (np.array(column) for column in zip(*intervals, strict=True))
        diverging = len(block.states)
        for step in range(int((ends - begins).max())):
            rows = np.minimum(begins + step, ends - 1)
            plant.step(np.ascontiguousarray(block.states["effort"][rows].T), block.states["magnet"][rows])
            active = np.flatnonzero(begins + step < ends)
            diverging = min(diverging, self._compare(block, plant, active, rows[active] + 1))
            if continues and begins[-1] + step == ends[-1] - 1:
                self._unfinished.copy_state_from(plant, [0], [len(intervals) - 1])
        if self._first is None and diverging < len(block.states):
            self._first = int(block.states["step"][diverging])

    def _compare(self, block: _Block, plant: Plant, rigs: Ints, rows: Ints) -> int:
        """Compare the states of rigs with recorded rows; returns the first row that diverges, or the number of rows."""
        states, arm = block.states[rows], self._parameters.arm
        position: Floats = states["position"]
        velocity: Floats = states["velocity"]
        off = np.abs(plant.position[:, rigs].T - position)
        off_velocity = np.abs(plant.velocity[:, rigs].T - velocity)
        np.maximum(self._largest, off.max(axis=0), out=self._largest)
        np.maximum(self._largest_velocity, off_velocity.max(axis=0), out=self._largest_velocity)
        off_parts = self._part_deviation(block, plant, rigs, rows)
        self._largest_part = max(self._largest_part, float(off_parts.max()))
        wrench = np.stack([states["external_force_z"], states["external_torque_z"]], axis=1)
        off_wrench = np.abs(wrench - (arm.external_force_z, arm.external_torque_z))
        deviations = {
            "position": (off, self._tolerance),
            "velocity": (off_velocity, self._tolerance),
            "parts": (off_parts[:, np.newaxis], PARTS_TOLERANCE),
            "limit flags": (np.array(plant.limit_flags)[rigs, np.newaxis] != states["limit_flags"][:, np.newaxis], 0.0),
            "external wrench": (off_wrench, 0.0),
        }
        if states["integration_error"].any():
            self._recorded.add("integration error")
        if "integration error" in self._recorded:
            error: Floats = states["integration_error"]
            off_error = np.abs(plant.error[:, rigs].T - error)
            deviations["integration error"] = (off_error, self._tolerance)
        if states["substeps"].any():
            self._recorded.add("sub-steps")
        if "sub-steps" in self._recorded:
            deviations["sub-steps"] = (plant.substeps[rigs, np.newaxis] != states["substeps"][:, np.newaxis], 0.0)
        diverging = np.zeros(len(rows), dtype=np.bool_)
        for name, (deviation, tolerance) in deviations.items():
            worst = deviation.max(axis=1)
            if name != "parts":
                self._exact &= not worst.any()
            differs = ~(worst <= tolerance)
            self._differing[name] += int(np.count_nonzero(differs))
            diverging |= differs
        return int(rows[diverging].min()) - 1 if diverging.any() else len(block.states)

    def _intervals(self, block: _Block) -> list[tuple[int, int]]:
        """First and last row of each interval."""
        breaks = [0, *(np.flatnonzero(~block.follows) + 1).tolist(), len(block.states)]
        length = max(MIN_INTERVAL_STEPS, len(block.states) // MAX_INTERVALS)
        intervals: list[tuple[int, int]] = []
        for low, high in pairwise(breaks):
            continued = low == 0 and self._continues
            begin = 0 if continued else self._next_begin(block, low, high, any_held=True)
            while begin is not None:
                end = self._next_begin(block, begin + length, high, any_held=False)
                last = high - 1 if end is None else end
                if last > begin:
                    intervals.append((begin, last))
                begin = end
        return intervals

    def _next_begin(self, block: _Block, low: int, high: int, *, any_held: bool) -> int | None:
        """First row in [`low`, `high`) that contains everything that the next step depends on."""
        for offset in np.flatnonzero(block.first_part[low:high] >= 0):
            row = low + int(offset)
            if not any_held and block.held[row] != NO_PART:
                continue
            self._place(self._probe, 0, block, row)
            if self._probe.world.at_rest(0):
                return row
        return None

    def _place(self, plant: Plant, rig: int, block: _Block, row: int) -> None:
        parts = block.parts[block.first_part[row] :][: len(self._parameters.scene.parts)]
        columns = [parts[name].tolist() for name in ("x", "y", "z", "yaw")]
        poses = list(zip(*columns, strict=True))
        state = block.states[row]
        plant.set_state(rig, state["position"], state["velocity"], poses, int(block.held[row]))

    def _part_deviation(self, block: _Block, plant: Plant, rigs: Ints, rows: Ints) -> Floats:
        """Largest deviation of a part from the recording, m, m/s or rad, (rigs,); infinite if another part is held."""
        world = plant.world
        off = np.where(world.held[rigs] == block.held[rows], 0.0, np.inf)
        has_parts = np.flatnonzero(block.first_part[rows] >= 0)
        count = len(self._parameters.scene.parts)
        if has_parts.size and count:
            recorded = block.parts[block.first_part[rows[has_parts]][:, np.newaxis] + np.arange(count)]
            compared = {"x": world.x, "y": world.y, "z": world.z, "yaw": world.yaw}
            if self._parameters.sim.plant_version > 1:
                self._recorded.add("velocity of the parts")
                compared |= dict(zip(("vx", "vy", "vz"), world.velocity, strict=True))
            for name, simulated in compared.items():
                distance = np.abs(simulated[:count, rigs[has_parts]].T - recorded[name]).max(axis=1)
                off[has_parts] = np.maximum(off[has_parts], distance)
        return off


class _CommandCheck:
    """Compares the effort and magnet of each command with those of the state at which it first acts."""

    def __init__(self) -> None:
        self._applied = np.empty(0, _DRIVE)
        self._waiting = np.empty(0, _DRIVE)

    def add(self, states: Rows, commands: Rows) -> int:
        """Add a block; return the number of commands that differ from their state. A command may never act.

        States with an effort although their commands have timed out count, too.
        """
        commanded, safe = states["command_seq"] > 0, states["safe"]
        acting = states[commanded & ~safe]
        differing = int(np.count_nonzero(safe & states["effort"].any(axis=1)))
        applied = np.concatenate((self._applied, _drives(acting, acting["command_seq"])))
        # The first state of each command.
        applied = applied[np.sort(np.unique(applied["key"], return_index=True)[1])]
        waiting = np.concatenate((self._waiting, _drives(commands, commands["seq"])))
        order = np.argsort(applied["key"], kind="stable")
        found = np.zeros(len(waiting), dtype=np.bool_)
        if len(applied):
            places = np.searchsorted(applied["key"][order], waiting["key"])
            rows = order[np.minimum(places, len(order) - 1)]
            found = applied["key"][rows] == waiting["key"]
            sent, acts = waiting[found], applied[rows[found]]
            effort = np.clip(np.nan_to_num(sent["effort"], posinf=np.inf, neginf=-np.inf), *_EFFORT_RANGE)
            differs = (effort != acts["effort"]).any(axis=1) | (sent["magnet"] != acts["magnet"])
            differing += int(np.count_nonzero(differs))
        self._applied = applied[-COMMAND_WINDOW_ROWS:].copy()
        self._waiting = waiting[~found][-COMMAND_WINDOW_ROWS:].copy()
        return differing


class _TimeCheck:
    """Compares each loop latency with the tick of its basis, and the deadline of each tick with the previous one."""

    def __init__(self, step_ns: int) -> None:
        self._step_ns = step_ns
        self._recent: Rows | None = None

    def add(self, states: Rows) -> dict[str, int]:
        """Add a block; return the number of states that differ, by field."""
        own = states[_TICK_FIELDS]
        ticks = own if self._recent is None else np.concatenate((self._recent, own))
        is_new = np.arange(len(ticks)) >= len(ticks) - len(own)
        self._recent = ticks[-TIME_WINDOW_ROWS:].copy()
        expected_ns, off_grid = np.where(ticks["basis_step"] > 0, -1, 0), np.zeros(len(ticks), dtype=np.bool_)
        for incarnation in np.unique(ticks["incarnation"]):
            rows = np.flatnonzero(ticks["incarnation"] == incarnation)
            # A step that occurs twice is an error of the file, which other checks report.
            rows = rows[np.unique(ticks["step"][rows], return_index=True)[1]]
            step, sampled_ns = ticks["step"][rows].astype(np.int64), ticks["sampled_ns"][rows]
            basis = ticks["basis_step"][rows].astype(np.int64)
            place = np.minimum(np.searchsorted(step, basis), len(rows) - 1)
            known = step[place] == basis
            expected_ns[rows[known]] = (sampled_ns - sampled_ns[place])[known]
            lateness_ns = ticks["lateness_ns"][rows]
            deadline_ns = sampled_ns - lateness_ns
            periods = 1 + ticks["missed_steps"][rows][1:].astype(np.int64)
            off_grid[rows[1:]] = (np.diff(step) == 1) & (np.diff(deadline_ns) != periods * self._step_ns)
        wrong = (expected_ns >= 0) & (ticks["loop_latency_ns"] != expected_ns)
        return {"loop latency": int((wrong & is_new).sum()), "tick time": int((off_grid & is_new).sum())}


def _drives(rows: Rows, seq: NDArray[Any]) -> NDArray[np.void]:
    drives = np.empty(len(rows), _DRIVE)
    # A session code has 16 bits, a sequence number less than 48.
    drives["key"] = (rows["session"].astype(np.uint64) << np.uint64(48)) | seq
    drives["effort"], drives["magnet"] = rows["effort"], rows["magnet"]
    return drives


def _indices(codes: Rows, names: StringTable, parts: Sequence[str]) -> Ints:
    """Index of the part that is held in each state, or `NO_PART`."""
    index_of = {part: index for index, part in enumerate(parts)}
    found = np.full(len(codes), NO_PART, dtype=np.int64)
    for code in np.unique(codes):
        found[codes == code] = index_of.get(names[code], NO_PART)
    return found


def _first_part_rows(states: Rows, parts: Rows, count: int) -> Ints:
    """Row of `parts` with the first part of each state, -1 if the state contains none; 0 if the scene has no parts."""
    if count == 0:
        return np.zeros(len(states), dtype=np.int64)
    found = np.full(len(states), -1, dtype=np.int64)
    # The parts of a state are `count` consecutive rows in the order of the scene. After a restart of the simulation a
    # step number can occur twice, so states are identified by their time.
    begins = np.arange(0, len(parts) - count + 1, count)
    row_of = {wall_ns: row for row, wall_ns in enumerate(states["wall_ns"].tolist())}
    for begin, wall_ns in zip(begins.tolist(), parts["wall_ns"][begins].tolist(), strict=True):
        row = row_of.get(wall_ns)
        if row is not None:
            found[row] = begin
    return found
