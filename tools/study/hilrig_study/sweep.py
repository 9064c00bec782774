"""A study's plane of cells, run in virtual time in batches on all cores, with what theory says of each.

A cell is a controller and a point (x, y); it is run `runs` times with seeds of its own. Cells that share the step and
the poll's period step together. What is drawn depends on the study's seed and the cell alone, so a study gives the same
numbers on one core and on many.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_modbus_edge.impairment.model import Impairment
from hilrig_runtime.config.impairment import BernoulliLoss, ConstantDelay, LinkImpairment, NoLoss, UniformDelay
from hilrig_runtime.process.process_pool import process_pool
from hilrig_study.simulation.plants import ArmPlant, LinearArms, StudyPlant
from hilrig_study.simulation.simulated_loop import Outcome, simulate
from hilrig_study.simulation.timing import LoopTiming, Timeline, poll_count, timeline
from hilrig_study.study_config import AxisConfig, StudyConfig
from hilrig_study.theory.gain_theory import GainTheory, gain_theory
from hilrig_study.theory.mean_square import TICKS, stable_until

Floats = NDArray[np.float64]

BATCH: Final = 1000
"""Runs that step together: their arrays stay in a core's cache."""

CELL: Final = np.dtype(
    [
        ("controller", "<i4"),
        ("ix", "<i4"),
        ("iy", "<i4"),
        ("run", "<i4"),
        ("gain", "<f8"),
        ("delay_ms", "<f8"),
        ("jitter_ms", "<f8"),
        ("loss", "<f8"),
        ("step_ms", "<f8"),
        ("poll_ms", "<f8"),
    ]
)
"""One row a run."""

RESULT: Final = np.dtype(
    [
        ("cost", "<f8"),
        ("settled", "|b1"),
        ("failed_s", "<f8"),
        ("error_rms", "<f8", (4,)),
        ("loop_p50_ms", "<f8"),
        ("loop_p99_ms", "<f8"),
    ]
)
"""What a run did; units as in `Outcome`."""


@dataclass(frozen=True, slots=True)
class SweepResult:
    """All runs of a study, and its theory."""

    cells: NDArray[np.void]
    """(R,), fields as `CELL`."""
    results: NDArray[np.void]
    """(R,), fields as `RESULT`."""
    radius: Floats
    """Spectral radius of each run's loop; NaN where its delay is not constant or its controller has no law, (R,)."""
    theory: tuple[GainTheory, ...]
    seconds: float
    """What it took."""

    def plane(self, study: StudyConfig, controller: int, values: NDArray[np.generic]) -> Floats:
        """A value a run, (R,), as the mean of each cell, (len(y), len(x))."""
        mine = self.cells["controller"] == controller
        shape = (len(study.y.points), len(study.x.points))
        total, count = np.zeros(shape), np.zeros(shape)
        where = (self.cells["iy"][mine], self.cells["ix"][mine])
        np.add.at(total, where, values[mine].astype(np.float64))
        np.add.at(count, where, 1.0)
        return total / count


_Asked = tuple[int, float, float, float]
"""Controller, gain, step and period, ms."""
_Theory = tuple[GainTheory, dict[float, float]]


def cells_of(study: StudyConfig) -> NDArray[np.void]:
    """Every run of a study, (R,), fields as `CELL`."""
    x, y = study.x.points, study.y.points
    controllers, iy, ix, runs = (
        index.ravel()
        for index in np.meshgrid(
            np.arange(len(study.controllers)),
            np.arange(len(y)),
            np.arange(len(x)),
            np.arange(study.runs),
            indexing="ij",
        )
    )
    cells = np.zeros(len(ix), CELL)
    cells["controller"], cells["ix"], cells["iy"], cells["run"] = controllers, ix, iy, runs
    cells["gain"], cells["step_ms"], cells["poll_ms"] = 1.0, study.loop.step_ms, study.loop.poll_ms
    cells[study.x.what], cells[study.y.what] = x[ix], y[iy]
    if "poll_ms" not in (study.x.what, study.y.what) and study.loop.poll_ms == study.loop.step_ms:
        # A loop that polls once a step goes on doing so.
        cells["poll_ms"] = cells["step_ms"]
    # Where nothing is drawn, a second run would be the first again.
    chosen: NDArray[np.void] = cells[(cells["run"] == 0) | ~_constant(study, cells)]
    return chosen


