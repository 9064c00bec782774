"""Plant models of a study for N parallel runs: the nonlinear arm, or its linear model near a pose."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.model import RigParameters
from hilrig_sim.plant.plant import Plant
from hilrig_study.linear_model import LinearPlant, fixed_order_product

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class StudyPlant(Protocol):
    """Interface of a plant model: N arms that step together."""

    position: Floats
    """rad, rad, m, rad, (4, N)."""

    def step(self, effort: Floats) -> None:
        """Advance by one step of the loop with these efforts, (4, N)."""

    def park(self, runs: Bools) -> None:
        """Reset these runs, (N,), to rest at the pose, so that a finished run can't overflow."""


class ArmPlant:
    """Nonlinear arm of the simulation with hard stops, without parts."""

    def __init__(self, rig: RigParameters, start: Sequence[float], pose: Sequence[float], runs: int) -> None:
        """Create `runs` arms of a rig at rest at `start`; finished runs are reset to `pose`."""
        self._plant = Plant([rig] * runs)
        for run in range(runs):
            self._plant.set_state(run, tuple(start), (0.0, 0.0, 0.0, 0.0))
        self._pose = np.array(pose)[:, np.newaxis]
        self._magnet = np.zeros(runs, dtype=np.bool_)
        self.position = self._plant.position

    def step(self, effort: Floats) -> None:
        """Implement `StudyPlant.step`."""
        self._plant.step(effort, self._magnet)

    def park(self, runs: Bools) -> None:
        """Implement `StudyPlant.park`."""
        np.copyto(self._plant.position, self._pose, where=runs)
        np.copyto(self._plant.velocity, 0.0, where=runs)


class LinearArms:
    """Linear model of the arm near a pose, without hard stops and velocity-quadratic terms."""

    def __init__(self, plant: LinearPlant, phi: Floats, gamma: Floats, start: Sequence[float], runs: int) -> None:
        """Create `runs` systems x(k+1) = Φ x(k) + Γ u(k) at rest at `start`, (4,)."""
        self._phi, self._gamma = phi, gamma
        self._pose = np.array(plant.pose)[:, np.newaxis]
        self._holding = np.array(plant.holding)[:, np.newaxis]
        self._state = np.zeros((8, runs))
        self._state[:4] = np.array(start)[:, np.newaxis] - self._pose
        self.position = self._state[:4] + self._pose

    def step(self, effort: Floats) -> None:
        """Implement `StudyPlant.step`."""
        self._state = fixed_order_product(self._phi, self._state) + fixed_order_product(
            self._gamma, effort - self._holding
        )
        np.add(self._state[:4], self._pose, out=self.position)

    def park(self, runs: Bools) -> None:
        """Implement `StudyPlant.park`."""
        np.copyto(self._state, 0.0, where=runs)
        np.copyto(self.position, self._pose, where=runs)
