"""Is a recording what the model makes of its efforts? Re-simulation, bit for bit.

A run is read in pieces, and each is cut into stretches that step side by side as if each were a rig of its own: a
rig's numbers do not depend on how many step beside it. A stretch begins at a recorded state and takes from then on
nothing but the recorded efforts and the magnet; its last step must lead to the state at which the next stretch begins,
and the last stretch of a piece goes on in the next one, so that stretch by stretch the whole run is re-simulated. An
hour takes seconds.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Names, Rows
from hilrig_replay.io.run import Run, open_run
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import JOINT_SCALE, RigParameters
from hilrig_sim.plant.plant import Plant
from hilrig_sim.plant.world import NO_PART
from hilrig_sim.platform_fingerprint import machine_name

OTHER_MACHINE_TOLERANCE: Final = 1e-9
"""What another processor's sine may make of a run; rad, m, rad/s, m/s."""
PARTS_TOLERANCE: Final = 1e-9
"""Parts are compared to this, m: where a held part sits on the magnet is not recorded but found from its pose."""
STRETCHES: Final = 64
SHORTEST: Final = 50
"""A stretch is not cut shorter than so many steps without need."""
PIECE: Final = 16_384
"""States that are in memory at once, count."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Verification:
    """What re-simulation found."""

    steps: int
    """Steps that were re-simulated and compared."""
    skipped: int
    """Steps that could not be: around states that are missing from the recording."""
    gaps: int
    """Places where states are missing."""
    exact: bool
    """Position and velocity of every compared state are the recorded ones to the last bit."""
    tolerance: float
    """Deviation that was allowed; rad, m, rad/s, m/s."""
    largest_deviation: tuple[float, float, float, float]
    """Of position, each joint: rad, rad, m, rad."""
    largest_velocity_deviation: tuple[float, float, float, float]
    """Of velocity, each joint: rad/s, rad/s, m/s, rad/s."""
    largest_part_deviation: float
    """Of a part's centre, m."""
    first_diverging_step: int | None
    """First step whose effort does not lead to the state that was recorded next; None: there is none."""
    machine: str
    """Where it was recorded."""

    @property
    def same(self) -> bool:
        """Whether the run is what the model makes of it."""
        return self.first_diverging_step is None and self.steps > 0

    def as_dict(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        return {"same": self.same} | asdict(self)

    def sentence(self) -> str:
        """The finding as a sentence for people."""
        skipped = f" ({self.skipped} more could not be, {self.gaps} gaps)" if self.skipped else ""
        if self.steps == 0:
            return f"nothing could be re-simulated{skipped}"
        head = f"{self.steps} steps re-simulated{skipped}"
        if self.first_diverging_step is not None:
            step = self.first_diverging_step
            return (
                f"{head}; step {step} does not lead to the state recorded for step {step + 1}; largest deviations "
                f"{self._deviations()}"
            )
        if self.exact:
            return f"{head}, bit for bit as recorded"
        return f"{head}, as recorded within {self.tolerance:g}; largest deviations {self._deviations()}"

    def _deviations(self) -> str:
        theta1, theta2, d3, theta4 = np.array(self.largest_deviation) * JOINT_SCALE
        return f"θ1 {theta1:.3g}°, θ2 {theta2:.3g}°, d3 {d3:.3g} mm, θ4 {theta4:.3g}°"


def verify(path: Path, tolerance: float | None = None) -> Verification:
    """Re-simulate a recording.

    Args:
        path: the recording.
        tolerance: deviation of a joint that is allowed; None: 0 where it was recorded on a machine like this one, else
            `OTHER_MACHINE_TOLERANCE`.

    Raises:
        InputError: it is no recording, or it does not say what was simulated.
    """
    run = open_run(path)
    if not run.parameters_json:
        raise InputError(f"{path}: it does not say with which parameters it was simulated, so it can't be verified")
    parameters = RigParameters.from_json(run.parameters_json)
    machine = run.metadata.get("hilrig.config", {}).get("machine", "")
    if tolerance is None:
        tolerance = 0.0 if machine == machine_name() else OTHER_MACHINE_TOLERANCE
    resimulation = _Resimulation(run, parameters, tolerance)
    for block in run.blocks(frozenset({"state"}), rows=PIECE):
        resimulation.add(block.states, block.parts)
    return resimulation.result(machine)


@dataclass(frozen=True, slots=True)
class _Piece:
    """Some of a run's states, row by row."""

    states: Rows
    parts: Rows
    held: Ints
    """Index of the held part in the scene, or `NO_PART`."""
    stated: Ints
    """Row of `parts` at which the state's begin, -1 where it has none."""
    follows: NDArray[np.bool_]
    """Whether a step leads to the next state, shape (states - 1,)."""

    def last(self) -> tuple[Rows, Rows]:
        """The last state, and its parts."""
        own = self.parts["wall_ns"] == self.states["wall_ns"][-1]
        return self.states[-1:].copy(), self.parts[own].copy()


class _Resimulation:
    """One recording piece by piece, and what was found so far."""

    def __init__(self, run: Run, parameters: RigParameters, tolerance: float) -> None:
        self._names = run.names
        self._parameters = parameters
        self._tolerance = tolerance
        events = (block.events for block in run.blocks(frozenset({"event"})))
        self._resets = [int(step) for rows in events for step in rows["step"][rows["kind"] == "RESET"]]
        self._before: tuple[Rows, Rows] | None = None
        self._probe, self._ongoing = Plant([parameters]), Plant([parameters])
        self._goes_on = False
        """Whether a stretch reached the end of the piece before: `_ongoing` is the rig as it left it there."""
        self._gaps = self._verified = self._skipped = 0
        self._exact = True
        self._first: int | None = None
        self._largest, self._largest_velocity, self._largest_part = np.zeros(4), np.zeros(4), 0.0

    def add(self, states: Rows, parts: Rows) -> None:
        """Re-simulate what comes next, its stretches side by side."""
        if self._before is not None:
            states, parts = np.concatenate((self._before[0], states)), np.concatenate((self._before[1], parts))
        piece = self._piece(states, parts)
        self._before = piece.last()
        stretches = self._stretches(piece)
        verified = sum(end - begin for begin, end in stretches)
        self._verified += verified
        self._skipped += int(np.count_nonzero(piece.follows)) - verified
        goes_on = bool(stretches) and stretches[-1][1] == len(states) - 1
        if stretches:
            self._step(piece, stretches, goes_on=goes_on)
        self._goes_on = goes_on

    def result(self, machine: str) -> Verification:
        """What was found in all of it."""
        return Verification(
            steps=self._verified,
            skipped=self._skipped,
            gaps=self._gaps,
            exact=self._exact,
            tolerance=self._tolerance,
            largest_deviation=_four(self._largest),
            largest_velocity_deviation=_four(self._largest_velocity),
            largest_part_deviation=self._largest_part,
            first_diverging_step=self._first,
            machine=machine,
        )

    def _piece(self, states: Rows, parts: Rows) -> _Piece:
        names = [part.name for part in self._parameters.scene.parts]
        follows = np.diff(states["step"].astype(np.int64)) == 1
        follows &= states["incarnation"][1:] == states["incarnation"][:-1]
        self._gaps += int(np.count_nonzero(~follows))
        # A reset puts the rig somewhere else before its state is sent.
        follows &= ~np.isin(states["step"][1:], self._resets)
        held = _indices(states["held_part"], self._names, names)
        return _Piece(states, parts, held, _first_part_rows(states, parts, len(names)), follows)

    def _step(self, piece: _Piece, stretches: Sequence[tuple[int, int]], *, goes_on: bool) -> None:
        plant = Plant([self._parameters] * len(stretches))
        for rig, (begin, _) in enumerate(stretches):
            if begin == 0 and self._goes_on:
                plant.copy_state_from(self._ongoing, [rig], [0])
            else:
                self._place(plant, rig, piece, begin)
        begins, ends = (np.array(column) for column in zip(*stretches, strict=True))
        wrong = len(piece.states)
        for turn in range(int((ends - begins).max())):
            rows = np.minimum(begins + turn, ends - 1)
            plant.step(np.ascontiguousarray(piece.states["effort"][rows].T), piece.states["magnet"][rows])
            going = np.flatnonzero(begins + turn < ends)
            wrong = min(wrong, self._compare(piece, plant, going, rows[going] + 1))
            if goes_on and begins[-1] + turn == ends[-1] - 1:
                self._ongoing.copy_state_from(plant, [0], [len(stretches) - 1])
        if self._first is None and wrong < len(piece.states):
            self._first = int(piece.states["step"][wrong])

    def _compare(self, piece: _Piece, plant: Plant, rigs: Ints, rows: Ints) -> int:
        """What rigs came to against what was recorded; the first row whose step led elsewhere, or one past the last."""
        off = np.abs(plant.position[:, rigs].T - piece.states["position"][rows])
        off_velocity = np.abs(plant.velocity[:, rigs].T - piece.states["velocity"][rows])
        worst = np.maximum(off, off_velocity).max(axis=1)
        self._exact &= not worst.any()
        np.maximum(self._largest, off.max(axis=0), out=self._largest)
        np.maximum(self._largest_velocity, off_velocity.max(axis=0), out=self._largest_velocity)
        off_parts = self._part_deviation(piece, plant, rigs, rows)
        self._largest_part = max(self._largest_part, float(off_parts.max()))
        wrong = ~(worst <= self._tolerance) | ~(off_parts <= PARTS_TOLERANCE)
        return int(rows[wrong].min()) - 1 if wrong.any() else len(piece.states)

    def _stretches(self, piece: _Piece) -> list[tuple[int, int]]:
        """Rows at which stretches begin and end."""
        breaks = [0, *(np.flatnonzero(~piece.follows) + 1).tolist(), len(piece.states)]
        wanted = max(SHORTEST, len(piece.states) // STRETCHES)
        stretches: list[tuple[int, int]] = []
        for low, high in pairwise(breaks):
            going_on = low == 0 and self._goes_on
            begin = 0 if going_on else self._next_begin(piece, low, high, any_held=True)
            while begin is not None:
                end = self._next_begin(piece, begin + wanted, high, any_held=False)
                last = high - 1 if end is None else end
                if last > begin:
                    stretches.append((begin, last))
                begin = end
        return stretches

    def _next_begin(self, piece: _Piece, low: int, high: int, *, any_held: bool) -> int | None:
        """First row from `low` on, before `high`, at which all that the next step depends on is recorded."""
        for offset in np.flatnonzero(piece.stated[low:high] >= 0):
            row = low + int(offset)
            if not any_held and piece.held[row] != NO_PART:
                continue
            self._place(self._probe, 0, piece, row)
            if self._probe.world.at_rest(0):
                return row
        return None

    def _place(self, plant: Plant, rig: int, piece: _Piece, row: int) -> None:
        parts = piece.parts[piece.stated[row] :][: len(self._parameters.scene.parts)]
        poses = list(zip(*(parts[name].tolist() for name in ("x", "y", "z", "yaw")), strict=True))
        state = piece.states[row]
        plant.set_state(rig, state["position"], state["velocity"], poses, int(piece.held[row]))

    def _part_deviation(self, piece: _Piece, plant: Plant, rigs: Ints, rows: Ints) -> Floats:
        """Largest distance of a part from where it was recorded, m, infinite where another part is held, (K,)."""
        world = plant.world
        off = np.where(world.held[rigs] == piece.held[rows], 0.0, np.inf)
        stated = np.flatnonzero(piece.stated[rows] >= 0)
        count = len(self._parameters.scene.parts)
        if stated.size and count:
            recorded = piece.parts[piece.stated[rows[stated]][:, np.newaxis] + np.arange(count)]
            for name, simulated in (("x", world.x), ("y", world.y), ("z", world.z)):
                distance = np.abs(simulated[:count, rigs[stated]].T - recorded[name]).max(axis=1)
                off[stated] = np.maximum(off[stated], distance)
        return off


def _indices(codes: Rows, names: Names, parts: Sequence[str]) -> Ints:
    """Index of the held part in the scene, or `NO_PART`, of each state."""
    index_of = {part: index for index, part in enumerate(parts)}
    found = np.full(len(codes), NO_PART, dtype=np.int64)
    for code in np.unique(codes):
        found[codes == code] = index_of.get(names[code], NO_PART)
    return found


def _first_part_rows(states: Rows, parts: Rows, count: int) -> Ints:
    """Row of `parts` at which each state's begin, -1 where a state has none; with no parts at all, 0 everywhere."""
    if count == 0:
        return np.zeros(len(states), dtype=np.int64)
    found = np.full(len(states), -1, dtype=np.int64)
    # Stated together and in the scene's order, so that each state's are `count` rows; a run of a restarted simulation
    # has the same step twice, and the time tells which is which.
    begins = np.arange(0, len(parts) - count + 1, count)
    row_of = {wall_ns: row for row, wall_ns in enumerate(states["wall_ns"].tolist())}
    for begin, wall_ns in zip(begins.tolist(), parts["wall_ns"][begins].tolist(), strict=True):
        row = row_of.get(wall_ns)
        if row is not None:
            found[row] = begin
    return found


def _four(values: Floats) -> tuple[float, float, float, float]:
    first, second, third, fourth = values.tolist()
    return first, second, third, fourth
