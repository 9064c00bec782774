"""One step of N rigs: magnet, motion, stops, contact, falling parts. A pure function of state, effort and parameters.

`Plant` owns the state and the scratch memory of the step; it knows no clock and no bus, so the same object runs in
real time, in a recording's verification and in a study of a thousand rigs. Between two steps everything that the
next one depends on is in the published state, but for the speed of a part that is falling.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.dynamics import ReducedDynamics
from hilrig_sim.arm.integrators import TABLEAUS, Tableau
from hilrig_sim.arm.model import RigParameters
from hilrig_sim.arm.stepping import FixedStep
from hilrig_sim.plant.hard_stops import crossing, stop_outward
from hilrig_sim.plant.limits import Happening, LimitFlags, PlantEvent, any_true
from hilrig_sim.plant.static_geometry import TOUCHING
from hilrig_sim.plant.world import ALL, NONE, World

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_TRUE: Final = b"\x01"
_FALSE: Final = b"\x00"


class Plant:
    """N rigs that step together; they share step length, sub-steps and integrator, all else is each rig's own."""

    def __init__(self, rigs: Sequence[RigParameters]) -> None:
        """Start every rig at its start pose.

        Raises:
            InputError: no rig is given, or their steps differ.
        """
        if not rigs:
            raise InputError("a plant needs at least one rig")
        if len({rig.sim for rig in rigs}) > 1:
            raise InputError("rigs that step together need the same step, sub-steps and integrator")
        self.rigs = tuple(rigs)
        count = len(rigs)
        sim = rigs[0].sim
        self._arms = [rig.arm for rig in rigs]
        self._tableau: Tableau = TABLEAUS[sim.integrator]
        self._substeps = sim.substeps
        self._step = sim.step / sim.substeps
        self.position = np.empty((4, count))
        """q: rad, rad, m, rad, (4, N)."""
        self.velocity = np.zeros((4, count))
        """q̇: rad/s, rad/s, m/s, rad/s, (4, N)."""
        self.error = np.zeros((4, count))
        """Embedded estimate of the last integration step's error of q, (4, N)."""
        self.world = World([rig.scene for rig in rigs], max(arm.l2 + arm.l3 for arm in self._arms))
        self.dynamics = ReducedDynamics(self._arms)
        self._integrator = FixedStep(self.dynamics, self._tableau, self._step)
        self._l1 = np.array([arm.l1 for arm in self._arms])
        self._lower = np.array([arm.lower for arm in self._arms]).T.copy()
        self._stop = np.array([arm.upper for arm in self._arms]).T.copy()
        self._upper = self._stop.copy()
        """Upper stops, those of the quill raised to what lies below the tool."""
        self._free3 = np.empty(count)
        """d3 up to which nothing can be below the tool, m, (N,)."""
        self._at_lower = np.zeros((4, count), dtype=np.bool_)
        self._at_upper = np.zeros((4, count), dtype=np.bool_)
        self._switched = np.zeros(count, dtype=np.bool_)
        self._low = np.zeros(count, dtype=np.bool_)
        self._contact_known = np.full((4, count), np.nan)
        """θ1, θ2, d3 at the start of the step, θ4 for which `_upper` was found, (4, N)."""
        self._contact_place = np.empty((4, count))
        self._contact_differs = np.zeros((4, count), dtype=np.bool_)
        self._contact_unknown = np.zeros(count, dtype=np.bool_)
        self._start_position = np.empty((4, count))
        self._start_velocity = np.empty((4, count))
        self._limits = LimitFlags(self._stop[2])
        self._touching_plane = False
        self._nothing_held = (np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_))
        self._held = self._nothing_held
        self._events: list[PlantEvent] = []
        self.position[:] = np.array([arm.start for arm in self._arms]).T
        self._begin_anew()

    @property
    def count(self) -> int:
        """How many rigs there are."""
        return len(self.rigs)

    @property
    def limit_flags(self) -> Sequence[int]:
        """For each rig: bit j-1 joint j on its lower stop, bit 3+j on its upper one, bit 8 tool on what is below it."""
        return self._limits.flags

    def tool(self, rigs: Ints | slice) -> Floats:
        """Poses (x, y, z, yaw) of the tools of some rigs, (4, K); (1)–(4)."""
        theta1, theta2, d3, theta4 = position = self.position[:, rigs]
        l2, l3 = self.dynamics.l2[rigs], self.dynamics.l3[rigs]
        pose = np.empty_like(position)
        sum12 = theta1 + theta2
        pose[0] = l2 * np.cos(theta1) + l3 * np.cos(sum12)
        pose[1] = l2 * np.sin(theta1) + l3 * np.sin(sum12)
        np.subtract(self._l1[rigs], d3, pose[2])
        np.add(sum12, theta4, pose[3])
        return pose

    def reset(self, rig: int) -> None:
        """Put a rig and its parts back to the start, at rest."""
        self.position[:, rig] = self._arms[rig].start
        self.velocity[:, rig] = 0.0
        self.error[:, rig] = 0.0
        self.world.reset(rig)
        self._begin_anew()

    def place(
        self,
        rig: int,
        position: Sequence[float],
        velocity: Sequence[float],
        parts: Sequence[tuple[float, float, float, float]] | None = None,
        held: int = NONE,
    ) -> None:
        """Set a rig's state: q and q̇, (4,) each, and where its parts are (x, y, z, yaw); None: as they are."""
        self.position[:, rig] = position
        self.velocity[:, rig] = velocity
        if parts is not None:
            self.world.place(rig, parts, held, self.tool(np.array([rig]))[:, 0])
        self._begin_anew()

    def adopt(self, other: "Plant", mine: Sequence[int], theirs: Sequence[int]) -> None:
        """Take over the state of rigs of another plant with the same parameters: `mine[i]` goes on as `theirs[i]`."""
        here, there = np.array(mine, dtype=np.int64), np.array(theirs, dtype=np.int64)
        self.position[:, here] = other.position[:, there]
        self.velocity[:, here] = other.velocity[:, there]
        self.error[:, here] = other.error[:, there]
        self.world.adopt(other.world, here, there)
        self._begin_anew()

    def step(self, effort: Floats, magnet: Bools) -> Sequence[PlantEvent]:
        """Move every rig on by one step of the loop; says what happened, in a list that the next step reuses.

        Args:
            effort: τ1, τ2, τ3, τ4 of each rig, finite, constant over the step; N·m, N·m, N, N·m, (4, N).
            magnet: which magnets are on, (N,).
        """
        events = self._events
        if events:
            events.clear()
        world = self.world
        world.begin_step()
        np.not_equal(magnet, world.holds, self._switched)
        if any_true(self._switched):
            self._switch_magnets(magnet)
        for _ in range(self._substeps):
            self._substep(effort)
        if world.holding:
            holding = np.flatnonzero(world.holds)
            world.carry(holding, self.tool(holding))
        if world.falling:
            world.fall(self._step * self._substeps)
            self._world_changed()
        return events

    def _switch_magnets(self, magnet: Bools) -> None:
        world = self.world
        dropping = np.flatnonzero(self._switched & world.holds)
        if dropping.size:
            for rig in dropping:
                self._events.append(PlantEvent(Happening.PART_DROPPED, int(rig), part=int(world.held[rig])))
            world.release(dropping)
            self.dynamics.set_payload(world.payload())
        wanting = np.flatnonzero(self._switched & magnet)
        if wanting.size:
            taken = world.attract(wanting, self.tool(wanting))
            if taken.size:
                for rig in taken:
                    self._events.append(PlantEvent(Happening.PART_PICKED, int(rig), part=int(world.held[rig])))
                self._share_momentum(taken)
        if self._events:
            self._world_changed()

    def _share_momentum(self, rigs: Ints) -> None:
        """A part at rest is taken along: momentum stays, energy goes, as in any inelastic impact."""
        dynamics = self.dynamics
        before = [element[rigs] for element in dynamics.mass_matrix_12(self.position[1])]
        mass3 = (dynamics.m3 + dynamics.payload)[rigs]
        dynamics.set_payload(self.world.payload())
        alpha, a12, a22 = (element[rigs] for element in dynamics.mass_matrix_12(self.position[1]))
        v1, v2, v3, _ = self.velocity[:, rigs]
        p1, p2 = before[0] * v1 + before[1] * v2, before[1] * v1 + before[2] * v2
        determinant = alpha * a22 - a12 * a12
        self.velocity[0, rigs] = (a22 * p1 - a12 * p2) / determinant
        self.velocity[1, rigs] = (alpha * p2 - a12 * p1) / determinant
        self.velocity[2, rigs] = v3 * mass3 / (dynamics.m3 + dynamics.payload)[rigs]

    def _substep(self, effort: Floats) -> None:
        position, velocity = self.position, self.velocity
        self._held = self._nothing_held
        held = self._touching_plane and self._hold_pressed(effort)
        self._start_position[:] = position
        self._start_velocity[:] = velocity
        self._integrator.advance(position, velocity, effort, self.error)
        if held:
            self.dynamics.release()
        np.greater(position[2], self._free3, self._low)
        if any_true(self._low):
            self._find_contact()
        lower, upper = self._at_lower, self._at_upper
        np.less_equal(position, self._lower, lower)
        np.greater_equal(position, self._upper, upper)
        at_lower, at_upper = lower.tobytes(), upper.tobytes()
        if not (_TRUE in at_lower or _TRUE in at_upper):
            if self._limits.any:
                self._touching_plane = False
                self._limits.update(self._at_lower, self._at_upper, self._upper[2], None, self._events)
            return
        arriving = velocity.copy()
        plane = 2 * self.count
        self._touching_plane = _TRUE in at_lower[:plane] or _TRUE in at_upper[:plane]
        if self._touching_plane:
            self._impact(effort)
            np.less_equal(position, self._lower, lower)
            np.greater_equal(position, self._upper, upper)
        # Joints 3 and 4 move by themselves: to stop them is to stop where the limit is.
        np.maximum(position, self._lower, out=position)
        np.minimum(position, self._upper, out=position)
        speed34, lower34, upper34 = velocity[2:], lower[2:], upper[2:]
        np.maximum(speed34, 0.0, out=speed34, where=lower34)
        np.minimum(speed34, 0.0, out=speed34, where=upper34)
        self._limits.update(lower, upper, self._upper[2], arriving, self._events)

    def _hold_pressed(self, effort: Floats) -> bool:
        """Hold joints 1 and 2 where they are pressed onto a stop at the start of a step; whether any is."""
        rates = self._integrator.accelerations(self.position, self.velocity, effort)
        # Only what rests on a stop can be held there; what moves off it is free.
        side = np.where(self.velocity[:2] == 0, _sides(self.position, self._lower, self._stop), 0.0)
        if not any_true(side * rates[:2] > 0):
            return False
        theta2 = self.position[1]
        _, _, held1, held2 = stop_outward(rates[0], rates[1], side[0], side[1], self.dynamics.mass_matrix_12(theta2))
        self._held = held1, held2
        self.dynamics.hold(held1, held2, theta2)
        return True

    def _find_contact(self) -> None:
        """Raise the quill's stop to what lies below the tool, where it may reach it."""
        world, place = self.world, self._contact_place
        # What lies below is known where neither the tool nor the scene has changed since it was found.
        place[:] = self.position
        place[2] = self._start_position[2]
        np.not_equal(place, self._contact_known, self._contact_differs)
        np.logical_and(self._contact_differs, self._low, self._contact_differs)
        if not any_true(self._contact_differs):
            return
        np.logical_or.reduce(self._contact_differs, axis=0, out=self._contact_unknown)
        # A view where all are asked for: with few rigs, to pick columns costs more than to compute with them.
        rigs = np.flatnonzero(self._contact_unknown) if _FALSE in self._contact_unknown.tobytes() else ALL
        self._contact_known[:, rigs] = place[:, rigs]
        tip = self.tool(rigs)
        bottom = self._l1[rigs] - self._start_position[2, rigs] - world.held_height[rigs]
        x, y = world.footprint_centre(rigs, tip)
        below = world.contact(rigs, x, y, bottom)
        self._upper[2, rigs] = np.minimum(self._stop[2, rigs], self._l1[rigs] - world.held_height[rigs] - below)

    def _impact(self, effort: Floats) -> None:
        """Stop joints 1 and 2 at their limits: at the time within the step at which they get there."""
        position, velocity = self.position, self.velocity
        beyond = (position[:2] < self._lower[:2]) | (position[:2] > self._stop[:2])
        if any_true(beyond):
            rigs = np.flatnonzero(beyond.any(axis=0))
            limit = np.where(position[:2] > self._stop[:2], self._stop[:2], self._lower[:2])[:, rigs]
            q0, v0 = self._start_position[:, rigs], self._start_velocity[:, rigs]
            q1, v1 = position[:, rigs], velocity[:, rigs]
            outside = beyond[:, rigs]
            shares = np.ones((2, rigs.size))
            for joint in (0, 1):
                share = crossing(q0[joint], q1[joint], v0[joint] * self._step, v1[joint] * self._step, limit[joint])
                shares[joint] = np.where(outside[joint], share, 1.0)
            first = shares.min(axis=0)
            arms = [self._arms[rig] for rig in rigs]
            dynamics = ReducedDynamics(arms)
            dynamics.set_payload(self.dynamics.payload[rigs])
            dynamics.hold(self._held[0][rigs], self._held[1][rigs], q0[1])
            acting = effort[:, rigs]
            plane, plane_rate = q0.copy(), v0.copy()
            FixedStep(dynamics, self._tableau, first * self._step).advance(plane, plane_rate, acting)
            arriving = outside & (shares == first)
            np.copyto(plane[:2], limit, where=arriving)
            side = _sides(plane, self._lower[:, rigs], self._stop[:, rigs])
            self._stop_plane(dynamics, plane, plane_rate, side)
            # The rest of the step goes on from the stop, pressed onto it or leaving it.
            rest = FixedStep(dynamics, self._tableau, (1.0 - first) * self._step)
            rates = rest.accelerations(plane, plane_rate, acting)
            mass = dynamics.mass_matrix_12(plane[1])
            resting = np.where(plane_rate[:2] == 0, side, 0.0)
            _, _, held1, held2 = stop_outward(rates[0], rates[1], resting[0], resting[1], mass)
            dynamics.hold(held1, held2, plane[1])
            rest.advance(plane, plane_rate, acting)
            # Joints 3 and 4 had the whole step already.
            position[:2, rigs], velocity[:2, rigs] = plane[:2], plane_rate[:2]
            np.maximum(position[:2], self._lower[:2], out=position[:2])
            np.minimum(position[:2], self._stop[:2], out=position[:2])
        # What is at a stop at the end, by a second impact in one step or since before, does not move outwards.
        self._stop_plane(self.dynamics, position, velocity, _sides(position, self._lower, self._stop))

    @staticmethod
    def _stop_plane(dynamics: ReducedDynamics, position: Floats, velocity: Floats, side: Floats) -> None:
        if any_true(side * velocity[:2] > 0):
            mass = dynamics.mass_matrix_12(position[1])
            velocity[0], velocity[1], _, _ = stop_outward(velocity[0], velocity[1], side[0], side[1], mass)

    def _begin_anew(self) -> None:
        """Derive everything from position, velocity and the world's parts."""
        self.dynamics.set_payload(self.world.payload())
        self._world_changed()
        np.greater(self.position[2], self._free3, self._low)
        if any_true(self._low):
            self._start_position[:] = self.position
            self._find_contact()
        np.less_equal(self.position, self._lower, self._at_lower)
        np.greater_equal(self.position, self._upper, self._at_upper)
        self._touching_plane = bool(self._at_lower[:2].any() or self._at_upper[:2].any())
        self._limits.update(self._at_lower, self._at_upper, self._upper[2], None, self._events)

    def _world_changed(self) -> None:
        """Forget what was known of what lies below the tools."""
        self._contact_known.fill(np.nan)
        self._upper[2] = self._stop[2]
        np.subtract(self._l1, self.world.held_height, out=self._free3)
        np.subtract(self._free3, self.world.highest, out=self._free3)
        np.subtract(self._free3, TOUCHING, out=self._free3)


def _sides(position: Floats, lower: Floats, upper: Floats) -> Floats:
    """+1 where joints 1 and 2 are on their upper stops, -1 on their lower ones, else 0, (2, N)."""
    return (position[:2] >= upper[:2]).astype(np.float64) - (position[:2] <= lower[:2])
