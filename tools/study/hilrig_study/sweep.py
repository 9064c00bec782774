"""Parameter sweep of a study: simulates all cells in batches on all cores and computes the theory of each.

A cell is a controller and a point (x, y); it is simulated `runs` times with different seeds. Cells with the same step
and poll period are simulated together. Random draws depend only on the seed of the study and the number of the run, so
the results do not depend on the number of cores.
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
from hilrig_study.theory.margins import STABLE_RADIUS
from hilrig_study.theory.mean_square import CHAIN_TICKS, stable_until

Floats = NDArray[np.float64]

MAX_BATCH_RUNS: Final = 1000
"""Upper limit of runs per batch, chosen so that the arrays of a batch fit into the cache of a core."""

CELL_DTYPE: Final = np.dtype(
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
"""Row type of a run's parameters."""

RESULT_DTYPE: Final = np.dtype(
    [
        ("cost", "<f8"),
        ("settled", "|b1"),
        ("failed_s", "<f8"),
        ("error_rms", "<f8", (4,)),
        ("loop_p50_ms", "<f8"),
        ("loop_p99_ms", "<f8"),
    ]
)
"""Row type of a run's results; units as in `Outcome`."""


@dataclass(frozen=True, slots=True)
class SweepResult:
    """Results of all runs of a study, and the theory."""

    cells: NDArray[np.void]
    """(R,), fields as `CELL_DTYPE`."""
    results: NDArray[np.void]
    """(R,), fields as `RESULT_DTYPE`."""
    radius: Floats
    """Spectral radius of each run's loop, (R,); NaN: its delay is random, or its controller has no linear model."""
    theory: tuple[GainTheory, ...]
    seconds: float
    """Duration of the sweep."""

    def plane(self, study: StudyConfig, controller: int, values: NDArray[np.generic]) -> Floats:
        """Return the mean over the runs of each cell, (len(y), len(x)), of one value per run, (R,)."""
        rows = self.cells["controller"] == controller
        shape = (len(study.y.points), len(study.x.points))
        total, count = np.zeros(shape), np.zeros(shape)
        where = (self.cells["iy"][rows], self.cells["ix"][rows])
        np.add.at(total, where, values[rows].astype(np.float64))
        np.add.at(count, where, 1.0)
        return total / count


_TheoryKey = tuple[int, float, float, float]
"""Controller, gain, step, ms, and poll period, ms."""
_Theory = tuple[GainTheory, dict[float, float]]


def all_cells(study: StudyConfig) -> NDArray[np.void]:
    """Return all runs of a study, (R,), fields as `CELL_DTYPE`."""
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
    cells = np.zeros(len(ix), CELL_DTYPE)
    cells["controller"], cells["ix"], cells["iy"], cells["run"] = controllers, ix, iy, runs
    cells["gain"], cells["step_ms"], cells["poll_ms"] = 1.0, study.loop.step_ms, study.loop.poll_ms
    cells[study.x.what], cells[study.y.what] = x[ix], y[iy]
    if "poll_ms" not in (study.x.what, study.y.what) and study.loop.poll_ms == study.loop.step_ms:
        # A loop with one poll per step keeps one poll per step.
        cells["poll_ms"] = cells["step_ms"]
    # Without random draws, further runs would repeat the first one.
    chosen: NDArray[np.void] = cells[(cells["run"] == 0) | ~_constant(study, cells)]
    return chosen


