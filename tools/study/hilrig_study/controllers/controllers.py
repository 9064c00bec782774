"""Controllers as a study runs them: many runs at once in virtual time, or one run live over Modbus, by the same object.

A controller gets what the registers show and gives four efforts. `LawController` is for laws over arrays: a pure
function of a memory and a measurement, (rows, runs) each, which is vectorised over runs and which theory can
linearise. A student's own file is `student.StudentController`.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.dynamics import ReducedDynamics
from hilrig_sim.arm.model import ArmParameters
from hilrig_study.theory.linear import holding_effort

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

INTEGRAL_LIMIT: Final = np.array([[0.2], [0.2], [0.02], [0.2]])
"""Integrals of the error are held within this, rad·s and m·s: a run that is off for long does not wind up."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What a controller knows at a poll, of N runs."""

    time_s: Floats
    """Since the run's start, s, (N,)."""
    position: Floats
    """As the registers say it: rad, rad, m, rad, (4, N)."""
    goal: Floats
    """Where the joints should be, same units, (4, N)."""
    latency_s: Floats
    """Last loop latency that the extended map shows, s, (N,); 0: none yet."""


class Controller(Protocol):
    """What a study asks of a controller."""

    def begin(self, runs: int) -> None:
        """Start `runs` runs anew."""

    def update(self, measured: Measured, due: Bools | None) -> Floats:
        """Efforts, N·m, N·m, N, N·m, (4, N), of the runs that poll now: `due`, (N,); None: all of them.

        What is returned for the others is not looked at, and their memory stays as it is.
        """


class LawController(ABC):
    """A law over arrays; its memory is `memory`, (rows, N)."""

    memory: Floats

    @abstractmethod
    def start(self, runs: int) -> Floats:
        """The memory at the start, (rows, runs)."""

    @abstractmethod
    def law(self, memory: Floats, measured: Measured) -> tuple[Floats, Floats]:
        """Efforts, (4, N), and the next memory, (rows, N): a pure function, each run by itself."""

    def begin(self, runs: int) -> None:
        """As `Controller`."""
        self.memory = self.start(runs)

    def update(self, measured: Measured, due: Bools | None = None) -> Floats:
        """As `Controller`."""
        effort, memory = self.law(self.memory, measured)
        self.memory = memory if due is None else np.where(due, memory, self.memory)
        return effort


def column(values: Floats | Sequence[float] | float) -> Floats:
    """Gains as (4, 1) or (4, N): one number or four for all runs, or a table."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return np.full((4, 1), float(array))
    return array[:, np.newaxis] if array.ndim == 1 else array


class Derivative:
    """Velocities out of positions: differences of polls through a first-order filter. Four rows of memory twice."""

    ROWS: Final = 8

    def __init__(self, period_s: float, filter_s: float) -> None:
        """Poll every `period_s`; the filter's time constant is `filter_s`, 0: plain differences."""
        self._keep = float(np.exp(-period_s / filter_s)) if filter_s > 0 else 0.0
        self._take = (1.0 - self._keep) / period_s

    @staticmethod
    def start(runs: int) -> Floats:
        """No position has been seen (NaN), no velocity is known, (8, runs)."""
        return np.vstack([np.full((4, runs), np.nan), np.zeros((4, runs))])

    def follow(self, memory: Floats, position: Floats) -> tuple[Floats, Floats]:
        """Velocities, (4, N), and the next memory, (8, N)."""
        before, velocity = memory[:4], memory[4:8]
        moved = np.where(np.isnan(before), 0.0, position - before)
        velocity = self._keep * velocity + self._take * moved
        return velocity, np.concatenate([position, velocity])


class Pid(LawController):
    """τ = Kp (goal - q) + Ki ∫(goal - q) dt - Kd q̇ + holding effort; without Ki a PD. Joint by joint."""

    def __init__(
        self,
        arm: ArmParameters,
        period_s: float,
        kp: Floats | Sequence[float],
        kd: Floats | Sequence[float],
        ki: Floats | Sequence[float] = (0.0, 0.0, 0.0, 0.0),
        filter_s: float = 0.02,
    ) -> None:
        """Gains in N·m/rad, N·m·s/rad, N·m/(rad·s), joint 3 in N/m and so on; (4,) for all runs or (4, N)."""
        self._kp, self._kd, self._ki = column(kp), column(kd), column(ki)
        self._holding = column(holding_effort(arm))
        self._period_s = period_s
        self._derivative = Derivative(period_s, filter_s)

    def start(self, runs: int) -> Floats:
        """As `LawController`."""
        return np.vstack([self._derivative.start(runs), np.zeros((4, runs))])

    def law(self, memory: Floats, measured: Measured) -> tuple[Floats, Floats]:
        """As `LawController`."""
        velocity, kept = self._derivative.follow(memory, measured.position)
        error = measured.goal - measured.position
        integral = np.clip(memory[8:12] + self._period_s * error, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
        effort = self._kp * error + self._ki * integral - self._kd * velocity + self._holding
        return effort, np.concatenate([kept, integral])


class ComputedTorque(LawController):
    """τ = M(q)(ω² (goal - q) - 2ζω q̇) + C(q, q̇) q̇ + B q̇ + holding effort: every joint a second-order lag of its own."""

    def __init__(
        self,
        arm: ArmParameters,
        period_s: float,
        omega: Floats | Sequence[float] | float,
        zeta: float = 1.0,
        filter_s: float = 0.02,
    ) -> None:
        """`omega` is the wanted natural frequency, rad/s: a number, (4,) or (4, N); `zeta` the damping ratio."""
        self._omega, self._zeta = column(omega), zeta
        self._holding = column(holding_effort(arm))
        self._friction = column(arm.friction)
        self._model = ReducedDynamics.of(arm)
        self._m3, self._j4 = arm.masses[2], arm.j4
        self._derivative = Derivative(period_s, filter_s)

    def start(self, runs: int) -> Floats:
        """As `LawController`."""
        return self._derivative.start(runs)

    def law(self, memory: Floats, measured: Measured) -> tuple[Floats, Floats]:
        """As `LawController`."""
        velocity, kept = self._derivative.follow(memory, measured.position)
        wanted = self._omega**2 * (measured.goal - measured.position) - 2 * self._zeta * self._omega * velocity
        theta2, (v1, v2, _, _) = measured.position[1], velocity
        alpha, a12, a22 = self._model.mass_matrix_12(theta2)
        turning = self._model.coupling * np.sin(theta2)
        effort = np.empty_like(wanted)
        effort[0] = alpha * wanted[0] + a12 * wanted[1] - turning * (2 * v1 * v2 + v2 * v2)
        effort[1] = a12 * wanted[0] + a22 * wanted[1] + turning * v1 * v1
        effort[2] = self._m3 * wanted[2]
        effort[3] = self._j4 * wanted[3]
        return effort + self._friction * velocity + self._holding, kept
