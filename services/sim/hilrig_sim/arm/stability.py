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
from hilrig_sim.arm.model import AUTO, LARGEST_REGISTER_FORCE, ArmParameters, RigParameters, StepParameters

STABILITY_MARGIN: Final = 0.2
"""Required safety margin, as a fraction of the limit."""

RESOLVED_DECAY: Final = 1.3
"""Largest λh with which `rkf45` resolves a decaying mode: the error of its speed is below 0.5 % of its amplitude."""
RESOLVED_TURN: Final = 0.2
"""Largest turn of joint 2 in an integration step, relative to the range of θ2 in which the inertia changes."""
SLOW_TURN: Final = 0.3
"""Turn of an arm against its friction at the largest torque, relative to this range, up to which no turn is limited:
for the default arm it is 0.26."""
MAX_SUBSTEPS: Final = 64
"""Largest number of integration steps of a rig in a step of the loop, if it is chosen automatically."""
ERROR_BOUND: Final = (math.radians(0.1), math.radians(0.1), 0.1e-3, math.radians(0.1))
"""Error estimate of a step above which it is reported as inaccurate: 0.1° or 0.1 mm; rad, rad, m, rad."""
MOST_FIXED_SUBSTEPS: Final = 100
"""Largest fixed number, as in the configuration."""


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
    return max(1, math.ceil(fastest_mode(arm) * sim.step / RESOLVED_DECAY - 1e-9))


def longest_turn(arm: ArmParameters, sim: StepParameters) -> float:
    """Return the largest turn of joint 2 in an integration step that resolves the motion, rad.

    The determinant of the mass matrix is proportional to m1 + (m2 + m3) sin²θ2: the inertia changes where the links are
    nearly in line. A step that turns through a large part of this range is inaccurate, and its error estimate can
    be small by chance. Infinity: friction keeps the arm so slow that the decay of its modes limits the step.
    """
    m1, m2, m3 = arm.masses
    width = math.sqrt(m1 / (m1 + m2 + m3))
    step = sim.step / base_substeps(arm, sim)
    is_slow = LARGEST_REGISTER_FORCE * step <= SLOW_TURN * width * min(arm.friction[:2])
    return math.inf if is_slow or sim.plant_version <= 2 else RESOLVED_TURN * width


def check_stable(parameters: RigParameters) -> None:
    """Check that the step is short enough for the arm.

    Raises:
        InputError: it is not; the message has the remedy.
    """
    sim, arm = parameters.sim, parameters.arm
    mode = f"the arm's fastest mode is {fastest_mode(arm):.1f} 1/s"
    if sim.substeps == AUTO:
        if TABLEAUS[sim.integrator].embedded is None:
            raise InputError(
                f'sim.substeps = "auto" needs an integrator with an error estimate (rkf45), and {sim.integrator} has '
                f"none; set a number of sub-steps"
            )
        needed = base_substeps(arm, sim)
        if needed > MAX_SUBSTEPS:
            longest = sim.step * MAX_SUBSTEPS / needed
            raise InputError(
                f"the step of {sim.step * 1e3:g} ms is too long for this arm: {mode}, which needs {needed} sub-steps "
                f"(at most {MAX_SUBSTEPS}); set sim.step_ms to {_milliseconds(longest)} or less, or a heavier arm or "
                f"less friction"
            )
        return
    safe = largest_safe_step(arm, sim.integrator)
    step = sim.step / sim.substeps
    if step > safe:
        each = f" in {sim.substeps} sub-steps" if sim.substeps > 1 else ""
        needed = math.ceil(sim.step / safe)
        more = f"set sim.substeps = {needed} or a shorter sim.step_ms"
        if needed > MOST_FIXED_SUBSTEPS:
            shorter = _milliseconds(MOST_FIXED_SUBSTEPS * safe)
            more = f"set sim.step_ms to {shorter} or less with sim.substeps = {MOST_FIXED_SUBSTEPS}"
        raise InputError(
            f"the step of {sim.step * 1e3:g} ms{each} would be unstable with {sim.integrator}: {mode}, so the largest "
            f"safe step is {_milliseconds(safe)} ms ({STABILITY_MARGIN:.0%} margin); {more}"
        )


def _milliseconds(time_s: float) -> str:
    """Return a time in ms with three digits, rounded down."""
    digits = 2 - math.floor(math.log10(time_s * 1e3))
    return f"{math.floor(time_s * 1e3 * 10**digits) / 10**digits:g}"