def run_cells(
    study: StudyConfig, cells: NDArray[np.void], folder: Path = Path(), *, keep: bool = False
) -> tuple[NDArray[np.void], Outcome]:
    """Simulate cells with the same controller, step and period; return the results, (R,), and the outcome.

    With `keep`, the outcome contains the traces.

    Raises:
        InputError: a controller raised an exception or returned invalid efforts, or a value is out of range.
    """
    first = cells[0]
    timing = study.loop.timing(float(first["step_ms"]), float(first["poll_ms"]))
    ticks = max(1, round(study.loop.duration_s * 1e9 / timing.step_ns))
    lines = timelines(study, cells, timing, ticks)
    rig, plant_model, scenario = study.rig(float(first["step_ms"])), study.linear_plant(), study.task.scenario()
    plant: StudyPlant
    if study.plant == "arm":
        plant = ArmPlant(rig, scenario.start, scenario.pose, len(cells))
    else:
        plant = LinearArms(plant_model, *study.discretized_plant(float(first["step_ms"])), scenario.start, len(cells))
    gain = np.ascontiguousarray(cells["gain"])
    config = study.controllers[first["controller"]]
    controller = config.build(rig, plant_model, timing.period_ns * 1e-9, gain, folder)
    outcome = simulate(
        plant, controller, scenario, lines, ticks=ticks, holding=plant_model.holding, keep=np.full(len(cells), keep)
    )
    results = np.zeros(len(cells), RESULT_DTYPE)
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
    """Return the run of any point of the plane, (1,), fields as `CELL_DTYPE`."""
    axes = {"x": {"what": study.x.what, "values": (x,)}, "y": {"what": study.y.what, "values": (y,)}}
    plane = {"x": AxisConfig.model_validate(axes["x"]), "y": AxisConfig.model_validate(axes["y"]), "runs": 1}
    cells = all_cells(study.model_copy(update=plane))
    rows: NDArray[np.void] = cells[cells["controller"] == controller]
    return rows


def timelines(study: StudyConfig, cells: NDArray[np.void], timing: LoopTiming, ticks: int) -> list[Timeline]:
    """Return the timeline of each run, all of one controller; runs with equal timing share one object."""
    links = study.link_impairments(int(cells["controller"][0]))
    polls = poll_count(timing, ticks)
    cache: dict[tuple[float, ...], Timeline] = {}
    lines = []
    for cell in cells:
        delay_ns, jitter_ms, loss = round(float(cell["delay_ms"]) * 1e6), float(cell["jitter_ms"]), float(cell["loss"])
        random = jitter_ms > 0 or loss > 0 or not links.is_inactive
        # The draws depend only on the study's seed and the run number: all cells use common random numbers.
        key = (delay_ns, jitter_ms, loss, float(cell["run"]) if random else 0.0)
        if key not in cache:
            seed = np.random.SeedSequence(study.seed, spawn_key=(int(cell["run"]),))
            states, commands, added = (np.random.SeedSequence(s.entropy, spawn_key=s.spawn_key) for s in seed.spawn(3))
            more = LinkImpairment(
                delay=UniformDelay(low_ms=0, high_ms=jitter_ms) if jitter_ms else ConstantDelay(),
                loss=BernoulliLoss(rate=loss) if loss else NoLoss(),
            )
            state_ns, state_lost = Impairment(links.state, states).draw(ticks)
            command_ns, command_lost = Impairment(links.command, commands).draw(polls)
            more_ns, more_lost = Impairment(more, added).draw(polls)
            cache[key] = timeline(
                timing, ticks, state_ns, command_ns + more_ns + delay_ns, state_lost, command_lost | more_lost
            )
        lines.append(cache[key])
    return lines


