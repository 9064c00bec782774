"""Checks whether the configured integration is accurate over the range of the torque registers."""

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_sim.arm.model import LARGEST_REGISTER_FORCE, ArmParameters, RigParameters, StepParameters
from hilrig_sim.arm.stability import ERROR_BOUND
from hilrig_sim.plant.plant import Plant

TRIALS: Final = 32
"""Number of simulated rigs."""
TRIAL_STEPS: Final = 60
"""Number of steps of each; their efforts have the largest magnitude of the registers and random signs."""


def accuracy_warnings(rigs: Mapping[str, RigParameters]) -> Iterator[str]:
    """Yield a warning for each arm whose motion cannot be integrated accurately under all torques of the registers."""
    names: dict[tuple[ArmParameters, StepParameters], list[str]] = {}
    for name, rig in rigs.items():
        names.setdefault((rig.arm, rig.sim), []).append(name)
    for (arm, sim), of_arm in names.items():
        failure = _failure(RigParameters(arm=arm, sim=sim))
        if failure is not None:
            others = f" and {len(of_arm) - 1} more" if len(of_arm) > 1 else ""
            remedy = "use a shorter sim.step_ms"
            if sim.substeps != "auto":
                remedy = f'set sim.substeps = "auto", or {remedy}'
            yield f"{of_arm[0]}{others}: at the largest torques {failure}; {remedy}"


def _failure(rig: RigParameters) -> str | None:
    plant = Plant([rig] * TRIALS)
    random = np.random.default_rng(0)
    worst, inaccurate = np.zeros(4), 0
    magnet = np.zeros(TRIALS, dtype=np.bool_)
    with np.errstate(all="ignore"):
        for _ in range(TRIAL_STEPS):
            plant.step(random.choice((-LARGEST_REGISTER_FORCE, LARGEST_REGISTER_FORCE), (4, TRIALS)), magnet)
            if not np.isfinite(plant.velocity).all():
                return "the simulation diverges"
            error = np.abs(plant.error)
            worst = np.maximum(worst, error.max(axis=1))
            inaccurate += int((error > np.array(ERROR_BOUND)[:, np.newaxis]).any(axis=0).sum())
    if not inaccurate:
        return None
    joint = int(np.argmax(worst / ERROR_BOUND))
    share = 100 * inaccurate / (TRIALS * TRIAL_STEPS)
    unit = "mm" if joint == 2 else "°"
    return f"{share:.2g} % of the steps are inaccurate, by up to {worst[joint] * JOINT_SCALE[joint]:.2g} {unit}"
