"""The latency of a real session, put under other gains: which would have been stable, and with what to spare?

The age of what acted at each tick of the recording is a Markov chain (`expected_cost.age_chain`). Under it the loop of
a controller that polls once a step is a jump linear system, whose mean-square growth and expected cost are exact.
"""

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows
from hilrig_replay.io.run import Run
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import RigParameters
from hilrig_study.controllers.controllers import LawController
from hilrig_study.study_config import AxisConfig, ControllerConfig, StudyConfig
from hilrig_study.theory.expected_cost import AgeChain, age_chain, expected_cost, mean_square_radius, turns
from hilrig_study.theory.linear import linearise
from hilrig_study.theory.margins import linearise_law

Ints = NDArray[np.int64]

GAINS: Final = np.round(np.geomspace(0.1, 2.0, 14), 3)
"""Gain factors that are judged where no study's file names others."""
LONGEST: Final = 12
"""Ages beyond this, steps, count as so many: a stall is no latency, and what is rare adds little."""
MOST_SPARE: Final = 6
"""Further delays up to this are tried, steps."""
_INSIDE: Final = np.array([0.01, 0.01, 0.001, 0.01])


@dataclass(frozen=True, slots=True)
class GainVerdict:
    """One controller at one gain under the recorded latency."""

    controller: str
    gain: float
    stable: bool
    """In the mean square."""
    mean_square_radius: float
    """Growth of the mean square a step."""
    expected_cost: float | None
    """Of going 3°, 3°, 5 mm, 3° in 10 s, or as the study's file says; None: it is not stable."""
    spare_ms: float | None
    """Constant delay that could have been added, in whole steps; None: it is not stable."""
    spare_at_least: bool
    """More than `spare_ms` was not tried."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A recording's latency and what gains it would have borne."""

    session: str
    step_ms: float
    samples: int
    ages_ms: tuple[float, float, float]
    """Loop latency of new commands: p50, p99, largest."""
    gains: tuple[GainVerdict, ...]

    def as_dict(self) -> dict[str, Any]:
        """As plain values."""
        p50, p99, largest = self.ages_ms
        return {
            "session": self.session,
            "step_ms": self.step_ms,
            "latency": {"samples": self.samples, "p50_ms": p50, "p99_ms": p99, "max_ms": largest},
            "gains": [asdict(gain) for gain in self.gains],
        }


def recorded_ages(run: Run) -> list[Ints]:
    """Age of what acts at each tick, steps, (T,), from the first command on, of each start of the simulation.

    Raises:
        InputError: no command took effect, or states are missing in between, whose ages nobody knows.
    """
    sequences = []
    states = run.states
    for incarnation in np.unique(states["incarnation"]):
        mine: Rows = states[states["incarnation"] == incarnation]
        steps = mine["step"].astype(np.int64)
        new = np.flatnonzero(mine["basis_step"])
        if not len(new):
            continue
        gaps = np.flatnonzero(np.diff(steps[new[0] :]) != 1)
        if len(gaps):
            at = int(steps[new[0] + gaps[0]])
            missing = int(steps[new[0] + gaps[0] + 1]) - at - 1
            raise InputError(
                f"{run.path}: a trace with gaps: {missing} states are missing after step {at}, so the age of what "
                f"acted is not known there ({len(gaps)} gaps in all); take a recording without losses"
            )
        last = np.maximum.accumulate(np.where(mine["basis_step"] != 0, np.arange(len(mine)), -1))[new[0] :]
        ages = steps[new[0] :] - mine["basis_step"][last].astype(np.int64)
        sequences.append(np.clip(ages[: new[-1] - new[0] + 1], 1, LONGEST))
    if not sequences:
        raise InputError(f"{run.path}: no controller's command took effect in this session, so it has no loop latency")
    return sequences


def judge_gains(run: Run, study: StudyConfig | None = None) -> Judged:
    """Judge gains under a recording's latency: those of a study's file, or a PD's from 0.1 to 2.

    Raises:
        InputError: as `recorded_ages`; or the recording does not say what its rig is.
    """
    sequences = recorded_ages(run)
    chain = age_chain(sequences)
    rig = RigParameters.from_json(run.parameters_json)
    pose = np.clip(np.median(run.states["position"], axis=0), rig.arm.lower + _INSIDE, rig.arm.upper - _INSIDE)
    step_s = run.step_ns * 1e-9
    near = linearise(rig.arm, pose.tolist())
    phi, gamma = near.discretise(step_s, rig.sim.integrator, rig.sim.substeps)
    latency = run.states["loop_latency_ns"][run.states["basis_step"] != 0] / 1e6
    p50, p99 = np.percentile(latency, (50, 99))
    plane = study or StudyConfig(x=AxisConfig(what="delay_ms", values=(0.0,)), y=AxisConfig(what="gain", values=(1.0,)))
    offset, ticks = plane.task.scenario().offset, round(plane.loop.duration_s / step_s)
    verdicts = []
    for config in plane.controllers:
        for gain in _gains(study).tolist():
            controller = _law(config, rig, near_period=step_s, gain=gain, pose=pose.tolist())
            law = linearise_law(controller, near, step_s, float(p50) / 1e3)

            def radius(more: int, law: Any = law) -> float:
                shifted = AgeChain(np.where(chain.ages > 0, chain.ages + more, 0), chain.transition, chain.start)
                return mean_square_radius(shifted, turns(phi, gamma, law, shifted.most))

            now = radius(0)
            stable = now < 1.0
            cost = expected_cost(near, phi, gamma, controller, law, chain, offset, ticks) if stable else None
            spare = _largest(lambda more, of=radius: of(more) < 1.0) if stable else None
            spare_ms = None if spare is None else spare * run.step_ns / 1e6
            verdicts.append(GainVerdict(config.name, gain, stable, now, cost, spare_ms, spare == MOST_SPARE))
    return Judged(
        run.session, run.step_ns / 1e6, len(latency), (float(p50), float(p99), float(latency.max())), tuple(verdicts)
    )


def _gains(study: StudyConfig | None) -> NDArray[np.float64]:
    for axis in () if study is None else (study.x, study.y):
        if axis.what == "gain":
            return axis.points if len(axis.points) <= len(GAINS) else axis.points[:: -(-len(axis.points) // len(GAINS))]
    return GAINS


def _law(
    config: ControllerConfig, rig: RigParameters, *, near_period: float, gain: float, pose: list[float]
) -> LawController:
    if config.kind == "file":
        raise InputError(
            f"controller {config.name!r} is a file: theory needs a law; take pd, pid, computed_torque, lqr"
        )
    built = config.build(rig, linearise(rig.arm, pose), near_period, np.array([gain]))
    assert isinstance(built, LawController)
    return built


def _largest(holds: Any) -> int:
    """Largest number up to `MOST_SPARE` for which it holds, given that it does for 0."""
    low, high = 0, MOST_SPARE + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
