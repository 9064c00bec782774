"""Parts, trays, table and magnet of N rigs: what is picked, carried, dropped, and what comes to rest on what.

Contact is vertical only and footprints are discs (docs/model.md, decision 9): a tool, a held part and a falling part
stop on the highest thing below them, and nothing is pushed sideways. Rigs may have different numbers of parts and
trays; the arrays are as high as the largest, and what is missing lies far away.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.model import GRAVITY, SceneParameters
from hilrig_sim.plant.static_geometry import FAR_AWAY, TOUCHING, Rigs, Surfaces

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

NONE: Final = -1
"""`held` where the magnet holds nothing."""
ALL: Final = slice(None)
_GRAIN: Final = 2.0**-30
"""How far a tip is inside a part is kept to this, m: what is found anew from a recorded pose is the same to the bit."""


class World:
    """The scenes of N rigs."""

    def __init__(self, scenes: Sequence[SceneParameters], reach: float) -> None:
        """Set up the scenes of rigs whose tools stay within `reach` of joint 1, m."""
        count = len(scenes)
        self._scenes = tuple(scenes)
        self.part_names = tuple(tuple(part.name for part in scene.parts) for scene in scenes)
        rows = max(len(scene.parts) for scene in scenes)
        self._row_numbers = np.arange(rows)[:, np.newaxis]
        self.x = np.full((rows, count), FAR_AWAY)
        self.y = np.full((rows, count), FAR_AWAY)
        self.z = np.zeros((rows, count))
        """Centres of the parts, world, m, (P, N)."""
        self.yaw = np.zeros((rows, count))
        self._fall_speed = np.zeros((rows, count))
        self._falling = np.zeros((rows, count), dtype=np.bool_)
        self._radius = np.zeros((rows, count))
        self.half_height = np.zeros((rows, count))
        self.mass = np.zeros((rows, count))
        self._attracted = np.zeros((rows, count), dtype=np.bool_)
        self.held = np.full(count, NONE, dtype=np.int64)
        """Index of the part on each magnet, or `NONE`, (N,)."""
        self._grip = np.zeros((3, count))
        """The held part relative to the tool: x, y, yaw in the tool's frame; m, m, rad."""
        self.held_height = np.zeros(count)
        """How far the held part reaches below the tip, m, (N,)."""
        self._held_radius = np.zeros(count)
        self.highest = np.empty(count)
        """Nothing of a scene but what the magnet holds is above this z, m, (N,)."""
        for rig, scene in enumerate(scenes):
            for row, part in enumerate(scene.parts):
                self._radius[row, rig] = part.radius
                self.half_height[row, rig] = part.size[2] / 2
                self.mass[row, rig] = part.mass
                self._attracted[row, rig] = part.ferromagnetic
        self._reach = np.array([scene.magnet_reach for scene in scenes])
        self._gap = np.array([scene.magnet_gap for scene in scenes])
        self._surfaces = Surfaces(scenes, reach)
        self.moving = np.zeros(count, dtype=np.bool_)
        """Where a part moved in the last step, (N,)."""
        self._any_moving = False
        self.holds = np.zeros(count, dtype=np.bool_)
        """Where a magnet holds a part, (N,)."""
        self.holding = False
        """Whether any does."""
        self.falling = False
        """Whether any part of any rig is on its way down."""
        for rig in range(count):
            self.reset(rig)

    def reset(self, rig: int) -> None:
        """Put every part of a rig back where it stood at the start."""
        for row, part in enumerate(self._scenes[rig].parts):
            self.x[row, rig], self.y[row, rig], self.z[row, rig] = part.position
            self.yaw[row, rig] = part.yaw
        self._falling[:, rig] = False
        self.falling = bool(self._falling.any())
        self._fall_speed[:, rig] = 0.0
        self._let_go(np.array([rig]))
        self._moved(rig)

    def adopt(self, other: "World", mine: Ints, theirs: Ints) -> None:
        """Take over how things stand from rigs of another world with the same scenes, column by column."""
        rows = min(self.x.shape[0], other.x.shape[0])
        for name in ("x", "y", "z", "yaw", "_fall_speed", "_falling"):
            getattr(self, name)[:rows, mine] = getattr(other, name)[:rows, theirs]
        for name in ("held", "_grip", "held_height", "_held_radius", "highest", "moving", "holds"):
            getattr(self, name)[..., mine] = getattr(other, name)[..., theirs]
        self.falling = bool(self._falling.any())
        self.holding = bool(self.holds.any())
        self._any_moving = bool(self.moving.any())

    def place(self, rig: int, poses: Sequence[tuple[float, float, float, float]], held: int, tip: Floats) -> None:
        """Set a rig's parts to (x, y, z, yaw) each, at rest, `held` on the magnet at `tip` (x, y, z, yaw), (4,)."""
        for row, pose in enumerate(poses):
            self.x[row, rig], self.y[row, rig], self.z[row, rig], self.yaw[row, rig] = pose
        self._falling[:, rig] = False
        self.falling = bool(self._falling.any())
        rigs = np.array([rig])
        self._let_go(rigs)
        if held != NONE:
            self._take(rigs, np.array([held]), tip[:, np.newaxis])
        else:
            self._refresh_highest(rigs)

    def begin_step(self) -> None:
        """Nothing has moved in this step so far."""
        if self._any_moving:
            self.moving[:] = False
            self._any_moving = False

    def at_rest(self, rig: int) -> bool:
        """Whether each part of a rig is held or lies on something."""
        rows = [row for row in range(len(self.part_names[rig])) if row != self.held[rig]]
        return all(abs(self._bottom(row, rig) - self._support_of(row, rig)) <= TOUCHING for row in rows)

    def release(self, rigs: Ints) -> None:
        """Switch the magnets of these rigs, which hold something, off: their parts fall from rest."""
        self._falling[self.held[rigs], rigs] = True
        self.falling = True
        self._fall_speed[self.held[rigs], rigs] = 0.0
        self._let_go(rigs)

    def attract(self, rigs: Ints, tip: Floats) -> Ints:
        """Let the magnets of these rigs, which are on and hold nothing, take what is within their reach.

        Args:
            rigs: indices, (K,).
            tip: tool poses (x, y, z, yaw) of these rigs, (4, K).

        Returns:
            The rigs that took a part.
        """
        if not self.x.shape[0]:
            return rigs[:0]
        x, y, z, _ = tip
        dx, dy = self.x[:, rigs] - x, self.y[:, rigs] - y
        squared = dx * dx + dy * dy
        top = self.z[:, rigs] + self.half_height[:, rigs]
        # Rounding must not decide at the very edge of the gap.
        near = np.abs(top - z) <= self._gap[rigs] + TOUCHING
        near &= self._attracted[:, rigs] & (squared <= self._reach[rigs] * self._reach[rigs])
        taking = near.any(axis=0)
        if not taking.any():
            return rigs[:0]
        nearest = np.argmin(np.where(near, squared, np.inf), axis=0)
        taken: Ints = rigs[taking]
        self._take(taken, nearest[taking], tip[:, taking])
        # What stood on the part that is gone now falls.
        self._falling[:, taken] = True
        self._falling[self.held[taken], taken] = False
        self.falling = bool(self._falling.any())
        self._fall_speed[:, taken] = 0.0
        return taken

    def payload(self) -> Floats:
        """m4, the mass that each magnet holds, kg, (N,)."""
        payload = np.zeros(self.held.size)
        holding = np.flatnonzero(self.held != NONE)
        payload[holding] = self.mass[self.held[holding], holding]
        return payload

    def contact(self, rigs: Rigs, x: Floats, y: Floats, bottom: Floats) -> Floats:
        """World z, m, (K,), of what a tool, or the part that it holds, would stop on.

        Args:
            rigs: K of the rigs.
            x: of the tool or the held part's centre, world, m, (K,).
            y: the same.
            bottom: z of its lowest point so far, m, (K,): what reaches higher is beside it, not below.
        """
        return self._support(rigs, x, y, self._held_radius[rigs], bottom, self.held[rigs])

    def footprint_centre(self, rigs: Rigs, tip: Floats) -> tuple[Floats, Floats]:
        """World x, y, m, (K,) each, of what each of these rigs would set down: the held part's centre or the tip."""
        x, y, _, yaw = tip
        if not self.holding:
            return x, y
        c, s = np.cos(yaw), np.sin(yaw)
        grip_x, grip_y, _ = self._grip[:, rigs]
        return x + (c * grip_x - s * grip_y), y + (s * grip_x + c * grip_y)

    def carry(self, rigs: Ints, tip: Floats) -> None:
        """Move the parts that these rigs hold to where their tools are: poses (x, y, z, yaw), (4, K)."""
        rows = self.held[rigs]
        self.x[rows, rigs], self.y[rows, rigs] = self.footprint_centre(rigs, tip)
        self.z[rows, rigs] = tip[2] - self.held_height[rigs] + self.half_height[rows, rigs]
        self.yaw[rows, rigs] = tip[3] + self._grip[2, rigs]
        self._moved(rigs)

    def fall(self, duration: float) -> None:
        """Let what is falling fall for `duration`, s, and come to rest on what is below it."""
        for rig in np.flatnonzero(self._falling.any(axis=0)).tolist():
            something_falls = False
            # The lowest first: what is above it comes down on where it is then.
            rows = np.flatnonzero(self._falling[:, rig]).tolist()
            for row in sorted(rows, key=lambda row: self._bottom(row, rig)):
                self._fall(row, rig, duration)
                if something_falls:
                    # What it came down on may be on its way down itself.
                    self._falling[row, rig] = True
                something_falls |= bool(self._falling[row, rig])
            self._refresh_highest(np.array([rig]))
        self.falling = bool(self._falling.any())

    def _fall(self, row: int, rig: int, duration: float) -> None:
        bottom, support = self._bottom(row, rig), self._support_of(row, rig)
        speed = self._fall_speed[row, rig]
        lower = bottom - (speed * duration + 0.5 * GRAVITY * duration * duration)
        if lower <= support:
            lower = support
            self._falling[row, rig] = False
        self._fall_speed[row, rig] = speed + GRAVITY * duration if lower > support else 0.0
        self.z[row, rig] = lower + self.half_height[row, rig]
        self._moved(rig)

    def _take(self, rigs: Ints, rows: Ints, tip: Floats) -> None:
        x, y, z, yaw = tip
        c, s = np.cos(yaw), np.sin(yaw)
        dx, dy = self.x[rows, rigs] - x, self.y[rows, rigs] - y
        self._grip[0, rigs] = c * dx + s * dy
        self._grip[1, rigs] = c * dy - s * dx
        self._grip[2, rigs] = self.yaw[rows, rigs] - yaw
        self.held[rigs] = rows
        half = self.half_height[rows, rigs]
        # A tip that came into a part from the side holds it where it stands: pushed down, it would sink into the table.
        inside = np.maximum(self.z[rows, rigs] + half - z, 0.0)
        self.held_height[rigs] = 2 * half - np.rint(inside / _GRAIN) * _GRAIN
        self._held_radius[rigs] = self._radius[rows, rigs]
        self.z[rows, rigs] = z - self.held_height[rigs] + half
        self._hold_changed()
        self._moved(rigs)
        self._refresh_highest(rigs)

    def _let_go(self, rigs: Ints) -> None:
        self.held[rigs] = NONE
        self.held_height[rigs] = 0.0
        self._held_radius[rigs] = 0.0
        self._grip[:, rigs] = 0.0
        self._hold_changed()
        self._moved(rigs)
        self._refresh_highest(rigs)

    def _moved(self, rigs: Ints | int) -> None:
        self.moving[rigs] = True
        self._any_moving = True

    def _hold_changed(self) -> None:
        np.not_equal(self.held, NONE, out=self.holds)
        self.holding = bool(self.holds.any())

    def _refresh_highest(self, rigs: Ints) -> None:
        top = self.z[:, rigs] + self.half_height[:, rigs]
        top = np.where(self._row_numbers == self.held[rigs], -np.inf, top)
        self.highest[rigs] = np.maximum(top.max(axis=0, initial=-np.inf), self._surfaces.highest[rigs])

    def _bottom(self, row: int, rig: int) -> float:
        return float(self.z[row, rig] - self.half_height[row, rig])

    def _support_of(self, row: int, rig: int) -> float:
        """World z of what a part stands on or would fall on, m."""
        one = np.array([rig])
        bottom = np.array([self._bottom(row, rig)])
        radius = self._radius[row, one]
        height = self._support(one, self.x[row, one], self.y[row, one], radius, bottom, np.array([row]))
        return float(height[0])

    def _support(self, rigs: Rigs, x: Floats, y: Floats, radius: Floats, bottom: Floats, ignored: Ints) -> Floats:
        """Highest top, m, (K,), not above `bottom`, among what lies under discs; `ignored`: the discs' own parts."""
        height = self._surfaces.under(rigs, x, y, radius, bottom)
        if not self.x.shape[0]:
            return height
        dx, dy = self.x[:, rigs] - x, self.y[:, rigs] - y
        together = self._radius[:, rigs] + radius
        top = self.z[:, rigs] + self.half_height[:, rigs]
        under = (dx * dx + dy * dy < together * together) & (top <= bottom + TOUCHING)
        # A held part hangs on the magnet: nothing stands on it.
        under &= self._row_numbers != ignored
        if self.holding:
            under &= self._row_numbers != self.held[rigs]
        return np.asarray(np.maximum(height, np.where(under, top, -np.inf).max(axis=0)))
