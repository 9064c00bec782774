"""What a study steps: the arm itself, or the linear system near a pose, N runs at once behind one interface."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.model import RigParameters
from hilrig_sim.plant.plant import Plant
from hilrig_study.controllers.lqr import product
from hilrig_study.theory.linear import LinearPlant

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class StudyPlant(Protocol):
    """N arms that step together."""

    position: Floats
    """rad, rad, m, rad, (4, N)."""

    def step(self, effort: Floats) -> None:
        """Move on by a step of the loop under efforts, (4, N)."""

    def park(self, runs: Bools) -> None:
        """Put these runs, (N,), to rest at the pose: they are over, and must not disturb the others' arithmetic."""


class ArmPlant:
    """The arm of the simulation itself, with its stops; without parts, which nothing picks here."""

    def __init__(self, rig: RigParameters, start: Sequence[float], pose: Sequence[float], runs: int) -> None:
        """`runs` arms of a rig at rest at `start`; `pose` is where runs that are over are parked."""
        self._plant = Plant([rig] * runs)
        for run in range(runs):
            self._plant.set_state(run, tuple(start), (0.0, 0.0, 0.0, 0.0))
        self._pose = np.array(pose)[:, np.newaxis]
        self._magnet = np.zeros(runs, dtype=np.bool_)
        self.position = self._plant.position

    def step(self, effort: Floats) -> None:
        """As `StudyPlant`."""
        self._plant.step(effort, self._magnet)

    def park(self, runs: Bools) -> None:
        """As `StudyPlant`."""
        np.copyto(self._plant.position, self._pose, where=runs)
        np.copyto(self._plant.velocity, 0.0, where=runs)


class LinearArms:
    """The linear system near a pose: no stops, nothing quadratic."""

    def __init__(self, plant: LinearPlant, phi: Floats, gamma: Floats, start: Sequence[float], runs: int) -> None:
        """`runs` systems x(k+1) = Φ x(k) + Γ u(k) at rest at `start`, (4,)."""
        self._phi, self._gamma = phi, gamma
        self._pose = np.array(plant.pose)[:, np.newaxis]
        self._holding = np.array(plant.holding)[:, np.newaxis]
        self._state = np.zeros((8, runs))
        self._state[:4] = np.array(start)[:, np.newaxis] - self._pose
        self.position = self._state[:4] + self._pose

    def step(self, effort: Floats) -> None:
        """As `StudyPlant`."""
        self._state = product(self._phi, self._state) + product(self._gamma, effort - self._holding)
        np.add(self._state[:4], self._pose, out=self.position)

    def park(self, runs: Bools) -> None:
        """As `StudyPlant`."""
        np.copyto(self._state, 0.0, where=runs)
        np.copyto(self.position, self._pose, where=runs)
