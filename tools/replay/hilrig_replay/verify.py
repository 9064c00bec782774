"""Is a recording what the model makes of its efforts? Re-simulation, bit for bit.

A run is cut into stretches that step side by side as if each were a rig of its own: a rig's numbers do not depend on
how many step beside it. A stretch begins at a recorded state and takes from then on nothing but the recorded efforts
and the magnet; its last step must lead to the state at which the next stretch begins, so that stretch by stretch the
whole run is re-simulated. An hour takes seconds.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.columns import Names, Rows
from hilrig_replay.run import Run, open_run
from hilrig_runtime.errors import InputError
from hilrig_sim.machine import machine_name
from hilrig_sim.model import RigParameters
from hilrig_sim.plant import Plant
from hilrig_sim.world import NONE

OTHER_MACHINE_TOLERANCE: Final = 1e-9
"""What another processor's sine may make of a run; rad, m, rad/s, m/s."""
PARTS_TOLERANCE: Final = 1e-9
"""Parts are compared to this, m: where a held part sits on the magnet is not recorded but found from its pose."""
STRETCHES: Final = 64
SHORTEST: Final = 50
"""A stretch is not cut shorter than so many steps without need."""

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
        theta1, theta2, d3, theta4 = np.array(self.largest_deviation) * [
            57.29577951308232,
            57.29577951308232,
            1e3,
            57.29577951308232,
        ]
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
    return _Resimulation(run, parameters, tolerance).run(machine)


class _Resimulation:
    """One recording, its stretches, and what was found so far."""

    def __init__(self, run: Run, parameters: RigParameters, tolerance: float) -> None:
        states, events = run.states, run.events
        self._parameters = parameters
        self._tolerance = tolerance
        self._steps = states["step"].astype(np.int64)
        self._position, self._velocity = states["position"], states["velocity"]
        self._effort, self._magnet = states["effort"], states["magnet"]
        names = [part.name for part in parameters.scene.parts]
        self._held = _indices(states["held_part"], run.names, names)
        self._parts = run.parts
        self._stated = _first_part_rows(states, run.parts, len(names))
        resets = np.array([row["step"] for row in events if row["kind"] == "RESET"], dtype=np.int64)
        follows = np.diff(self._steps) == 1
        follows &= states["incarnation"][1:] == states["incarnation"][:-1]
        self._gaps = int(np.count_nonzero(~follows))
        # A reset puts the rig somewhere else before its state is sent.
        follows &= ~np.isin(self._steps[1:], resets)
        self._follows = follows

    def run(self, machine: str) -> Verification:
        """Re-simulate all stretches side by side."""
        stretches, plant = self._stretches()
        verified = sum(end - begin for begin, end in stretches)
        skipped = int(np.count_nonzero(self._follows)) - verified
        largest, largest_velocity, largest_part = np.zeros(4), np.zeros(4), 0.0
        exact, first = True, len(self._steps)
        if plant is not None:
            begins, ends = (np.array(column) for column in zip(*stretches, strict=True))
            for turn in range(int((ends - begins).max())):
                rows = np.minimum(begins + turn, ends - 1)
                plant.step(np.ascontiguousarray(self._effort[rows].T), self._magnet[rows])
                going = np.flatnonzero(begins + turn < ends)
                following = rows[going] + 1
                position, velocity = plant.position[:, going].T, plant.velocity[:, going].T
                off, off_velocity = (
                    np.abs(position - self._position[following]),
                    np.abs(velocity - self._velocity[following]),
                )
                worst = np.maximum(off, off_velocity).max(axis=1)
                exact &= not worst.any()
                np.maximum(largest, off.max(axis=0), out=largest)
                np.maximum(largest_velocity, off_velocity.max(axis=0), out=largest_velocity)
                off_parts = self._part_deviation(plant, going, following)
                largest_part = max(largest_part, float(off_parts.max()))
                wrong = ~(worst <= self._tolerance) | ~(off_parts <= PARTS_TOLERANCE)
                if wrong.any():
                    first = min(first, int(rows[going][wrong].min()))
        return Verification(
            steps=verified,
            skipped=skipped,
            gaps=self._gaps,
            exact=exact,
            tolerance=self._tolerance,
            largest_deviation=_four(largest),
            largest_velocity_deviation=_four(largest_velocity),
            largest_part_deviation=largest_part,
            first_diverging_step=int(self._steps[first]) if first < len(self._steps) else None,
            machine=machine,
        )

    def _stretches(self) -> tuple[list[tuple[int, int]], Plant | None]:
        """Rows at which stretches begin and end, and a plant in which each is a rig at its beginning."""
        breaks = [0, *(np.flatnonzero(~self._follows) + 1).tolist(), len(self._steps)]
        wanted = max(SHORTEST, len(self._steps) // STRETCHES)
        probe = Plant([self._parameters])
        begins: list[int] = []
        stretches: list[tuple[int, int]] = []
        for low, high in pairwise(breaks):
            begin = self._next_begin(low, high, probe, any_held=True)
            while begin is not None:
                end = self._next_begin(begin + wanted, high, probe, any_held=False)
                last = high - 1 if end is None else end
                if last > begin:
                    stretches.append((begin, last))
                    begins.append(begin)
                begin = end
        if not stretches:
            return [], None
        plant = Plant([self._parameters] * len(stretches))
        for rig, row in enumerate(begins):
            self._place(plant, rig, row)
        return stretches, plant

    def _next_begin(self, low: int, high: int, probe: Plant, *, any_held: bool) -> int | None:
        """First row from `low` on, before `high`, at which all that the next step depends on is recorded."""
        for offset in np.flatnonzero(self._stated[low:high] >= 0):
            row = low + int(offset)
            if not any_held and self._held[row] != NONE:
                continue
            self._place(probe, 0, row)
            if probe.world.at_rest(0):
                return row
        return None

    def _place(self, plant: Plant, rig: int, row: int) -> None:
        parts = self._parts[self._stated[row] :][: len(self._parameters.scene.parts)]
        poses = list(zip(*(parts[name].tolist() for name in ("x", "y", "z", "yaw")), strict=True))
        plant.place(rig, self._position[row], self._velocity[row], poses, int(self._held[row]))

    def _part_deviation(self, plant: Plant, rigs: Ints, rows: Ints) -> Floats:
        """Largest distance of a part from where it was recorded, m, infinite where another part is held, (K,)."""
        world = plant.world
        off = np.where(world.held[rigs] == self._held[rows], 0.0, np.inf)
        stated = np.flatnonzero(self._stated[rows] >= 0)
        count = len(self._parameters.scene.parts)
        if stated.size and count:
            recorded = self._parts[self._stated[rows[stated]][:, np.newaxis] + np.arange(count)]
            for name, simulated in (("x", world.x), ("y", world.y), ("z", world.z)):
                distance = np.abs(simulated[:count, rigs[stated]].T - recorded[name]).max(axis=1)
                off[stated] = np.maximum(off[stated], distance)
        return off


def _indices(codes: Rows, names: Names, parts: Sequence[str]) -> Ints:
    """Index of the held part in the scene, or `NONE`, of each state."""
    index_of = {part: index for index, part in enumerate(parts)}
    found = np.full(len(codes), NONE, dtype=np.int64)
    for code in np.unique(codes):
        found[codes == code] = index_of.get(names[code], NONE)
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
