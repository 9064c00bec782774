"""The whole loop in virtual time: N runs with a timeline each, stepped together, far faster than the clock.

A tick latches the command that is in force by the timeline, states the arm, lets the controllers poll whose read falls
into the step, and moves the arms on, in that order, as the live loop does. No clock, no socket and no global random
numbers: the same arguments give the same bits, for one run or among a thousand.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.controllers import Controller, Measured
from hilrig_study.simulation import quantization as quantised
from hilrig_study.simulation.plants import StudyPlant
from hilrig_study.simulation.timing import NO_POLL, Timeline

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

ERROR_SCALE: Final = np.array([[np.radians(1.0)], [np.radians(1.0)], [1e-3], [np.radians(1.0)]])
"""An error that costs 1: 1° or 1 mm."""
EFFORT_COST: Final = 1e-2
"""What (1 N·m)² or (1 N)² above the holding effort costs beside it."""
TAIL: Final = 0.2
"""Share of the run, its end, by which it is judged whether the arm has come to rest."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """What the arm is to do: start beside a pose, go to it, and follow a sine about it."""

    pose: tuple[float, float, float, float]
    """rad, rad, m, rad."""
    offset: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Where it starts, from the pose; same units."""
    amplitude: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Of the goal's sine; same units."""
    frequency_hz: float = 0.0
    limit: tuple[float, float, float, float] = (0.5, 0.5, 0.05, 0.5)
    """An error beyond this has failed: the run is over."""

    @property
    def start(self) -> tuple[float, float, float, float]:
        """Where the arm starts; rad, rad, m, rad."""
        first, second, third, fourth = (p + o for p, o in zip(self.pose, self.offset, strict=True))
        return first, second, third, fourth

    def goal(self, time_s: NDArray[np.floating[Any]]) -> Floats:
        """Where the joints should be, (4, N), at times, (N,)."""
        wave = np.sin(2 * np.pi * self.frequency_hz * time_s)
        return np.asarray(np.array(self.pose)[:, np.newaxis] + np.array(self.amplitude)[:, np.newaxis] * wave)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What N runs did."""

    cost: Floats
    """Mean over the run of Σ (error/1° or 1 mm)² + 0.01 Σ (effort/1 N·m or 1 N)², (N,); infinite where it failed."""
    error_rms: Floats
    """Of each joint from its goal, rad, rad, m, rad, (4, N)."""
    tail_rms: Floats
    """The same over the last fifth, (4, N)."""
    failed_s: Floats
    """When the error left the limit, s; NaN: it never did, (N,)."""
    settled: Bools
    """Whether it neither failed nor ended with more error than the scenario's own size times a half, (N,)."""
    positions: Floats
    """Every tick's, true, (T, 4, N); of kept runs only."""
    efforts: Floats
    """What acted from each tick on, (T, 4, N); of kept runs only."""


