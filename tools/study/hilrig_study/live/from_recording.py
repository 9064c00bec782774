"""Evaluation of controller gains under the loop latency of a recording: stability, delay margin and expected cost.

The age of the acting command at each tick of the recording is modeled as a Markov chain (`expected_cost.age_chain`).
Under it, the loop of a controller that polls once per step is a Markov jump linear system, for which mean-square growth
and expected cost are exact.
"""

from bisect import bisect_left
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.distribution import Statistics
from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.io.run import Run
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import AUTO, RigParameters
from hilrig_study.controllers.control_laws import LawController
from hilrig_study.linear_model import linearize
from hilrig_study.study_config import AxisConfig, ControllerConfig, StudyConfig
from hilrig_study.theory.expected_cost import (
    AgeChain,
    age_chain,
    expected_cost,
    mean_square_radius,
    transition_matrices,
)
from hilrig_study.theory.margins import linearize_law

Ints = NDArray[np.int64]

DEFAULT_GAINS: Final = np.round(np.geomspace(0.1, 2.0, 14), 3)
"""Gain factors evaluated by default, without a study file."""
MAX_RECORDED_AGE_STEPS: Final = 12
"""Upper limit of the age, steps; larger ages are clipped, because they are rare stalls."""
MAX_SPARE_STEPS: Final = 6
"""Largest additional delay that is tried, steps."""
_MIN_STOP_DISTANCE: Final = np.array([0.01, 0.01, 0.001, 0.01])


@dataclass(frozen=True, slots=True)
class GainVerdict:
    """Stability and cost of one controller at one gain under the recorded latency."""

    controller: str
    gain: float
    stable: bool
    """Mean-square stable."""
    mean_square_radius: float
    """Growth of the second moment per step."""
    expected_cost: float | None
    """Expected cost of the study's task (default: a step of 3°, 3°, 5 mm, 3° in 10 s); None: unstable."""
    spare_ms: float | None
    """Delay margin: largest constant additional delay, in whole steps; None: unstable."""
    spare_at_least: bool
    """Whether the loop is stable at the largest delay that was tried."""


