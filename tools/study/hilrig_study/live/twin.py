"""Comparison of a live point with its twins: simulations of the same loop under the measured conditions.

A twin uses the medians of phase, controller time and transport in the recording, and draws new delays from the injected
impairment. Several twins are run. Only joints 1 and 2 are compared, because the quill (joint 3) drops while a rig waits
for its controller; this does not affect joints 1 and 2.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.stages import TRANSPORT
from hilrig_replay.io.run import Run
from hilrig_runtime.errors import InputError
from hilrig_study.study_config import StudyConfig
from hilrig_study.sweep import CELL_DTYPE, run_cells, timelines

Floats = NDArray[np.float64]

TWIN_RUNS: Final = 20
"""Simulated runs per live run; their spread is the random variation."""
LOOP_TOLERANCE_STEPS: Final = 0.5
"""Tolerance of the mean loop latency, steps; three standard errors of the drawn delays are added."""
ERROR_TOLERANCE: Final = 0.15
"""Relative tolerance of the tracking error; 0.05° and three standard deviations of the twins are added."""
ERROR_FLOOR_DEG: Final = 0.05
"""Absolute tolerance of the tracking error, degrees."""
MIN_COMMANDS: Final = 10
"""Fewest effective commands of a recording that can be compared."""


@dataclass(frozen=True, slots=True)
class RunMetrics:
    """Loop latency and tracking error of a run, live or simulated."""

    loop_p50_ms: float
    loop_p95_ms: float
    loop_mean_ms: float
    error_rms_deg: float
    """Tracking error of joints 1 and 2, root mean square over the run."""
    settled: bool


@dataclass(frozen=True, slots=True)
class TwinComparison:
    """Result of the comparison of a live point with its twins."""

    live: RunMetrics
    virtual: RunMetrics
    """Means over the twins; `settled`: whether most of them settled."""
    phase_ms: float
    """Phase of the controller's reads relative to the ticks, from the recording."""
    compute_ms: float
    """Time from read to write, from the recording."""
    latency_ks: float
    """Kolmogorov-Smirnov distance between the two distributions of the loop latency, 0 to 1."""
    as_predicted: bool