def sweep(
    study: StudyConfig,
    folder: Path,
    progress: Callable[[float], None],
    *,
    workers: int | None = None,
    theory: bool = True,
) -> SweepResult:
    """Simulate a study on all cores.

    Args:
        study: the study.
        folder: folder of the study file; controller files are relative to it.
        progress: called with the completed fraction of the work.
        workers: number of processes; default: one per core.
        theory: whether the theory is computed too.

    Raises:
        InputError: as `run_cells`.
    """
    start_s = time.perf_counter()
    cells = all_cells(study)
    batch_rows = list(_batches(cells))
    delays = sorted(set(cells["delay_ms"].tolist()))
    keys = np.unique(cells[["controller", "gain", "step_ms", "poll_ms"]]) if theory else cells[:0]
    results = np.zeros(len(cells), RESULT_DTYPE)
    radius = np.full(len(cells), np.nan)
    found: list[GainTheory] = []
    constant = _constant(study, cells)
    total, done = len(batch_rows) * 20 + len(keys), 0
    with process_pool(len(batch_rows) + len(keys), workers) as executor:
        batches: dict[Future[NDArray[np.void]], NDArray[np.intp]] = {
            executor.submit(_results_of, study, cells[rows], folder): rows for rows in batch_rows
        }
        theories: dict[Future[_Theory | None], _TheoryKey] = {
            executor.submit(_theory_of, study, row, delays): row for row in keys.tolist()
        }
        for batch in as_completed(batches):
            results[batches[batch]] = batch.result()
            done += 20
            progress(done / total)
        for completed in as_completed(theories):
            completed.result()
            done += 1
            progress(done / total)
        for theory_future, row in theories.items():
            result = theory_future.result()
            if result is None:
                continue
            found.append(result[0])
            controller, gain, step_ms, poll_ms = row
            rows = constant & (cells["controller"] == controller) & (cells["gain"] == gain)
            rows &= (cells["step_ms"] == step_ms) & (cells["poll_ms"] == poll_ms)
            radius[rows] = [result[1][delay] for delay in cells["delay_ms"][rows].tolist()]
    # A loop that grows slowly can look settled at the end of a short run.
    results["settled"] &= ~(radius >= STABLE_RADIUS)
    return SweepResult(cells, results, radius, tuple(found), time.perf_counter() - start_s)


def _constant(study: StudyConfig, cells: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return which runs have no random values, (R,)."""
    unimpaired = np.array([study.link_impairments(number).is_inactive for number in range(len(study.controllers))])
    jitter_ms, loss, controller = cells["jitter_ms"], cells["loss"], cells["controller"]
    return np.asarray((jitter_ms == 0) & (loss == 0) & unimpaired[controller])


def _batches(cells: NDArray[np.void]) -> Iterator[NDArray[np.intp]]:
    """Yield the rows of runs that can be simulated together, at most `MAX_BATCH_RUNS` each."""
    groups: dict[tuple[float, ...], list[int]] = {}
    for row, cell in enumerate(cells[["controller", "step_ms", "poll_ms"]].tolist()):
        groups.setdefault(cell, []).append(row)
    for rows in groups.values():
        for first in range(0, len(rows), MAX_BATCH_RUNS):
            yield np.array(rows[first : first + MAX_BATCH_RUNS], dtype=np.intp)


def _results_of(study: StudyConfig, cells: NDArray[np.void], folder: Path) -> NDArray[np.void]:
    return run_cells(study, cells, folder)[0]


def _theory_of(study: StudyConfig, key: _TheoryKey, delays_ms: Sequence[float]) -> _Theory | None:
    controller, gain, step_ms, poll_ms = key
    found = gain_theory(study, controller, gain, step_ms, poll_ms, delays_ms)
    if found is None:
        return None
    return replace(found[0], mean_square_until=_mean_square_until(study, key)), found[1]


def _mean_square_until(study: StudyConfig, key: _TheoryKey) -> float:
    controller, gain, step_ms, poll_ms = key
    config, axes = study.controllers[controller], (study.x, study.y)
    others = [axis for axis in axes if axis.what in ("delay_ms", "jitter_ms", "loss")]
    random = not study.link_impairments(controller).is_inactive or any(axis.what != "delay_ms" for axis in others)
    predicts = config.kind == "lqr" and config.compensate
    if len(others) != 1 or "gain" not in {axis.what for axis in axes} or not random or predicts or poll_ms != step_ms:
        return math.nan
    timing = study.loop.timing(step_ms, poll_ms)

    def ages_at(value: float) -> NDArray[np.int64]:
        cell = np.zeros(1, CELL_DTYPE)
        cell["controller"], cell["step_ms"], cell["poll_ms"], cell[others[0].what] = controller, step_ms, poll_ms, value
        (line,) = timelines(study, cell, timing, CHAIN_TICKS)
        return line.ages()

    return stable_until(study, controller, gain, step_ms, np.sort(others[0].points).tolist(), ages_at)