@dataclass(frozen=True, slots=True)
class GainReport:
    """Loop latency of a recording and the verdicts on the gains."""

    session: str
    step_ms: float
    samples: int
    latency_ms: tuple[float, float, float]
    """Loop latency of new commands: p50, p99, maximum."""
    age_ms: Statistics
    """Age of the acting command's basis at each step, as in `hilrig latency`."""
    gains: tuple[GainVerdict, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        p50, p99, largest = self.latency_ms
        return {
            "session": self.session,
            "step_ms": self.step_ms,
            "latency": {"samples": self.samples, "p50_ms": p50, "p99_ms": p99, "max_ms": largest},
            "age_ms": asdict(self.age_ms),
            "gains": [asdict(gain) for gain in self.gains],
        }


def recorded_ages(report: LatencyReport) -> list[Ints]:
    """Return the ages of the acting command, steps, (T,), of each stretch of steps that have an age.

    The ages are those of `hilrig latency`; they are clipped to `MAX_RECORDED_AGE_STEPS`.

    Raises:
        InputError: no command took effect, or states are missing.
    """
    if report.ages is None:
        raise InputError(f"{report.session}: no loop latency: {report.reason_text()}")
    rows = np.concatenate(list(report.ages.rows("step", "incarnation", "basis_step", "age_ns")))
    steps = rows["step"].astype(np.int64)
    continues = np.diff(rows["incarnation"]) == 0
    gaps = np.flatnonzero(continues & (np.diff(steps) != 1))
    if len(gaps):
        at = int(steps[gaps[0]])
        missing = int(steps[gaps[0] + 1]) - at - 1
        raise InputError(
            f"{report.session}: {missing} states are missing after step {at} ({len(gaps)} gaps in total), so the age "
            "of the acting command is unknown there; use a recording without losses"
        )
    ages = np.where(rows["age_ns"] > 0, steps - rows["basis_step"].astype(np.int64), 0)
    ends = np.flatnonzero(~continues | (np.diff((ages > 0).astype(np.int8)) != 0)) + 1
    stretches = np.split(np.clip(ages, 0, MAX_RECORDED_AGE_STEPS), ends)
    return [stretch for stretch in stretches if stretch[0] > 0]


def evaluate_gains(run: Run, study: StudyConfig | None = None) -> GainReport:
    """Evaluate gains under the latency of a recording: those of a study file, or a PD with factors from 0.1 to 2.

    Raises:
        InputError: as `recorded_ages`; or the recording has no parameters of its rig.
    """
    report = measure(run)
    chain = age_chain(recorded_ages(report))
    if report.loop_ms is None or report.age_ms is None:
        raise InputError(f"{run.path}: no latency to evaluate: {report.reason_text()}")
    rig = RigParameters.from_json(run.parameters_json)
    median = np.median(run.states["position"], axis=0)
    pose = np.clip(median, rig.arm.lower + _MIN_STOP_DISTANCE, rig.arm.upper - _MIN_STOP_DISTANCE)
    step_s = run.step_ns * 1e-9
    plant_model = linearize(rig.arm, pose.tolist())
    method = () if rig.sim.substeps == AUTO else (rig.sim.integrator, rig.sim.substeps)
    phi, gamma = plant_model.discretize(step_s, *method)
    loop_ms = report.loop_ms
    plane = study or StudyConfig(x=AxisConfig(what="delay_ms", values=(0.0,)), y=AxisConfig(what="gain", values=(1.0,)))
    offset, ticks = plane.task.scenario().offset, round(plane.loop.duration_s / step_s)
    verdicts = []
    for config in plane.controllers:
        for gain in _gains(study).tolist():
            controller = _law(config, rig, near_period=step_s, gain=gain, pose=pose.tolist())
            law = linearize_law(controller, plant_model, step_s, loop_ms.p50 / 1e3)

            def radius(added: int, law: Any = law) -> float:
                shifted = AgeChain(np.where(chain.ages > 0, chain.ages + added, 0), chain.transition, chain.start)
                return mean_square_radius(shifted, transition_matrices(phi, gamma, law, shifted.max_age))

            growth = radius(0)
            stable = growth < 1.0
            cost = expected_cost(plant_model, phi, gamma, controller, law, chain, offset, ticks) if stable else None
            # The number of added steps, from 1 on, with which the loop is stable.
            tried = range(1, MAX_SPARE_STEPS + 1)
            spare = bisect_left(tried, 1.0, key=radius) if stable else None
            spare_ms = None if spare is None else spare * run.step_ns / 1e6
            verdicts.append(GainVerdict(config.name, gain, stable, growth, cost, spare_ms, spare == MAX_SPARE_STEPS))
    return GainReport(
        run.session,
        run.step_ns / 1e6,
        report.samples,
        (loop_ms.p50, loop_ms.p99, loop_ms.max),
        report.age_ms,
        tuple(verdicts),
    )


def _gains(study: StudyConfig | None) -> NDArray[np.float64]:
    for axis in () if study is None else (study.x, study.y):
        if axis.what == "gain":
            stride = max(1, -(-len(axis.points) // len(DEFAULT_GAINS)))
            return axis.points[::stride]
    return DEFAULT_GAINS


def _law(
    config: ControllerConfig, rig: RigParameters, *, near_period: float, gain: float, pose: list[float]
) -> LawController:
    if config.kind == "file":
        raise InputError(
            f"controller {config.name!r}: kind 'file' can't be linearized; use pd, pid, computed_torque or lqr"
        )
    built = config.build(rig, linearize(rig.arm, pose), near_period, np.array([gain]))
    assert isinstance(built, LawController)
    return built
