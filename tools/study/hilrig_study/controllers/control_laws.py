"""Controller interface of a study and the built-in control laws.

The same controller object runs many simulated runs in parallel, or one live run over Modbus. Its input is the content
of the registers, its output four efforts. `LawController` is the base of control laws over arrays: a pure function of
its memory (internal state) and a measurement, (rows, runs) each. It is vectorized over runs and can be linearized.
`user_controller.UserController` loads a controller from a Python file.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.dynamics import ReducedDynamics
from hilrig_sim.arm.model import ArmParameters
from hilrig_study.linear_model import holding_effort

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

INTEGRAL_LIMIT: Final = np.array([[0.2], [0.2], [0.02], [0.2]])
"""Anti-windup limit of the error integrals, rad·s and m·s."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """Input of a controller at a poll, for N runs."""

    time_s: Floats
    """Time since the start of the run, s, (N,)."""
    position: Floats
    """Joint positions read from the registers; rad, rad, m, rad, (4, N)."""
    goal: Floats
    """Set points of the joints, same units, (4, N)."""
    latency_s: Floats
    """Latest loop latency in the extended register map, s, (N,); 0: none measured yet."""


class Controller(Protocol):
    """Interface of a controller in a study."""

    def reset(self, runs: int) -> None:
        """Reset the controller to the start of `runs` runs."""

    def update(self, measured: Measurement, due: Bools | None) -> Floats:
        """Return the efforts, N·m, N·m, N, N·m, (4, N), of the runs in `due`, (N,); None: all runs.

        The columns of the other runs are ignored, and the memory of those runs does not change.
        """


class LawController(ABC):
    """Base of control laws over arrays; the internal state is `memory`, (rows, N)."""

    memory: Floats

    @abstractmethod
    def start(self, runs: int) -> Floats:
        """Return the initial memory, (rows, runs)."""

    @abstractmethod
    def law(self, memory: Floats, measured: Measurement) -> tuple[Floats, Floats]:
        """Return the efforts, (4, N), and the next memory, (rows, N); a pure function without coupling between runs."""

    def reset(self, runs: int) -> None:
        """Implement `Controller.reset`."""
        self.memory = self.start(runs)

    def update(self, measured: Measurement, due: Bools | None = None) -> Floats:
        """Implement `Controller.update`."""
        effort, memory = self.law(self.memory, measured)
        self.memory = memory if due is None else np.where(due, memory, self.memory)
        return effort


def column_array(values: Floats | Sequence[float] | float) -> Floats:
    """Return values as an array (4, 1) or (4, N), from one number, four numbers, or a table (4, N)."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return np.full((4, 1), float(array))
    return array[:, np.newaxis] if array.ndim == 1 else array


class FilteredDerivative:
    """Filtered derivative: velocities from position differences through a first-order low-pass filter."""

    def __init__(self, period_s: float, filter_s: float) -> None:
        """Set the poll period, s, and the time constant of the filter, s; 0: no filter."""
        self._decay = float(np.exp(-period_s / filter_s)) if filter_s > 0 else 0.0
        self._input_gain = (1.0 - self._decay) / period_s

    @staticmethod
    def start(runs: int) -> Floats:
        """Return the initial memory, (8, runs): no position yet (NaN), velocity zero."""
        return np.vstack([np.full((4, runs), np.nan), np.zeros((4, runs))])

    def update(self, memory: Floats, position: Floats) -> tuple[Floats, Floats]:
        """Return the velocities, (4, N), and the next memory, (8, N)."""
        before, velocity = memory[:4], memory[4:8]
        moved = np.where(np.isnan(before), 0.0, position - before)
        velocity = self._decay * velocity + self._input_gain * moved
        return velocity, np.concatenate([position, velocity])


class Pid(LawController):
    """Decentralized PID: τ = Kp (goal - q) + Ki ∫(goal - q) dt - Kd q̇ + holding effort; a PD if Ki = 0."""

    def __init__(
        self,
        arm: ArmParameters,
        period_s: float,
        kp: Floats | Sequence[float],
        kd: Floats | Sequence[float],
        ki: Floats | Sequence[float] = (0.0, 0.0, 0.0, 0.0),
        filter_s: float = 0.02,
    ) -> None:
        """Set gains in N·m/rad, N·m·s/rad and N·m/(rad·s), for joint 3 in N/m, N·s/m and N/(m·s); (4,) or (4, N)."""
        self._kp, self._kd, self._ki = column_array(kp), column_array(kd), column_array(ki)
        self._holding = column_array(holding_effort(arm))
        self._period_s = period_s
        self._derivative = FilteredDerivative(period_s, filter_s)

    def start(self, runs: int) -> Floats:
        """Implement `LawController.start`."""
        return np.vstack([self._derivative.start(runs), np.zeros((4, runs))])

    def law(self, memory: Floats, measured: Measurement) -> tuple[Floats, Floats]:
        """Implement `LawController.law`."""
        velocity, kept = self._derivative.update(memory, measured.position)
        error = measured.goal - measured.position
        integral = np.clip(memory[8:12] + self._period_s * error, -INTEGRAL_LIMIT, INTEGRAL_LIMIT)
        effort = self._kp * error + self._ki * integral - self._kd * velocity + self._holding
        return effort, np.concatenate([kept, integral])


class ComputedTorque(LawController):
    """Computed torque: τ = M(q)(ω² (goal - q) - 2ζω q̇) + C(q, q̇) q̇ + B q̇ + holding effort.

    The closed loop consists of four decoupled second-order systems.
    """

    def __init__(
        self,
        arm: ArmParameters,
        period_s: float,
        omega: Floats | Sequence[float] | float,
        zeta: float = 1.0,
        filter_s: float = 0.02,
    ) -> None:
        """Set the natural frequency `omega`, rad/s (a number, (4,) or (4, N)) and the damping ratio `zeta`."""
        self._omega, self._zeta = column_array(omega), zeta
        self._holding = column_array(holding_effort(arm))
        self._friction = column_array(arm.friction)
        self._model = ReducedDynamics.of(arm)
        self._m3, self._j4 = arm.masses[2], arm.j4
        self._derivative = FilteredDerivative(period_s, filter_s)

    def start(self, runs: int) -> Floats:
        """Implement `LawController.start`."""
        return self._derivative.start(runs)

    def law(self, memory: Floats, measured: Measurement) -> tuple[Floats, Floats]:
        """Implement `LawController.law`."""
        velocity, kept = self._derivative.update(memory, measured.position)
        acceleration = self._omega**2 * (measured.goal - measured.position) - 2 * self._zeta * self._omega * velocity
        theta2, (v1, v2, _, _) = measured.position[1], velocity
        alpha, a12, a22 = self._model.mass_matrix_12(theta2)
        coriolis = self._model.coupling * np.sin(theta2)
        effort = np.empty_like(acceleration)
        effort[0] = alpha * acceleration[0] + a12 * acceleration[1] - coriolis * (2 * v1 * v2 + v2 * v2)
        effort[1] = a12 * acceleration[0] + a22 * acceleration[1] + coriolis * v1 * v1
        effort[2] = self._m3 * acceleration[2]
        effort[3] = self._j4 * acceleration[3]
        return effort + self._friction * velocity + self._holding, kept
