"""Scenes of N rigs: parts, trays, table and magnet; parts are picked, held, released and fall.

Contact is vertical only and footprints are discs (docs/model-decisions.md, decision 9): a tool, a held part and a
falling part stop on the highest object below them, and no part is pushed sideways. Rigs may have different numbers of
parts and trays; the arrays have the size of the largest number, and unused entries are far away.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.model import GRAVITY, SceneParameters
from hilrig_sim.plant.static_geometry import CONTACT_TOLERANCE_M, FAR_AWAY_M, Rigs, StaticGeometry

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

NO_PART: Final = -1
"""Value of `held` if the magnet holds no part."""
ALL_RIGS: Final = slice(None)
"""Selects all rigs, without a copy."""
FALL_RESOLUTION_M: Final = 0.005
"""Horizontal distance after which the surface below a falling part is determined again, m."""
_DEPTH_RESOLUTION: Final = 2.0**-30
"""Resolution of the depth of a tip inside a part, m: a depth recomputed from a recorded pose is bit-identical."""


class World:
    """The scenes of N rigs."""

    def __init__(self, scenes: Sequence[SceneParameters], reach: float, *, ballistic: bool = True) -> None:
        """Initialize the scenes of rigs whose tools stay within `reach` of joint 1, m.

        Without `ballistic`, released parts fall from rest, as in plant version 1.
        """
        self._ballistic = ballistic
        count = len(scenes)
        self._scenes = tuple(scenes)
        self.part_names = tuple(tuple(part.name for part in scene.parts) for scene in scenes)
        rows = max(len(scene.parts) for scene in scenes)
        self._row_numbers = np.arange(rows)[:, np.newaxis]
        self.x = np.full((rows, count), FAR_AWAY_M)
        self.y = np.full((rows, count), FAR_AWAY_M)
        self.z = np.zeros((rows, count))
        """Centers of the parts, world, m, (P, N)."""
        self.yaw = np.zeros((rows, count))
        self._fall_speed = np.zeros((rows, count))
        self._drift = np.zeros((2, rows, count))
        """Horizontal velocity of the falling parts, m/s, (2, P, N)."""
        self._falling = np.zeros((rows, count), dtype=np.bool_)
        self._radius = np.zeros((rows, count))
        self.half_height = np.zeros((rows, count))
        self.mass = np.zeros((rows, count))
        self._attracted = np.zeros((rows, count), dtype=np.bool_)
        self.held = np.full(count, NO_PART, dtype=np.int64)
        """Index of the part on each magnet, or `NO_PART`, (N,)."""
        self._grip = np.zeros((3, count))
        """Pose of the held part relative to the tool: x, y, yaw in the tool frame; m, m, rad."""
        self.held_height = np.zeros(count)
        """Distance from the tip down to the bottom of the held part, m, (N,)."""
        self._held_radius = np.zeros(count)
        self.highest = np.empty(count)
        """World z of the highest object of the scene, without the held part, m, (N,)."""
        for rig, scene in enumerate(scenes):
            for row, part in enumerate(scene.parts):
                self._radius[row, rig] = part.radius
                self.half_height[row, rig] = part.size[2] / 2
                self.mass[row, rig] = part.mass
                self._attracted[row, rig] = part.ferromagnetic
        self._reach = np.array([scene.magnet_reach for scene in scenes])
        self._gap = np.array([scene.magnet_gap for scene in scenes])
        self._static = StaticGeometry(scenes, reach)
        self.moving = np.zeros(count, dtype=np.bool_)
        """Whether a part moved in the last step, (N,)."""
        self._any_moving = False
        self.holds = np.zeros(count, dtype=np.bool_)
        """Whether the magnet holds a part, (N,)."""
        self.holding = False
        """Whether any magnet holds a part."""
        self.falling = False
        """Whether any part of any rig is falling."""
        for rig in range(count):
            self.reset(rig)

    def reset(self, rig: int) -> None:
        """Move every part of a rig to its start pose."""
        for row, part in enumerate(self._scenes[rig].parts):
            self.x[row, rig], self.y[row, rig], self.z[row, rig] = part.position
            self.yaw[row, rig] = part.yaw
        self._falling[:, rig] = False
        self.falling = bool(self._falling.any())
        self._fall_speed[:, rig] = 0.0
        self._drift[:, :, rig] = 0.0
        self._clear_held(np.array([rig]))
        self._moved(rig)

    def copy_state_from(self, other: "World", mine: Ints, theirs: Ints) -> None:
        """Copy the state of the rigs `theirs` of another world with the same scenes to the rigs `mine`."""
        rows = min(self.x.shape[0], other.x.shape[0])
        for name in ("x", "y", "z", "yaw", "_fall_speed", "_falling"):
            getattr(self, name)[:rows, mine] = getattr(other, name)[:rows, theirs]
        self._drift[:, :rows, mine] = other._drift[:, :rows, theirs]
        for name in ("held", "_grip", "held_height", "_held_radius", "highest", "moving", "holds"):
            getattr(self, name)[..., mine] = getattr(other, name)[..., theirs]
        self.falling = bool(self._falling.any())
        self.holding = bool(self.holds.any())
        self._any_moving = bool(self.moving.any())

    def set_state(self, rig: int, poses: Sequence[tuple[float, float, float, float]], held: int, tip: Floats) -> None:
        """Set the parts of a rig to poses (x, y, z, yaw), at rest; part `held` is on the magnet at `tip`, (4,)."""
        for row, pose in enumerate(poses):
            self.x[row, rig], self.y[row, rig], self.z[row, rig], self.yaw[row, rig] = pose
        self._falling[:, rig] = False
        self.falling = bool(self._falling.any())
        self._fall_speed[:, rig] = 0.0
        self._drift[:, :, rig] = 0.0
        rigs = np.array([rig])
        self._clear_held(rigs)
        if held != NO_PART:
            self._hold(rigs, np.array([held]), tip[:, np.newaxis])
        else:
            self._refresh_highest(rigs)

    def begin_step(self) -> None:
        """Clear the flags of moved parts at the start of a step."""
        if self._any_moving:
            self.moving[:] = False
            self._any_moving = False

    def at_rest(self, rig: int) -> bool:
        """Return whether each part of a rig is held or lies on a surface."""
        rows = [row for row in range(len(self.part_names[rig])) if row != self.held[rig]]
        return all(abs(self._bottom(row, rig) - self._support_of(row, rig)) <= CONTACT_TOLERANCE_M for row in rows)

    def release(self, rigs: Ints, tip: Floats, tip_velocity: Floats) -> None:
        """Switch off the magnets of these rigs, which hold parts: the parts fall with the velocity that they have.

        Args:
            rigs: indices, (K,).
            tip: tool poses (x, y, z, yaw) of these rigs, (4, K).
            tip_velocity: their derivatives, (4, K).
        """
        rows = self.held[rigs]
        self._falling[rows, rigs] = True
        self.falling = True
        self._fall_speed[rows, rigs] = 0.0
        if self._ballistic:
            x, y = self.footprint_center(rigs, tip)
            vx, vy, vz, turn = tip_velocity
            self._drift[0, rows, rigs] = vx - turn * (y - tip[1])
            self._drift[1, rows, rigs] = vy + turn * (x - tip[0])
            self._fall_speed[rows, rigs] = -vz
        self._clear_held(rigs)

    @property
    def velocity(self) -> tuple[Floats, Floats, Floats]:
        """Velocities of the parts along x, y and z, m/s, (P, N) each; 0 for parts that do not fall."""
        return self._drift[0], self._drift[1], 0.0 - self._fall_speed

    def pick(self, rigs: Ints, tip: Floats) -> Ints:
        """Pick the parts within reach of the magnets of these rigs, which are on and hold no part.

        Args:
            rigs: indices, (K,).
            tip: tool poses (x, y, z, yaw) of these rigs, (4, K).

        Returns:
            The rigs that picked a part.
        """
        if not self.x.shape[0]:
            return rigs[:0]
        x, y, z, _ = tip
        dx, dy = self.x[:, rigs] - x, self.y[:, rigs] - y
        squared = dx * dx + dy * dy
        top = self.z[:, rigs] + self.half_height[:, rigs]
        # The tolerance prevents that rounding decides at the limit of the gap.
        near = np.abs(top - z) <= self._gap[rigs] + CONTACT_TOLERANCE_M
        near &= self._attracted[:, rigs] & (squared <= self._reach[rigs] * self._reach[rigs])
        picking = near.any(axis=0)
        if not picking.any():
            return rigs[:0]
        nearest = np.argmin(np.where(near, squared, np.inf), axis=0)
        picked: Ints = rigs[picking]
        self._hold(picked, nearest[picking], tip[:, picking])
        # Parts that lay on the picked part now fall.
        starts = np.ones((self.x.shape[0], picked.size), dtype=np.bool_)
        if self._ballistic:
            starts = ~self._falling[:, picked]
            starts[self.held[picked], np.arange(picked.size)] = True
            self._drift[:, :, picked] = np.where(starts, 0.0, self._drift[:, :, picked])
        self._falling[:, picked] = True
        self._falling[self.held[picked], picked] = False
        self.falling = bool(self._falling.any())
        self._fall_speed[:, picked] = np.where(starts, 0.0, self._fall_speed[:, picked])
        return picked

    def payload(self) -> Floats:
        """Return m4, the mass of the held part of each rig, kg, (N,)."""
        payload = np.zeros(self.held.size)
        holding = np.flatnonzero(self.held != NO_PART)
        payload[holding] = self.mass[self.held[holding], holding]
        return payload

    def contact(self, rigs: Rigs, x: Floats, y: Floats, bottom: Floats) -> Floats:
        """Return the world z, m, (K,), of the surface that a tool, or its held part, would stop on.

        Args:
            rigs: K rigs.
            x: x of the tool or of the center of the held part, world, m, (K,).
            y: y of the same point.
            bottom: z of its lowest point so far, m, (K,): a higher object is beside it, not below.
        """
        return self._support(rigs, x, y, self._held_radius[rigs], bottom, self.held[rigs])

    def footprint_center(self, rigs: Rigs, tip: Floats) -> tuple[Floats, Floats]:
        """Return x, y of the center of the held part, or of the tip without a part; world, m, (K,) each."""
        x, y, _, yaw = tip
        if not self.holding:
            return x, y
        c, s = np.cos(yaw), np.sin(yaw)
        grip_x, grip_y, _ = self._grip[:, rigs]
        return x + (c * grip_x - s * grip_y), y + (s * grip_x + c * grip_y)

    def move_held_parts(self, rigs: Ints, tip: Floats) -> None:
        """Move the held parts of these rigs with their tools at poses (x, y, z, yaw), (4, K)."""
        rows = self.held[rigs]
        self.x[rows, rigs], self.y[rows, rigs] = self.footprint_center(rigs, tip)
        self.z[rows, rigs] = tip[2] - self.held_height[rigs] + self.half_height[rows, rigs]
        self.yaw[rows, rigs] = tip[3] + self._grip[2, rigs]
        self._moved(rigs)

    def fall(self, duration: float) -> None:
        """Move the falling parts for `duration`, s; a part stops on the surface below it."""
        for rig in np.flatnonzero(self._falling.any(axis=0)).tolist():
            something_falls = False
            # The lowest part first: parts above it stop on its new position.
            rows = np.flatnonzero(self._falling[:, rig]).tolist()
            for row in sorted(rows, key=lambda row: self._bottom(row, rig)):
                speed = self._fall_speed[row, rig] + GRAVITY * duration
                self._fall(row, rig, duration)
                if something_falls and not self._falling[row, rig]:
                    # The part below it may be falling itself.
                    self._falling[row, rig] = True
                    if self._ballistic:
                        self._fall_speed[row, rig] = min(speed, self._support_speed(row, rig))
                something_falls |= bool(self._falling[row, rig])
            self._refresh_highest(np.array([rig]))
        self.falling = bool(self._falling.any())

    def _support_speed(self, row: int, rig: int) -> float:
        """Return the speed, m/s, at which the parts below a part fall; 0 if it is on another surface."""
        dx, dy = self.x[:, rig] - self.x[row, rig], self.y[:, rig] - self.y[row, rig]
        top = self.z[:, rig] + self.half_height[:, rig]
        below = np.hypot(dx, dy) < self._radius[:, rig] + self._radius[row, rig]
        below &= np.abs(top - self._bottom(row, rig)) <= CONTACT_TOLERANCE_M
        below[self.held[rig]] &= self.held[rig] == NO_PART
        return float(self._fall_speed[below, rig].min()) if below.any() else 0.0

    def _fall(self, row: int, rig: int, duration: float) -> None:
        drift = self._drift[:, row, rig]
        distance = float(np.hypot(*drift)) * duration
        # A part that drifts may pass the edge of an object below it.
        number = max(1, math.ceil(distance / FALL_RESOLUTION_M))
        time = duration / number
        for _ in range(number):
            before = self.x[row, rig], self.y[row, rig]
            if distance:
                self.x[row, rig], self.y[row, rig] = before + drift * time
            bottom, support = self._bottom(row, rig), self._support_of(row, rig)
            speed = self._fall_speed[row, rig]
            lower = bottom - (speed * time + 0.5 * GRAVITY * time * time)
            self._fall_speed[row, rig] = speed + GRAVITY * time if lower > support else 0.0
            self.z[row, rig] = max(lower, support) + self.half_height[row, rig]
            if lower <= support:
                self._falling[row, rig] = False
                if distance:
                    height = max(bottom - support, 0.0)
                    landing = (math.sqrt(speed * speed + 2 * GRAVITY * height) - speed) / GRAVITY
                    self.x[row, rig], self.y[row, rig] = before + drift * landing
                    self._drift[:, row, rig] = 0.0
                break
        self._moved(rig)

    def _hold(self, rigs: Ints, rows: Ints, tip: Floats) -> None:
        x, y, z, yaw = tip
        c, s = np.cos(yaw), np.sin(yaw)
        dx, dy = self.x[rows, rigs] - x, self.y[rows, rigs] - y
        self._grip[0, rigs] = c * dx + s * dy
        self._grip[1, rigs] = c * dy - s * dx
        self._grip[2, rigs] = self.yaw[rows, rigs] - yaw
        self.held[rigs] = rows
        half = self.half_height[rows, rigs]
        # A tip that entered a part from the side holds it at its height: otherwise the part would sink into the table.
        inside = np.maximum(self.z[rows, rigs] + half - z, 0.0)
        self.held_height[rigs] = 2 * half - np.rint(inside / _DEPTH_RESOLUTION) * _DEPTH_RESOLUTION
        self._held_radius[rigs] = self._radius[rows, rigs]
        self.z[rows, rigs] = z - self.held_height[rigs] + half
        self._hold_changed()
        self._moved(rigs)
        self._refresh_highest(rigs)

    def _clear_held(self, rigs: Ints) -> None:
        self.held[rigs] = NO_PART
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
        np.not_equal(self.held, NO_PART, out=self.holds)
        self.holding = bool(self.holds.any())

    def _refresh_highest(self, rigs: Ints) -> None:
        top = self.z[:, rigs] + self.half_height[:, rigs]
        top = np.where(self._row_numbers == self.held[rigs], -np.inf, top)
        self.highest[rigs] = np.maximum(top.max(axis=0, initial=-np.inf), self._static.highest[rigs])

    def _bottom(self, row: int, rig: int) -> float:
        return float(self.z[row, rig] - self.half_height[row, rig])

    def _support_of(self, row: int, rig: int) -> float:
        """Return the world z of the surface that a part lies on or would fall on, m."""
        one = np.array([rig])
        bottom = np.array([self._bottom(row, rig)])
        radius = self._radius[row, one]
        height = self._support(
            one, self.x[row, one], self.y[row, one], radius, bottom, np.array([row]), in_reach=not self._ballistic
        )
        return float(height[0])

    def _support(
        self,
        rigs: Rigs,
        x: Floats,
        y: Floats,
        radius: Floats,
        bottom: Floats,
        ignored: Ints,
        *,
        in_reach: bool = True,
    ) -> Floats:
        """Return the highest top, m, (K,), under discs and not above `bottom`; `ignored`: the parts of the discs.

        `in_reach`: whether the discs are within reach of the arm.
        """
        height = self._static.under(rigs, x, y, radius, bottom, in_reach=in_reach)
        if not self.x.shape[0]:
            return height
        dx, dy = self.x[:, rigs] - x, self.y[:, rigs] - y
        together = self._radius[:, rigs] + radius
        top = self.z[:, rigs] + self.half_height[:, rigs]
        under = (dx * dx + dy * dy < together * together) & (top <= bottom + CONTACT_TOLERANCE_M)
        # A held part is no support for other parts.
        under &= self._row_numbers != ignored
        if self.holding:
            under &= self._row_numbers != self.held[rigs]
        return np.asarray(np.maximum(height, np.where(under, top, -np.inf).max(axis=0)))