def simulate(
    plant: StudyPlant,
    controller: Controller,
    scenario: Scenario,
    timelines: Sequence[Timeline],
    *,
    ticks: int,
    holding: Sequence[float],
    quantise: bool = True,
    keep: Bools | None = None,
) -> Outcome:
    """Run N loops for `ticks` steps.

    Args:
        plant: N arms at the scenario's start.
        controller: for N runs.
        scenario: what they are to do.
        timelines: one each, of the same step; N.
        ticks: T, at most those of the timelines.
        holding: effort before the first command acts and of runs that are over; N·m, N·m, N, N·m, (4,).
        quantise: through the int16 registers; False: as floats.
        keep: which runs' traces are kept, (N,); None: all.

    Raises:
        InputError: the controller raised, or gave efforts that are no finite numbers.
    """
    runs = len(timelines)
    step_s = timelines[0].step_ns * 1e-9
    acting = np.stack([line.in_force[:ticks] for line in timelines], axis=1)
    polls = _Polls(timelines)
    column, rest = np.arange(runs), np.array(holding, dtype=np.float64)[:, np.newaxis]
    seen = np.zeros((4, ticks, runs))
    """Positions as the registers said them at each tick. A run that does not poll is computed beside those that do,
    perhaps with a tick to come, and passed over: what is read there must be a number, and no chance one."""
    commands = np.empty((4, polls.most + 1, runs))
    commands[:, NO_POLL] = rest
    flat_seen, flat_commands = seen.reshape(4, -1), commands.reshape(4, -1)
    kept = np.ones(runs, dtype=np.bool_) if keep is None else keep
    positions = np.empty((ticks, 4, int(kept.sum())))
    efforts = np.empty_like(positions)
    limit = np.array(scenario.limit)[:, np.newaxis]
    failed_s, failed = np.full(runs, np.nan), np.zeros(runs, dtype=np.bool_)
    sum_error, sum_tail, sum_effort = np.zeros((4, runs)), np.zeros((4, runs)), np.zeros(runs)
    tail_from = ticks - max(1, round(TAIL * ticks))
    controller.begin(runs)
    polls.begin()
    still = scenario.frequency_hz == 0
    one = np.zeros(1)
    goal = scenario.goal(one)
    for tick in range(ticks):
        slot = acting[tick] % (polls.most + 1)
        effort = flat_commands.take(slot * runs + column, axis=1)
        effort = np.where(failed, rest, effort)
        position = plant.position
        if not still:
            one[0] = tick * step_s
            goal = scenario.goal(one)
        error = position - goal
        outside = np.any(np.abs(error) > limit, axis=0) & ~failed
        if outside.any():
            failed_s[outside] = tick * step_s
            failed |= outside
        squared = error * error
        sum_error += squared
        if tick >= tail_from:
            sum_tail += squared
        sum_effort += np.add.reduce((effort - rest) ** 2, axis=0)
        seen[:, tick] = quantised.position(position) if quantise else position
        positions[tick], efforts[tick] = position[:, kept], effort[:, kept]
        for number, reading in polls.in_tick(tick):
            basis = polls.basis[number, column]
            due = reading & ~failed & (basis >= 0)
            everyone = bool(due.all())
            if not (everyone or due.any()):
                continue
            time_s = polls.read_s[number, column]
            known = flat_seen.take(np.maximum(basis, 0) * runs + column, axis=1)
            measured = Measured(time_s, known, scenario.goal(time_s), polls.latency_s[number, column])
            given = controller.update(measured, None if everyone else due)
            if not np.isfinite(given if everyone else given[:, due]).all():
                raise InputError(f"the controller gave an effort that is no finite number at {tick * step_s:.3f} s")
            given = quantised.effort(given) if quantise else given
            if everyone and number.min() == number.max():
                commands[:, number[0]] = given
            else:
                chosen = np.flatnonzero(due)
                commands[:, number[chosen], chosen] = given[:, chosen]
        plant.step(effort)
        if failed.any():
            plant.park(failed)
    span = np.maximum(np.where(failed, np.nan_to_num(failed_s), ticks * step_s) / step_s, 1.0)
    cost = (np.add.reduce(sum_error / ERROR_SCALE**2, axis=0) + EFFORT_COST * sum_effort) / ticks
    size = np.maximum(np.abs(np.array(scenario.offset)), np.abs(np.array(scenario.amplitude)))[:, np.newaxis]
    tail_rms = np.sqrt(sum_tail / (ticks - tail_from))
    at_rest = np.all(tail_rms <= 0.5 * np.maximum(size, 0.1 * ERROR_SCALE), axis=0)
    return Outcome(
        cost=np.where(failed, np.inf, cost),
        error_rms=np.sqrt(sum_error / span),
        tail_rms=tail_rms,
        failed_s=failed_s,
        settled=at_rest & ~failed,
        positions=positions,
        efforts=efforts,
    )


class _Polls:
    """The polls of N runs, (P, N) each, and which of them is due in a tick."""

    def __init__(self, timelines: Sequence[Timeline]) -> None:
        self.most = max(len(line.poll_ns) for line in timelines)

        def table(rows: list[Ints], missing: int) -> Ints:
            filled = np.full((self.most, len(rows)), missing, dtype=np.int64)
            for run, row in enumerate(rows):
                filled[: len(row), run] = row
            return filled

        self.tick = table([line.poll_tick for line in timelines], np.iinfo(np.int64).max)
        self.basis = table([line.basis for line in timelines], -1)
        self.read_s: Floats = np.asarray(table([line.poll_ns for line in timelines], 0) * 1e-9, dtype=np.float64)
        step_s = timelines[0].step_ns * 1e-9
        shown = table([line.shown_latency for line in timelines], 0)
        self.latency_s: Floats = np.asarray(shown * step_s, dtype=np.float64)
        self._column = np.arange(len(timelines))
        self._next = np.zeros(len(timelines), dtype=np.int64)

    def begin(self) -> None:
        """Start anew."""
        self._next[:] = 0

    def in_tick(self, tick: int) -> Iterator[tuple[Ints, Bools]]:
        """The polls whose read falls into a tick's step: each run's next, and which runs have one, (N,) each."""
        while True:
            number = np.minimum(self._next, self.most - 1)
            due = (self.tick[number, self._column] == tick) & (self._next < self.most)
            if not due.any():
                return
            self._next += due
            yield number, due
