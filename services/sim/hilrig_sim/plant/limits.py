"""Limit flags of the rigs, and the events of a step of the plant."""

from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.plant.world import NO_PART

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

TOOL_CONTACT_FLAG: Final = 1 << 8
_LOWER: Final = 1 << np.arange(4)
_UPPER: Final = 1 << np.arange(4, 8)
_TRUE: Final = b"\x01"


class PlantEventKind(Enum):
    """Kind of a plant event."""

    LIMIT_HIT = "limit hit"
    PART_PICKED = "part picked"
    PART_DROPPED = "part dropped"


@dataclass(frozen=True, slots=True)
class PlantEvent:
    """An event of one rig in a step."""

    kind: PlantEventKind
    rig: int
    joint: int = 0
    """Joint at its limit, 1 to 4; 0: the tool touches an object below it."""
    upper: bool = False
    speed: float = 0.0
    """Speed of the joint at the impact; rad/s or m/s."""
    part: int = NO_PART
    """Index of the part in the scene of the rig."""


class LimitFlags:
    """Limit flags of N rigs, recomputed when they change."""

    def __init__(self, stop3: Floats) -> None:
        """Initialize for quills with upper stops at `stop3`, m, (N,)."""
        self._stop3 = stop3
        self._below = np.zeros(len(stop3), dtype=np.bool_)
        self._key = b""
        self._numbers = np.zeros(len(stop3), dtype=np.int64)
        self.flags = [0] * len(stop3)
        """For each rig: bit j-1 joint j at its lower stop, bit 3+j at its upper stop, bit 8 tool touches an object."""
        self.any = False
        """Whether any rig is at any limit."""

    def update(
        self, at_lower: Bools, at_upper: Bools, upper3: Floats, impact_velocity: Floats | None, events: list[PlantEvent]
    ) -> None:
        """Update the flags, and append the limits that were hit with velocities `impact_velocity`, (4, N), to `events`.

        `upper3`, (N,): largest d3 of each quill; less than its upper stop if an object is below the tool.
        """
        np.less(upper3, self._stop3, self._below)
        key = at_lower.tobytes() + at_upper.tobytes() + self._below.tobytes()
        if key == self._key:
            return
        self._key = key
        old, self._numbers = self._numbers, _LOWER @ at_lower + _UPPER @ at_upper
        self._numbers += (at_upper[2] & self._below) * (TOOL_CONTACT_FLAG - (1 << 6))
        self.flags = self._numbers.tolist()
        self.any = bool(self._numbers.any())
        if impact_velocity is not None:
            new = self._numbers & ~old
            for rig in np.flatnonzero(new).tolist():
                events.extend(_hits(rig, int(new[rig]), impact_velocity[:, rig].tolist()))


def _hits(rig: int, new: int, impact_velocity: list[float]) -> list[PlantEvent]:
    hits = [
        PlantEvent(PlantEventKind.LIMIT_HIT, rig, joint + 1, upper, abs(impact_velocity[joint]))
        for joint in range(4)
        for upper in (False, True)
        if new & (1 << (4 * upper + joint))
    ]
    if new & TOOL_CONTACT_FLAG:
        hits.append(PlantEvent(PlantEventKind.LIMIT_HIT, rig, 0, True, abs(impact_velocity[2])))
    return hits


def any_true(mask: Bools) -> bool:
    """Return whether an element is true: for a few elements, ten times as fast as `mask.any()`."""
    return _TRUE in mask.tobytes()
