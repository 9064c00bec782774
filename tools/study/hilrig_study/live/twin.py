"""A live point beside its twin in virtual time: what was recorded, what the same loop does without a clock, and how far
they are apart.

The twin has the loop's own times as the recording tells them (phase, the controller's time, transport; medians) and
draws its delays anew from what was injected, several times over. Joints 1 and 2 are compared: the quill drops while a
rig waits for its controller, and they do not feel it.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import Run
from hilrig_runtime.errors import InputError
from hilrig_study.study_config import StudyConfig
from hilrig_study.sweep import CELL, run_cells, timelines

Floats = NDArray[np.float64]

TWINS: Final = 20
"""Virtual runs of a live one: their spread tells what is chance."""
LOOP_TOLERANCE_STEPS: Final = 0.5
"""Means of the loop latency may differ by this, and by three standard errors of what is drawn."""
ERROR_TOLERANCE: Final = 0.15
"""Tracking errors may differ by this share, by 0.05°, and by three standard deviations of the twins."""
ERROR_FLOOR_DEG: Final = 0.05


@dataclass(frozen=True, slots=True)
class Observed:
    """What a run did, live or virtual."""

    loop_p50_ms: float
    loop_p95_ms: float
    loop_mean_ms: float
    error_rms_deg: float
    """Of joints 1 and 2 together, over the run."""
    settled: bool


@dataclass(frozen=True, slots=True)
class Comparison:
    """A live point beside its twins."""

    live: Observed
    virtual: Observed
    """Means over the twins; settled: most of them."""
    phase_ms: float
    """Of the controller's reads behind the ticks, as recorded."""
    compute_ms: float
    """From read to write, as recorded."""
    latency_ks: float
    """Largest distance between the two distributions of the loop latency, 0 to 1."""
    as_predicted: bool

    def as_dict(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)


def compare_with_twins(study: StudyConfig, cell: NDArray[np.void], run: Run, folder: Path) -> Comparison:
    """Measure a recording of a live point, and run its twins.

    Args:
        study: of which it is a point.
        cell: the point, (1,), fields as `CELL`.
        run: its recording.
        folder: of the study's file.

    Raises:
        InputError: the recording has no commands of a controller.
    """
    report = measure(run)
    if len(report.table) < 10:
        raise InputError(f"{run.path}: only {len(report.table)} commands took effect: there is no loop to compare")
    commands, states = run.commands, run.states
    answered = commands[commands["state_served_ns"] > 0]
    step_ns, own = run.step_ns, study.loop
    transport_ns = float(np.median(report.table["transport"])) / 2
    after_arrival = (answered["state_served_ns"] - answered["state_arrived_ns"]) % step_ns
    phase_ms = _circular_median(after_arrival, step_ns) / 1e6 + transport_ns / 1e6
    compute_ms = float(np.median(answered["write_arrived_ns"] - answered["state_served_ns"])) / 1e6
    ticks = round(study.live_duration_s * 1e9 / step_ns)

    first = int(report.table["basis_step"][0])
    begin = int(np.searchsorted(states["step"], first))
    window = states["position"][begin : begin + ticks, :2]
    scenario = study.task.scenario()
    times = np.arange(len(window)) * step_ns * 1e-9
    size = np.maximum(np.abs(scenario.offset[:2]), np.abs(scenario.amplitude[:2]))
    at_rest = 0.5 * np.maximum(size, np.radians(0.1))
    (error,), (came_to_rest,) = _judged((window - scenario.goal(times).T[:, :2])[:, :, np.newaxis], at_rest)
    live_samples = report.table["loop"] / 1e6
    live = Observed(*_latency(live_samples), error_rms_deg=float(error), settled=bool(came_to_rest))

    loop = own.model_copy(
        update={
            "phase_ms": phase_ms,
            "compute_ms": compute_ms,
            "transport_ms": transport_ns / 1e6,
            "duration_s": study.live_duration_s,
        }
    )
    # No limit: a live run goes on when its error is large.
    task = study.task.model_copy(update={"limit": (1e6, 1e6, 1e9, 1e6)})
    twin_study = study.model_copy(update={"loop": loop, "task": task})
    cells = np.zeros(TWINS, CELL)
    cells[:] = cell[0]
    cells["run"] = np.arange(TWINS)
    _, outcome = run_cells(twin_study, cells, folder, keep=True)
    twin_error = outcome.positions[:, :2] - scenario.goal(np.arange(ticks) * step_ns * 1e-9).T[:, :2, np.newaxis]
    errors, settled = _judged(twin_error, at_rest)
    timing = loop.timing(float(cell["step_ms"][0]), float(cell["poll_ms"][0]))
    samples = [line.samples_ns / 1e6 for line in timelines(twin_study, cells, timing, ticks)]
    every = np.concatenate(samples)
    virtual = Observed(*_latency(every), error_rms_deg=float(errors.mean()), settled=bool(settled.mean() > 0.5))
    slack_ms = LOOP_TOLERANCE_STEPS * step_ns / 1e6 + 3 * float(every.std()) / np.sqrt(len(live_samples))
    slack_deg = ERROR_TOLERANCE * virtual.error_rms_deg + ERROR_FLOOR_DEG + 3 * float(errors.std())
    agree = abs(live.loop_mean_ms - virtual.loop_mean_ms) <= slack_ms
    agree &= abs(live.error_rms_deg - virtual.error_rms_deg) <= slack_deg
    if settled.all() or not settled.any():
        agree &= live.settled == virtual.settled
    return Comparison(live, virtual, phase_ms, compute_ms, _ks(live_samples, every, step_ns / 1e6), bool(agree))


def _latency(samples_ms: Floats) -> tuple[float, float, float]:
    p50, p95 = np.percentile(samples_ms, (50, 95))
    return float(p50), float(p95), float(samples_ms.mean())


def _judged(errors: Floats, at_rest: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Of runs' errors, rad, (T, 2, N): root mean square, degrees, and whether the last fifth is within `at_rest`, rad,
    (2,)."""
    tail = errors[-max(1, len(errors) // 5) :]
    settled = (np.sqrt((tail**2).mean(axis=0)) <= at_rest[:, np.newaxis]).all(axis=0)
    return np.degrees(np.sqrt((errors**2).mean(axis=(0, 1)))), settled


def _circular_median(values: NDArray[np.int64], period: int) -> float:
    """Median of times on a circle: around the mean direction."""
    angle = 2 * np.pi * values / period
    centre = np.angle(np.exp(1j * angle).mean()) / (2 * np.pi) * period
    away = (values - centre + period / 2) % period - period / 2
    return float((centre + np.median(away)) % period)


def _ks(live_ms: Floats, virtual_ms: Floats, step_ms: float) -> float:
    """Distance of the distributions, compared between multiples of the step, where neither has mass."""
    most = max(float(live_ms.max()), float(virtual_ms.max()))
    at = (np.arange(int(most / step_ms) + 2) + 0.5) * step_ms
    shares = [np.searchsorted(np.sort(samples), at, side="right") / len(samples) for samples in (live_ms, virtual_ms)]
    return float(np.abs(shares[0] - shares[1]).max())