def compare_with_twins(study: StudyConfig, cell: NDArray[np.void], run: Run, folder: Path) -> TwinComparison:
    """Evaluate the recording of a live point and compare it with simulated twins.

    Args:
        study: the study of the point.
        cell: the point, (1,), fields as `CELL_DTYPE`.
        run: its recording.
        folder: folder of the study file.

    Raises:
        InputError: the recording has too few commands of a controller.
    """
    report = measure(run)
    if len(report.table) < MIN_COMMANDS:
        raise InputError(
            f"{run.path}: too few effective commands to compare: at least {MIN_COMMANDS} needed, "
            f"got {len(report.table)}"
        )
    commands, states = run.commands, run.states
    answered = commands[commands["state_served_ns"] > 0]
    step_ns, own = run.step_ns, study.loop
    transport_ns = float(np.median(report.table[TRANSPORT.key])) / 2
    served_ns: NDArray[np.int64] = answered["state_served_ns"]
    write_arrived_ns: NDArray[np.int64] = answered["write_arrived_ns"]
    after_arrival = (served_ns - answered["state_arrived_ns"]) % step_ns
    phase_ms = _circular_median(after_arrival, step_ns) / 1e6 + transport_ns / 1e6
    compute_ms = float(np.median(write_arrived_ns - served_ns)) / 1e6
    ticks = round(study.live_duration_s * 1e9 / step_ns)

    first = int(report.table["basis_step"][0])
    begin = int(np.searchsorted(states["step"], first))
    window = states["position"][begin : begin + ticks, :2]
    scenario = study.task.scenario()
    times = np.arange(len(window)) * step_ns * 1e-9
    size = np.maximum(np.abs(scenario.offset[:2]), np.abs(scenario.amplitude[:2]))
    at_rest = 0.5 * np.maximum(size, np.radians(0.1))
    (error,), (live_settled,) = _tracking_error((window - scenario.goal(times).T[:, :2])[:, :, np.newaxis], at_rest)
    live_samples = report.table["loop"] / 1e6
    live = RunMetrics(*_latency(live_samples), error_rms_deg=float(error), settled=bool(live_settled))

    loop = own.model_copy(
        update={
            "phase_ms": phase_ms,
            "compute_ms": compute_ms,
            "transport_ms": transport_ns / 1e6,
            "duration_s": study.live_duration_s,
        }
    )
    # No failure limit: a live run is not stopped when its error is large.
    task = study.task.model_copy(update={"limit": (1e6, 1e6, 1e9, 1e6)})
    twin_study = study.model_copy(update={"loop": loop, "task": task})
    cells = np.zeros(TWIN_RUNS, CELL_DTYPE)
    cells[:] = cell[0]
    cells["run"] = np.arange(TWIN_RUNS)
    _, outcome = run_cells(twin_study, cells, folder, keep=True)
    twin_error = outcome.positions[:, :2] - scenario.goal(np.arange(ticks) * step_ns * 1e-9).T[:, :2, np.newaxis]
    errors, settled = _tracking_error(twin_error, at_rest)
    timing = loop.timing(float(cell["step_ms"][0]), float(cell["poll_ms"][0]))
    samples = [line.samples_ns / 1e6 for line in timelines(twin_study, cells, timing, ticks)]
    all_samples = np.concatenate(samples)
    virtual = RunMetrics(*_latency(all_samples), error_rms_deg=float(errors.mean()), settled=bool(settled.mean() > 0.5))
    tolerance_ms = LOOP_TOLERANCE_STEPS * step_ns / 1e6 + 3 * float(all_samples.std()) / np.sqrt(len(live_samples))
    tolerance_deg = ERROR_TOLERANCE * virtual.error_rms_deg + ERROR_FLOOR_DEG + 3 * float(errors.std())
    agree = abs(live.loop_mean_ms - virtual.loop_mean_ms) <= tolerance_ms
    agree &= abs(live.error_rms_deg - virtual.error_rms_deg) <= tolerance_deg
    if settled.all() or not settled.any():
        agree &= live.settled == virtual.settled
    return TwinComparison(
        live, virtual, phase_ms, compute_ms, _ks(live_samples, all_samples, step_ns / 1e6), bool(agree)
    )


def _latency(samples_ms: Floats) -> tuple[float, float, float]:
    p50, p95 = np.percentile(samples_ms, (50, 95))
    return float(p50), float(p95), float(samples_ms.mean())


def _tracking_error(errors: Floats, at_rest: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the root mean square, degrees, (N,), of errors, rad, (T, 2, N), and which runs settled, (N,).

    A run is settled if the root mean square of the last fifth is at most `at_rest`, rad, (2,).
    """
    tail = errors[-max(1, len(errors) // 5) :]
    settled = (np.sqrt((tail**2).mean(axis=0)) <= at_rest[:, np.newaxis]).all(axis=0)
    return np.degrees(np.sqrt((errors**2).mean(axis=(0, 1)))), settled


def _circular_median(values: NDArray[np.int64], period: int) -> float:
    """Return the median of periodic times, taken around their circular mean."""
    angle = 2 * np.pi * values / period
    center = np.angle(np.exp(1j * angle).mean()) / (2 * np.pi) * period
    away = (values - center + period / 2) % period - period / 2
    return float((center + np.median(away)) % period)


def _ks(live_ms: Floats, virtual_ms: Floats, step_ms: float) -> float:
    """Return the Kolmogorov-Smirnov distance, evaluated halfway between multiples of the step."""
    largest_ms = max(float(live_ms.max()), float(virtual_ms.max()))
    at = (np.arange(int(largest_ms / step_ms) + 2) + 0.5) * step_ms
    shares = [np.searchsorted(np.sort(samples), at, side="right") / len(samples) for samples in (live_ms, virtual_ms)]
    return float(np.abs(shares[0] - shares[1]).max())
