"""Checks whether the configured integration is accurate over the range of the torque registers."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.integrators import RKF45
from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_sim.arm.model import AUTO, LARGEST_REGISTER_FORCE, ArmParameters, RigParameters, StepParameters
from hilrig_sim.arm.stability import ERROR_BOUND, base_substeps
from hilrig_sim.plant.plant import Plant

Floats = NDArray[np.float64]

TRIALS: Final = 64
"""Number of simulated rigs: half of them have efforts of the largest magnitude and random signs."""
RUN_UP_STEPS: Final = 4
"""Steps in which they gain speed."""
TRIAL_STEPS: Final = 12
"""Steps of each that are compared with shorter ones."""
WARNING_SHARE: Final = 0.5
"""Error of a trial above which an arm is reported, relative to `ERROR_BOUND`: other efforts have larger ones."""


def accuracy_warnings(rigs: Mapping[str, RigParameters]) -> Iterator[str]:
    """Yield a warning for each arm whose motion cannot be integrated accurately under all torques of the registers.

    An arm takes 0.3 s, a very light one a few seconds.
    """
    names: dict[tuple[ArmParameters, StepParameters], list[str]] = {}
    for name, rig in rigs.items():
        names.setdefault((rig.arm, rig.sim), []).append(name)
    for (arm, sim), of_arm in names.items():
        failure = _failure(RigParameters(arm=arm, sim=sim))
        if failure is not None:
            others = f" and {len(of_arm) - 1} more" if len(of_arm) > 1 else ""
            remedy = "use a shorter sim.step_ms"
            if sim.substeps != AUTO:
                remedy = f'set sim.substeps = "{AUTO}", or {remedy}'
            yield f"{of_arm[0]}{others}: at the largest torques {failure}; {remedy}"


def _failure(rig: RigParameters) -> str | None:
    with np.errstate(all="ignore"):
        error = np.concatenate([error for *_, error in step_errors(rig, np.random.default_rng(0))], axis=1)
    if not np.isfinite(error).all():
        return "the simulation diverges"
    shares = error / np.array(ERROR_BOUND)[:, np.newaxis]
    inaccurate = (shares > WARNING_SHARE).any(axis=0)
    if not inaccurate.any():
        return None
    joint = int(np.argmax(shares.max(axis=1)))
    unit = " mm" if joint == 2 else "°"
    worst = error[joint].max() * JOINT_SCALE[joint]
    return f"{100 * inaccurate.mean():.2g} % of the steps are inaccurate, by up to {worst:.2g}{unit}"


def step_errors(rig: RigParameters, random: np.random.Generator) -> Iterator[tuple[Plant, Floats, Floats]]:
    """Yield the plant after each of `TRIAL_STEPS` steps, its efforts and its position errors, (4, N) each.

    The reference is the same motion with at least three times as many integration steps.
    """
    plant, magnet, rows = Plant([rig] * TRIALS), np.zeros(TRIALS, dtype=np.bool_), range(TRIALS)
    parts = 1 << (3 * base_substeps(rig.arm, rig.sim) - 1).bit_length()
    short = replace(rig.sim, step_ns=max(1, rig.sim.step_ns // parts), substeps=AUTO, integrator=RKF45.name)
    reference = Plant([replace(rig, sim=short)] * TRIALS)
    for step in range(RUN_UP_STEPS + TRIAL_STEPS):
        efforts = random.uniform(-LARGEST_REGISTER_FORCE, LARGEST_REGISTER_FORCE, (4, TRIALS))
        efforts[:, ::2] = np.copysign(LARGEST_REGISTER_FORCE, efforts[:, ::2])
        reference.copy_state_from(plant, rows, rows)
        plant.step(efforts, magnet)
        if step >= RUN_UP_STEPS:
            for _ in range(parts):
                reference.step(efforts, magnet)
            yield plant, efforts, np.abs(plant.position - reference.position)
