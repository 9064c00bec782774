"""Stability check of the integration step: the fastest mode of the arm against the limit of the method.

An explicit method with step h is stable for a mode with decay rate λ while h·λ is below the method's limit on the
negative real axis. Beyond it the simulation diverges, as in figure 4 of the paper.
"""

import math
from typing import Final

import numpy as np

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.dynamics import mass_matrix
from hilrig_sim.arm.integrators import TABLEAUS
from hilrig_sim.arm.model import ArmParameters, RigParameters, StepParameters

STABILITY_MARGIN: Final = 0.2
"""Required safety margin, as a fraction of the limit."""

RESOLVED_DECAY: Final = {"euler": 0.05, "rk4": 0.8, "rkf45": 1.3}
"""Largest λh with which a method resolves a decaying mode: the error of its speed in a step is below 0.5 % of its
amplitude."""


def fastest_mode(arm: ArmParameters, theta2: float | None = None, payload: float = 0.0) -> float:
    """Return the largest decay rate of the joint velocities, 1/s: eigenvalue of M(θ2)⁻¹B at rest.

    Without θ2, the largest one over its range. A payload only makes the modes slower, so no payload is the worst case.
    """
    if theta2 is None:
        # The mode is fastest where |cos θ2| is largest: straight, or folded to a stop.
        ends = [arm.lower[1], arm.upper[1], *(k * math.pi for k in (-2, -1, 0, 1, 2))]
        return max(fastest_mode(arm, t, payload) for t in ends if arm.lower[1] <= t <= arm.upper[1])
    rates = np.linalg.eigvals(np.linalg.solve(mass_matrix(arm, theta2, payload), np.diag(arm.friction)))
    return float(np.max(rates.real))


def largest_safe_step(arm: ArmParameters, integrator: str) -> float:
    """Return the longest integration step with the margin, s; infinity without a decaying mode."""
    rate = fastest_mode(arm)
    return math.inf if rate == 0 else (1 - STABILITY_MARGIN) * TABLEAUS[integrator].negative_real_limit() / rate


def base_substeps(arm: ArmParameters, sim: StepParameters) -> int:
    """Return the number of integration steps that resolve the fastest mode of the arm in a step of the loop."""
    return max(1, math.ceil(fastest_mode(arm) * sim.step / RESOLVED_DECAY[sim.integrator] - 1e-9))


def check_stable(parameters: RigParameters) -> None:
    """Check that the step is short enough for the arm.

    Raises:
        InputError: the margin is violated; the message has the largest safe step and a sufficient number of sub-steps.
    """
    sim = parameters.sim
    safe = largest_safe_step(parameters.arm, sim.integrator)
    step = sim.step / sim.substeps
    if step > safe:
        each = f" in {sim.substeps} sub-steps" if sim.substeps > 1 else ""
        raise InputError(
            f"the step of {sim.step * 1e3:g} ms{each} would be unstable with {sim.integrator}: the arm's fastest mode "
            f"is {fastest_mode(parameters.arm):.1f} 1/s, so the largest safe step is {safe * 1e3:.1f} ms "
            f"({STABILITY_MARGIN:.0%} margin); set sim.substeps = {math.ceil(sim.step / safe)} or a shorter sim.step_ms"
        )
