"""Closed-loop simulation of N runs in parallel, each with its own timeline, faster than real time.

A tick latches the acting command of the timeline, samples the position, runs the controllers whose read falls into the
step, and advances the arms, in that order, as the live loop does. There is no clock, socket or global random number
generator: equal arguments give bit-identical results, alone or among other runs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.control_laws import Controller, Measurement
from hilrig_study.simulation import quantization
from hilrig_study.simulation.plants import StudyPlant
from hilrig_study.simulation.timing import NO_POLL, Timeline

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

ERROR_SCALE: Final = np.array([[np.radians(1.0)], [np.radians(1.0)], [1e-3], [np.radians(1.0)]])
"""Position error of cost 1: 1° or 1 mm."""
EFFORT_COST: Final = 1e-2
"""Cost of (1 N·m)² or (1 N)² of effort relative to the holding effort."""
TAIL_FRACTION: Final = 0.2
"""Final fraction of the run in which the arm must be at rest to count as settled."""
DECAY_FRACTION: Final = 0.3
"""The error of a constant set point must be smaller in this final fraction of the run than in the one before it."""
LIMIT_CYCLE_SHARE: Final = 0.5
"""Error that need not decay, as a share of that of cost 1: the registers cause limit cycles of up to 0.2°."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Motion task: start at an offset from a pose, move to the pose, and follow a sine around it."""

    pose: tuple[float, float, float, float]
    """rad, rad, m, rad."""
    offset: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Start position relative to the pose; same units."""
    amplitude: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Amplitude of the set-point sine; same units."""
    frequency_hz: float = 0.0
    limit: tuple[float, float, float, float] = (0.5, 0.5, 0.05, 0.5)
    """Failure limit: a run ends when an error exceeds it; same units."""

    @property
    def start(self) -> tuple[float, float, float, float]:
        """Start position; rad, rad, m, rad."""
        first, second, third, fourth = (p + o for p, o in zip(self.pose, self.offset, strict=True))
        return first, second, third, fourth

    def goal(self, time_s: NDArray[np.floating[Any]]) -> Floats:
        """Return the set points, (4, N), at times, s, (N,)."""
        wave = np.sin(2 * np.pi * self.frequency_hz * time_s)
        return np.asarray(np.array(self.pose)[:, np.newaxis] + np.array(self.amplitude)[:, np.newaxis] * wave)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Results of N runs."""

    cost: Floats
    """Mean over the run of Σ (error/1° or 1 mm)² + 0.01 Σ (effort/1 N·m or 1 N)², (N,); infinite for failed runs."""
    error_rms: Floats
    """Root mean square error of each joint; rad, rad, m, rad, (4, N)."""
    tail_rms: Floats
    """Root mean square error over the last fifth of the run, (4, N)."""
    failed_s: Floats
    """Time at which an error exceeded the limit, s; NaN: never, (N,)."""
    settled: Bools
    """Whether the run did not fail, its final error is at most half of the size of the motion, and the error of a
    constant set point decays, (N,)."""
    positions: Floats
    """Positions at each tick, unquantized, (T, 4, N); of recorded runs only."""
    efforts: Floats
    """Acting efforts from each tick on, (T, 4, N); of recorded runs only."""


def simulate(
    plant: StudyPlant,
    controller: Controller,
    scenario: Scenario,
    timelines: Sequence[Timeline],
    *,
    ticks: int,
    holding: Sequence[float],
    quantize: bool = True,
    keep: Bools | None = None,
) -> Outcome:
    """Simulate N loops for `ticks` steps.

    Args:
        plant: N arms at the scenario's start.
        controller: for N runs.
        scenario: the motion task.
        timelines: one timeline per run, all with the same step; N.
        ticks: T, at most the length of the timelines.
        holding: effort before the first command acts and of finished runs; N·m, N·m, N, N·m, (4,).
        quantize: whether positions and efforts pass the int16 registers; False: as floats.
        keep: runs whose traces are recorded, (N,); None: all.

    Raises:
        InputError: the controller raised an exception, or returned efforts that are not finite.
    """
    runs = len(timelines)
    step_s = timelines[0].step_ns * 1e-9
    in_force = np.stack([line.in_force[:ticks] for line in timelines], axis=1)
    polls = _PollSchedule(timelines)
    column, rest = np.arange(runs), np.array(holding, dtype=np.float64)[:, np.newaxis]
    seen = np.zeros((4, ticks, runs))
    """Positions in the registers at each tick. The controller is also evaluated for runs that do not poll, perhaps at a
    future tick, and the result is discarded; initialized so that these evaluations get defined numbers."""
    commands = np.empty((4, polls.count + 1, runs))
    commands[:, NO_POLL] = rest
    flat_seen, flat_commands = seen.reshape(4, -1), commands.reshape(4, -1)
    kept = np.ones(runs, dtype=np.bool_) if keep is None else keep
    positions = np.empty((ticks, 4, int(kept.sum())))
    efforts = np.empty_like(positions)
    limit = np.array(scenario.limit)[:, np.newaxis]
    failed_s, failed = np.full(runs, np.nan), np.zeros(runs, dtype=np.bool_)
    sum_error, sum_tail, sum_effort = np.zeros((4, runs)), np.zeros((4, runs)), np.zeros(runs)
    tail_from = ticks - max(1, round(TAIL_FRACTION * ticks))
    windows = [ticks - 2 * round(DECAY_FRACTION * ticks), ticks - round(DECAY_FRACTION * ticks), ticks]
    sum_windows = np.zeros((2, 4, runs))
    controller.reset(runs)
    polls.reset()
    is_constant = scenario.frequency_hz == 0
    now_s = np.zeros(1)
    goal = scenario.goal(now_s)
    for tick in range(ticks):
        slot = in_force[tick] % (polls.count + 1)
        effort = flat_commands.take(slot * runs + column, axis=1)
        effort = np.where(failed, rest, effort)
        position = plant.position
        if not is_constant:
            now_s[0] = tick * step_s
            goal = scenario.goal(now_s)
        error = position - goal
        outside = np.any(np.abs(error) > limit, axis=0) & ~failed
        if outside.any():
            failed_s[outside] = tick * step_s
            failed |= outside
        squared = error * error
        sum_error += squared
        if tick >= tail_from:
            sum_tail += squared
        if tick >= windows[0]:
            sum_windows[int(tick >= windows[1])] += squared
        sum_effort += np.add.reduce((effort - rest) ** 2, axis=0)
        seen[:, tick] = quantization.position(position) if quantize else position
        positions[tick], efforts[tick] = position[:, kept], effort[:, kept]
        for number, reading in polls.in_tick(tick):
            basis = polls.basis[number, column]
            due = reading & ~failed & (basis >= 0)
            all_due = bool(due.all())
            if not (all_due or due.any()):
                continue
            time_s = polls.read_s[number, column]
            served = flat_seen.take(np.maximum(basis, 0) * runs + column, axis=1)
            measured = Measurement(time_s, served, scenario.goal(time_s), polls.latency_s[number, column])
            command_effort = controller.update(measured, None if all_due else due)
            if not np.isfinite(command_effort if all_due else command_effort[:, due]).all():
                raise InputError(f"the controller returned an effort that is not finite at t = {tick * step_s:.3f} s")
            command_effort = quantization.effort(command_effort) if quantize else command_effort
            if all_due and number.min() == number.max():
                commands[:, number[0]] = command_effort
            else:
                chosen = np.flatnonzero(due)
                commands[:, number[chosen], chosen] = command_effort[:, chosen]
        plant.step(effort)
        if failed.any():
            plant.park(failed)
    span = np.maximum(np.where(failed, np.nan_to_num(failed_s), ticks * step_s) / step_s, 1.0)
    cost = (np.add.reduce(sum_error / ERROR_SCALE**2, axis=0) + EFFORT_COST * sum_effort) / ticks
    size = np.maximum(np.abs(np.array(scenario.offset)), np.abs(np.array(scenario.amplitude)))[:, np.newaxis]
    tail_rms = np.sqrt(sum_tail / (ticks - tail_from))
    at_rest = np.all(tail_rms <= 0.5 * np.maximum(size, 0.1 * ERROR_SCALE), axis=0)
    if is_constant:
        before, after = sum_windows
        limit_cycle = (LIMIT_CYCLE_SHARE * ERROR_SCALE) ** 2 * (windows[2] - windows[1])
        at_rest &= np.all((after < before) | (after <= limit_cycle), axis=0)
    return Outcome(
        cost=np.where(failed, np.inf, cost),
        error_rms=np.sqrt(sum_error / span),
        tail_rms=tail_rms,
        failed_s=failed_s,
        settled=at_rest & ~failed,
        positions=positions,
        efforts=efforts,
    )


class _PollSchedule:
    """Poll schedule of N runs: tables (P, N), and the polls of each tick."""

    def __init__(self, timelines: Sequence[Timeline]) -> None:
        self.count = max(len(line.poll_ns) for line in timelines)

        def table(rows: list[Ints], missing: int) -> Ints:
            filled = np.full((self.count, len(rows)), missing, dtype=np.int64)
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

    def reset(self) -> None:
        """Restart at the first poll of each run."""
        self._next[:] = 0

    def in_tick(self, tick: int) -> Iterator[tuple[Ints, Bools]]:
        """Yield the polls whose read is in the step of a tick: poll numbers, and which runs poll, (N,) each."""
        while True:
            number = np.minimum(self._next, self.count - 1)
            due = (self.tick[number, self._column] == tick) & (self._next < self.count)
            if not due.any():
                return
            self._next += due
            yield number, due
