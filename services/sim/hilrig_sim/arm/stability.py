"""Is a step short enough? The fastest mode of the arm against the limit of the method.

An explicit method of step h follows a mode that decays with λ only while h·λ stays below the method's limit on the
negative real axis; beyond it the simulation blows up, as the paper's figure 4 shows.
"""

import math
from typing import Final

import numpy as np

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.dynamics import mass_matrix
from hilrig_sim.arm.integrators import TABLEAUS
from hilrig_sim.arm.model import ArmParameters, RigParameters

MARGIN: Final = 0.2
"""Share of the limit that must be left."""


def fastest_mode(arm: ArmParameters, theta2: float | None = None, payload: float = 0.0) -> float:
    """Largest decay rate of the joint velocities, 1/s: eigenvalue of M(θ2)⁻¹B at rest.

    Without θ2, the largest over its range. A payload only slows the modes down, so none is the worst case.
    """
    if theta2 is None:
        # The mode is fastest where |cos θ2| is largest: straight, or folded as far as the stops allow.
        ends = [arm.lower[1], arm.upper[1], *(k * math.pi for k in (-2, -1, 0, 1, 2))]
        return max(fastest_mode(arm, t, payload) for t in ends if arm.lower[1] <= t <= arm.upper[1])
    rates = np.linalg.eigvals(np.linalg.solve(mass_matrix(arm, theta2, payload), np.diag(arm.friction)))
    return float(np.max(rates.real))


def largest_safe_step(arm: ArmParameters, integrator: str) -> float:
    """Longest integration step that leaves the margin, s; infinity where nothing decays."""
    rate = fastest_mode(arm)
    return math.inf if rate == 0 else (1 - MARGIN) * TABLEAUS[integrator].negative_real_limit() / rate


def check_stable(parameters: RigParameters) -> None:
    """Refuse a step that is too long for the arm.

    Raises:
        InputError: less than the margin is left; the largest safe step and the sub-steps that would do are named.
    """
    sim = parameters.sim
    safe = largest_safe_step(parameters.arm, sim.integrator)
    step = sim.step / sim.substeps
    if step > safe:
        each = f" in {sim.substeps} sub-steps" if sim.substeps > 1 else ""
        raise InputError(
            f"the step of {sim.step * 1e3:g} ms{each} would be unstable with {sim.integrator}: the arm's fastest mode "
            f"is {fastest_mode(parameters.arm):.1f} 1/s, so the largest safe step is {safe * 1e3:.1f} ms "
            f"({MARGIN:.0%} margin); give sim.substeps = {math.ceil(sim.step / safe)} or a shorter sim.step_ms"
        )
