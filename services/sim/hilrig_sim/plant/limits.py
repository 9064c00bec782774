"""Which limits each rig is at, and what a step brings that is worth an event."""

from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.plant.world import NONE

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

TOOL_CONTACT_FLAG: Final = 1 << 8


_TRUE: Final = b"\x01"


class Happening(Enum):
    """What a step may bring that is worth an event."""

    LIMIT_HIT = "limit hit"
    PART_PICKED = "part picked"
    PART_DROPPED = "part dropped"


@dataclass(frozen=True, slots=True)
class PlantEvent:
    """Something that happened to one rig in a step."""

    happening: Happening
    rig: int
    joint: int = 0
    """1 to 4 at a limit; 0: the tool, on what lies below it."""
    upper: bool = False
    speed: float = 0.0
    """Of the joint at the impact; rad/s or m/s."""
    part: int = NONE
    """Index of the part in the rig's scene."""


class LimitFlags:
    """The limit flags of N rigs, restated where something changed."""

    def __init__(self, stop3: Floats) -> None:
        """Set up for quills whose own upper stops are at `stop3`, m, (N,)."""
        self._stop3 = stop3
        self._below = np.zeros(len(stop3), dtype=np.bool_)
        self._key = b""
        self.flags = [0] * len(stop3)
        """For each rig: bit j-1 joint j on its lower stop, bit 3+j on its upper one, bit 8 tool on what is below it."""
        self.any = False
        """Whether any rig is at any limit."""

    def update(
        self, at_lower: Bools, at_upper: Bools, upper3: Floats, arriving: Floats | None, events: list[PlantEvent]
    ) -> None:
        """Restate the flags, and add to `events` the limits that were hit at joint velocities `arriving`, (4, N).

        `upper3`, (N,), is how far each quill can go: less than to its own stop where something is below the tool.
        """
        np.less(upper3, self._stop3, self._below)
        key = at_lower.tobytes() + at_upper.tobytes() + self._below.tobytes()
        if key == self._key:
            return
        self._key = key
        self.any = False
        touching = at_lower.any(axis=0) | at_upper.any(axis=0)
        for rig in np.flatnonzero(touching | (np.asarray(self.flags) != 0)).tolist():
            flags = 0
            for joint in range(4):
                if at_lower[joint, rig]:
                    flags |= 1 << joint
                if at_upper[joint, rig]:
                    flags |= TOOL_CONTACT_FLAG if joint == 2 and self._below[rig] else 1 << (4 + joint)
            new = flags & ~self.flags[rig]
            self.flags[rig] = flags
            self.any |= flags != 0
            if new and arriving is not None:
                events.extend(_hits(rig, new, arriving[:, rig].tolist()))


def _hits(rig: int, new: int, arriving: list[float]) -> list[PlantEvent]:
    hits = [
        PlantEvent(Happening.LIMIT_HIT, rig, joint + 1, upper, abs(arriving[joint]))
        for joint in range(4)
        for upper in (False, True)
        if new & (1 << (4 * upper + joint))
    ]
    if new & TOOL_CONTACT_FLAG:
        hits.append(PlantEvent(Happening.LIMIT_HIT, rig, 0, True, abs(arriving[2])))
    return hits


def any_true(mask: Bools) -> bool:
    """Whether any element is true: for a few elements, ten times as fast as `mask.any()`."""
    return _TRUE in mask.tobytes()