def run_cells(
    study: StudyConfig, cells: NDArray[np.void], folder: Path = Path(), *, keep: bool = False
) -> tuple[NDArray[np.void], Outcome]:
    """Run cells that share controller, step and period; their results, (R,), and what the runs did, with `keep` whole.

    Raises:
        InputError: a controller raised or gave no numbers, or a value is none that a loop can have.
    """
    first = cells[0]
    timing = study.loop.timing(float(first["step_ms"]), float(first["poll_ms"]))
    ticks = max(1, round(study.loop.duration_s * 1e9 / timing.step_ns))
    lines = timelines(study, cells, timing, ticks)
    rig, near, scenario = study.rig(float(first["step_ms"])), study.near(), study.task.scenario()
    plant: StudyPlant
    if study.plant == "arm":
        plant = ArmPlant(rig, scenario.start, scenario.pose, len(cells))
    else:
        plant = LinearArms(near, *study.discretised(float(first["step_ms"])), scenario.start, len(cells))
    gain = np.ascontiguousarray(cells["gain"])
    config = study.controllers[first["controller"]]
    controller = config.build(rig, near, timing.period_ns * 1e-9, gain, folder)
    outcome = simulate(
        plant, controller, scenario, lines, ticks=ticks, holding=near.holding, keep=np.full(len(cells), keep)
    )
    results = np.zeros(len(cells), RESULT)
    results["cost"], results["settled"], results["failed_s"] = outcome.cost, outcome.settled, outcome.failed_s
    results["error_rms"] = outcome.error_rms.T
    percentiles: dict[int, tuple[float, float]] = {}
    for row, line in enumerate(lines):
        if id(line) not in percentiles:
            samples = line.samples_ns / 1e6
            p50, p99 = np.percentile(samples, (50, 99)) if len(samples) else (math.nan, math.nan)
            percentiles[id(line)] = (float(p50), float(p99))
        results["loop_p50_ms"][row], results["loop_p99_ms"][row] = percentiles[id(line)]
    return results, outcome


def cell_at(study: StudyConfig, x: float, y: float, controller: int = 0) -> NDArray[np.void]:
    """The run of one point of the plane, which need not be one of the sweep's: (1,), fields as `CELL`."""
    axes = {"x": {"what": study.x.what, "values": (x,)}, "y": {"what": study.y.what, "values": (y,)}}
    plane = {"x": AxisConfig.model_validate(axes["x"]), "y": AxisConfig.model_validate(axes["y"]), "runs": 1}
    cells = cells_of(study.model_copy(update=plane))
    mine: NDArray[np.void] = cells[cells["controller"] == controller]
    return mine


def timelines(study: StudyConfig, cells: NDArray[np.void], timing: LoopTiming, ticks: int) -> list[Timeline]:
    """The timeline of each cell's run, all of one controller; runs whose times are the same share one."""
    links = study.links(int(cells["controller"][0]))
    polls = poll_count(timing, ticks)
    known: dict[tuple[float, ...], Timeline] = {}
    lines = []
    for cell in cells:
        delay_ns, jitter_ms, loss = round(float(cell["delay_ms"]) * 1e6), float(cell["jitter_ms"]), float(cell["loss"])
        random = jitter_ms > 0 or loss > 0 or not links.is_inactive
        # A run's draws depend on the study's seed and its number alone: cells beside each other meet the same luck.
        key = (delay_ns, jitter_ms, loss, float(cell["run"]) if random else 0.0)
        if key not in known:
            seed = np.random.SeedSequence(study.seed, spawn_key=(int(cell["run"]),))
            states, commands, added = (np.random.SeedSequence(s.entropy, spawn_key=s.spawn_key) for s in seed.spawn(3))
            more = LinkImpairment(
                delay=UniformDelay(low_ms=0, high_ms=jitter_ms) if jitter_ms else ConstantDelay(),
                loss=BernoulliLoss(rate=loss) if loss else NoLoss(),
            )
            state_ns, state_lost = Impairment(links.state, states).draw(ticks)
            command_ns, command_lost = Impairment(links.command, commands).draw(polls)
            more_ns, more_lost = Impairment(more, added).draw(polls)
            known[key] = timeline(
                timing, ticks, state_ns, command_ns + more_ns + delay_ns, state_lost, command_lost | more_lost
            )
        lines.append(known[key])
    return lines


