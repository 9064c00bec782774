"""Reproduces experiment (44) of the paper with its three integration methods: figures 4, 5 and 6, and their numbers.

Two torque pulses move joints 1 and 2 of an arm at rest. At the paper's step of 20 ms, Euler's method exceeds its
stability limit and diverges, Runge–Kutta–Fehlberg is stable, and Dormand–Prince with a variable step is the reference.
The whole curves of the fixed step and of automatic sub-steps are compared with it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.dynamics import ReducedDynamics, stage_views
from hilrig_sim.arm.integrators import EULER, RK4, RKF45, Tableau, reference_solution
from hilrig_sim.arm.model import GRAVITY, ArmParameters, RigParameters, SceneParameters, StepParameters
from hilrig_sim.arm.stability import fastest_mode
from hilrig_sim.arm.stepping import FixedStep
from hilrig_sim.plant.plant import Plant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

DURATION_S: Final = 10.0
PAPER_STEP_MS: Final = 20.0
# In the plane only the sum of m2 and m3 matters. The paper has 1 kg and 0 kg; here the quill has half of the sum,
# because joint 3 can't be simulated without mass. A constant force on joint 3 compensates its weight.
ARM: Final = ArmParameters(masses=(1.0, 0.5, 0.5), friction=(2.0, 2.0, 5.0, 0.05))
TORQUE_SWITCH_TIMES_S: Final = (2.0, 3.0, 5.0, 6.0)
EXPECTED_END_RAD: Final = (0.05000, 0.19998)
"""θ(10 s), rad: b·Δθ = ∫τ dt, except for the remaining motion."""
EXPECTED_LIMITS_MS: Final = {"euler": 15.4, "rk4": 21.5, "rkf45, order 4": 23.3, "rkf45": 28.4}
DIVERGENCE_SPEED_RAD_S: Final = 1.0
"""A faster joint has diverged: this is twenty times the speed that the torques can reach against friction.

The growth is bounded, because the sines in the model are: a diverged solution oscillates at the step rate."""


def torque(time_s: float) -> tuple[float, float]:
    """τ1 = 0.05(u(t−3) − u(t−5)), τ2 = 0.1(u(t−2) − u(t−6)), N·m, (44)."""
    return (0.05 if 3.0 <= time_s < 5.0 else 0.0), (0.1 if 2.0 <= time_s < 6.0 else 0.0)


@dataclass(frozen=True, slots=True)
class Solution:
    """Solution of experiment (44) by one method."""

    name: str
    title: str
    time_s: Floats
    """(n,)."""
    position: Floats
    """θ1, θ2, rad, (2, n)."""
    velocity: Floats
    """θ̇1, θ̇2, rad/s, (2, n)."""

    @property
    def diverged_s(self) -> float | None:
        """Time at which the solution diverged, s; None: it did not."""
        beyond = ~(np.abs(self.velocity) < DIVERGENCE_SPEED_RAD_S).all(axis=0)
        return float(self.time_s[np.argmax(beyond)]) if beyond.any() else None

    @property
    def end(self) -> tuple[float, float] | None:
        """θ1, θ2 at the end, rad; None: the solution diverged."""
        return None if self.diverged_s is not None else (float(self.position[0, -1]), float(self.position[1, -1]))


@dataclass(frozen=True, slots=True)
class ExperimentResult:
    """Solutions of experiment (44) by all methods."""

    step_ms: float
    mode: float
    """Fastest mode at θ2 = 0, 1/s."""
    euler: Solution
    reference: Solution
    fehlberg: Solution
    automatic: Solution
    """Runge–Kutta–Fehlberg with automatic sub-steps, the default of a lab."""
    at_steps: Solution
    """The reference at the times of the fixed steps."""
    limits_ms: dict[str, float]
    """Largest stable step of each method, ms."""

    @property
    def deviation(self) -> float | None:
        """Deviation of Runge–Kutta–Fehlberg from the reference at the end, rad; None: it diverged."""
        end, reference = self.fehlberg.end, self.reference.end
        return (
            None if end is None or reference is None else max(abs(e - r) for e, r in zip(end, reference, strict=True))
        )

    def curve_errors(self, solution: Solution) -> tuple[float, float]:
        """Return the largest errors of positions, rad, and of speeds, as a share of their peak, over all steps."""
        position = float(np.abs(solution.position - self.at_steps.position).max())
        peak = np.abs(self.at_steps.velocity).max(axis=1, keepdims=True)
        return position, float((np.abs(solution.velocity - self.at_steps.velocity) / peak).max())

    def checks(self) -> list[tuple[str, str, str, bool]]:
        """Rows (quantity, expected value at the paper's step, computed value, agreement)."""
        end, deviation = self.reference.end, self.deviation
        diverged_s = self.euler.diverged_s
        rows = [
            (
                "θ(10 s), reference",
                "0.05000, 0.19998 rad",
                "diverged" if end is None else f"{end[0]:.5f}, {end[1]:.5f} rad",
                end is not None and all(abs(e - x) < 1e-5 for e, x in zip(end, EXPECTED_END_RAD, strict=True)),
            ),
            (
                f"Euler at {self.step_ms:g} ms",
                "diverges",
                "stable"
                if diverged_s is None
                else f"diverges (above {DIVERGENCE_SPEED_RAD_S:g} rad/s at {diverged_s:.2f} s)",
                diverged_s is not None,
            ),
            (
                f"RKF at {self.step_ms:g} ms, deviation from the reference",
                "at most 2e-6 rad",
                "diverged" if deviation is None else f"{deviation:.1e} rad",
                deviation is not None and deviation <= 2.05e-6,
            ),
            self._curves(self.fehlberg, "RKF", 0.0002, 0.13),
            self._curves(self.automatic, "automatic sub-steps", 0.00001, 0.003),
            ("fastest mode at θ2 = 0", "129.5 1/s", f"{self.mode:.1f} 1/s", abs(self.mode - 129.5) < 0.1),
        ]
        for name, expected in EXPECTED_LIMITS_MS.items():
            found = self.limits_ms[name]
            rows.append(
                (f"largest stable step, {name}", f"{expected} ms", f"{found:.2f} ms", abs(found / expected - 1) < 0.01)
            )
        return rows

    def _curves(self, solution: Solution, name: str, most: float, most_speed: float) -> tuple[str, str, str, bool]:
        position, speed = self.curve_errors(solution)
        return (
            f"{name} at {self.step_ms:g} ms, largest errors of the curves",
            f"at most {most:.0e} rad, {most_speed:.1%} of the peak speed",
            f"{position:.1e} rad, {speed:.1%}",
            position <= most and speed <= most_speed,
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON-compatible values."""
        return {
            "step_ms": self.step_ms,
            "fastest_mode_per_s": self.mode,
            "methods": {
                solution.name: {
                    "theta_end_rad": solution.end,
                    "diverged_s": solution.diverged_s,
                    "peak_speed_rad_s": None
                    if solution.diverged_s is not None
                    else np.abs(solution.velocity).max(axis=1).tolist(),
                }
                for solution in (self.euler, self.reference, self.fehlberg, self.automatic)
            },
            "deviation_rad": self.deviation,
            "curve_errors": {
                solution.name: dict(zip(("position_rad", "speed_share"), self.curve_errors(solution), strict=True))
                for solution in (self.fehlberg, self.automatic)
            },
            "limits_ms": self.limits_ms,
            "checks": [
                {"what": what, "expected": expected, "found": found, "holds": holds}
                for what, expected, found, holds in self.checks()
            ],
        }


def compute(step_ms: float = PAPER_STEP_MS) -> ExperimentResult:
    """Solve the experiment by all methods; the fixed-step methods use a step of `step_ms`.

    Raises:
        InputError: a second is not a multiple of the step.
    """
    per_second = 1000.0 / step_ms if step_ms > 0 else 0.0
    if per_second < 1 or abs(per_second - round(per_second)) > 1e-9:
        raise InputError(
            f"invalid step {step_ms:g} ms: a second must be a multiple of the step, "
            "because the torques switch at whole seconds"
        )
    mode = fastest_mode(ARM, theta2=0.0)
    limits = {table.name: table.negative_real_limit() / mode * 1e3 for table in (EULER, RK4, RKF45)}
    limits["rkf45, order 4"] = RKF45.negative_real_limit(RKF45.embedded) / mode * 1e3
    count = round(DURATION_S * per_second)
    fehlberg = _fixed(RKF45, "Runge–Kutta–Fehlberg", step_ms, count)
    return ExperimentResult(
        step_ms=step_ms,
        mode=mode,
        euler=_fixed(EULER, "Euler", step_ms, count),
        reference=_reference(np.linspace(0.0, DURATION_S, 1001)),
        fehlberg=fehlberg,
        automatic=_automatic(step_ms, count),
        at_steps=_reference(fehlberg.time_s),
        limits_ms={name: limits[name] for name in EXPECTED_LIMITS_MS},
    )


def _fixed(table: Tableau, title: str, step_ms: float, count: int) -> Solution:
    stepper = FixedStep(ReducedDynamics([ARM]), table, step_ms / 1e3)
    position, velocity, effort = np.zeros((4, 1)), np.zeros((4, 1)), np.zeros((4, 1))
    effort[2] = -ARM.masses[2] * GRAVITY
    positions, velocities = np.zeros((2, count + 1)), np.zeros((2, count + 1))
    time_s = np.asarray(np.arange(count + 1) * (step_ms / 1e3), dtype=np.float64)
    # A diverging method may overflow.
    with np.errstate(all="ignore"):
        for k in range(count):
            effort[:2, 0] = torque(time_s[k] + 1e-9)
            stepper.advance(position, velocity, effort)
            positions[:, k + 1], velocities[:, k + 1] = position[:2, 0], velocity[:2, 0]
    return Solution(table.name, f"{title}, fixed step of {step_ms:g} ms", time_s, positions, velocities)


def _automatic(step_ms: float, count: int) -> Solution:
    sim = StepParameters(step_ns=round(step_ms * 1e6))
    plant = Plant([RigParameters(arm=ARM, sim=sim, scene=SceneParameters(table_height=-1.0))])
    effort, magnet = np.zeros((4, 1)), np.zeros(1, dtype=np.bool_)
    effort[2] = -ARM.masses[2] * GRAVITY
    positions, velocities = np.zeros((2, count + 1)), np.zeros((2, count + 1))
    time_s = np.asarray(np.arange(count + 1) * (step_ms / 1e3), dtype=np.float64)
    for k in range(count):
        effort[:2, 0] = torque(time_s[k] + 1e-9)
        plant.step(effort, magnet)
        positions[:, k + 1], velocities[:, k + 1] = plant.position[:2, 0], plant.velocity[:2, 0]
    title = f"Runge–Kutta–Fehlberg, automatic sub-steps of {step_ms:g} ms"
    return Solution("automatic", title, time_s, positions, velocities)


def _reference(time_s: Floats) -> Solution:
    dynamics = ReducedDynamics([ARM])
    state, rates, drive = np.zeros((5, 1)), np.zeros((5, 1)), np.zeros((4, 1))
    views = stage_views(state, rates)
    effort = np.zeros((4, 1))
    effort[2] = -ARM.masses[2] * GRAVITY

    def derivative(time_s: float, y: Floats) -> Floats:
        effort[:2, 0] = torque(time_s)
        dynamics.drive(effort, drive)
        state[:2, 0], state[4, 0] = y[2:], y[1]
        dynamics.rates(views, drive)
        return np.concatenate([y[2:], rates[:2, 0]])

    y = reference_solution(derivative, np.zeros(4), time_s, breaks=TORQUE_SWITCH_TIMES_S)
    return Solution("dop853", "Dormand–Prince, variable step", time_s, y[:2], y[2:])


def draw(result: ExperimentResult) -> "dict[str, Figure]":
    """Draw figures 4, 5 and 6, by the names of their files."""
    from matplotlib.figure import Figure

    figures = {}
    for number, solution in ((4, result.euler), (5, result.reference), (6, result.fehlberg)):
        figure = Figure(figsize=(8, 5), layout="constrained", dpi=120)
        angles, speeds = figure.subplots(2, 1, sharex=True)
        for axes, values, quantity, upper in (
            (angles, solution.position, "position, rad", 0.25),
            (speeds, solution.velocity, "velocity, rad/s", 0.08),
        ):
            for joint, color in ((0, "#4c78a8"), (1, "#f58518")):
                width = 1.6 if solution.diverged_s is None else 0.5
                axes.plot(solution.time_s, values[joint], color=color, label=f"joint {joint + 1}", linewidth=width)
            axes.set_ylabel(quantity)
            if solution.diverged_s is None:
                axes.set_ylim(-0.25 * upper, upper)
            axes.grid(alpha=0.3)
        angles.legend(loc="upper left")
        angles.set_xlim(0, DURATION_S)
        speeds.set_xlabel("time, s")
        figure.suptitle(f"Figure {number}: {solution.title}")
        figures[f"figure{number}_{solution.name}.png"] = figure
    return figures