def sweep(
    study: StudyConfig, folder: Path, tick: Callable[[float], None], *, workers: int | None = None, theory: bool = True
) -> SweepResult:
    """Run a study on all cores.

    Args:
        study: the study.
        folder: of the study's file: students' files are named from there.
        tick: hears the share of the work that is done.
        workers: processes; default: one a core.
        theory: whether theory is asked too.

    Raises:
        InputError: as `run_cells`.
    """
    begin = time.perf_counter()
    cells = cells_of(study)
    parts = list(_batches(cells))
    delays = sorted(set(cells["delay_ms"].tolist()))
    asked = np.unique(cells[["controller", "gain", "step_ms", "poll_ms"]]) if theory else cells[:0]
    results = np.zeros(len(cells), RESULT)
    radius = np.full(len(cells), np.nan)
    found: list[GainTheory] = []
    constant = _constant(study, cells)
    total, done = len(parts) * 20 + len(asked), 0
    with process_pool(len(parts) + len(asked), workers) as executor:
        batches: dict[Future[NDArray[np.void]], NDArray[np.intp]] = {
            executor.submit(_results_of, study, cells[rows], folder): rows for rows in parts
        }
        theories: dict[Future[_Theory | None], _Asked] = {
            executor.submit(_theory_of, study, row, delays): row for row in asked.tolist()
        }
        for batch in as_completed(batches):
            results[batches[batch]] = batch.result()
            done += 20
            tick(done / total)
        for one in as_completed(theories):
            one.result()
            done += 1
            tick(done / total)
        for theory_future, row in theories.items():
            answer = theory_future.result()
            if answer is None:
                continue
            found.append(answer[0])
            controller, gain, step_ms, poll_ms = row
            mine = constant & (cells["controller"] == controller) & (cells["gain"] == gain)
            mine &= (cells["step_ms"] == step_ms) & (cells["poll_ms"] == poll_ms)
            radius[mine] = [answer[1][delay] for delay in cells["delay_ms"][mine].tolist()]
    return SweepResult(cells, results, radius, tuple(found), time.perf_counter() - begin)


def _constant(study: StudyConfig, cells: NDArray[np.void]) -> NDArray[np.bool_]:
    """Where nothing is random."""
    nothing = np.array([study.links(number).is_inactive for number in range(len(study.controllers))])
    return np.asarray((cells["jitter_ms"] == 0) & (cells["loss"] == 0) & nothing[cells["controller"]])


def _batches(cells: NDArray[np.void]) -> Iterator[NDArray[np.intp]]:
    """Rows of runs that can step together, at most `BATCH` each."""
    groups: dict[tuple[float, ...], list[int]] = {}
    for row, cell in enumerate(cells[["controller", "step_ms", "poll_ms"]].tolist()):
        groups.setdefault(cell, []).append(row)
    for rows in groups.values():
        for begin in range(0, len(rows), BATCH):
            yield np.array(rows[begin : begin + BATCH], dtype=np.intp)


def _results_of(study: StudyConfig, cells: NDArray[np.void], folder: Path) -> NDArray[np.void]:
    return run_cells(study, cells, folder)[0]


def _theory_of(study: StudyConfig, asked: _Asked, delays_ms: Sequence[float]) -> _Theory | None:
    controller, gain, step_ms, poll_ms = asked
    found = gain_theory(study, controller, gain, step_ms, poll_ms, delays_ms)
    if found is None:
        return None
    return replace(found[0], mean_square_until=_mean_square_until(study, asked)), found[1]


def _mean_square_until(study: StudyConfig, asked: _Asked) -> float:
    controller, gain, step_ms, poll_ms = asked
    config, axes = study.controllers[controller], (study.x, study.y)
    others = [axis for axis in axes if axis.what in ("delay_ms", "jitter_ms", "loss")]
    drawn = not study.links(controller).is_inactive or any(axis.what != "delay_ms" for axis in others)
    predicts = config.kind == "lqr" and config.compensate
    if len(others) != 1 or "gain" not in {axis.what for axis in axes} or not drawn or predicts or poll_ms != step_ms:
        return math.nan
    timing = study.loop.timing(step_ms, poll_ms)

    def ages_at(value: float) -> NDArray[np.int64]:
        cell = np.zeros(1, CELL)
        cell["controller"], cell["step_ms"], cell["poll_ms"], cell[others[0].what] = controller, step_ms, poll_ms, value
        (line,) = timelines(study, cell, timing, TICKS)
        return line.ages()

    return stable_until(study, controller, gain, step_ms, np.sort(others[0].points).tolist(), ages_at)
