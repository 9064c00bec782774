"""Plant of N rigs: one step computes magnet, motion, stops, contact and falling parts.

A step is a pure function of state, effort and parameters. `Plant` owns the state and the scratch memory of the step. It
has no clock and no bus, so the same class runs in real time, in the verification of a recording and in a study of a
thousand rigs. The published state contains everything that the next step depends on.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.dynamics import ReducedDynamics
from hilrig_sim.arm.integrators import TABLEAUS, Tableau
from hilrig_sim.arm.model import AUTO, RigParameters
from hilrig_sim.arm.stability import ERROR_BOUND, base_substeps, longest_turn
from hilrig_sim.arm.stepping import FixedStep
from hilrig_sim.plant.hard_stops import crossing, first_arrival, hermite, stop_outward
from hilrig_sim.plant.limits import LimitFlags, PlantEvent, PlantEventKind, any_true
from hilrig_sim.plant.linear_joints import first_impact, move_between_stops
from hilrig_sim.plant.plane_solver import STEP_TOLERANCE, PlaneSolver
from hilrig_sim.plant.static_geometry import CONTACT_TOLERANCE_M
from hilrig_sim.plant.world import ALL_RIGS, NO_PART, World

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

EDGE_BISECTIONS: Final = 8
"""Bisections of the time at which a tool leaves the edge of an object."""
_TRUE: Final = b"\x01"
_FALSE: Final = b"\x00"


class Plant:
    """N rigs that step together; they have one step length, number of sub-steps and integrator."""

    def __init__(self, rigs: Sequence[RigParameters]) -> None:
        """Initialize every rig at its start pose.

        Raises:
            InputError: no rig is given, or the step parameters of the rigs differ.
        """
        if not rigs:
            raise InputError("a plant needs at least one rig, got none")
        if len({rig.sim for rig in rigs}) > 1:
            raise InputError("rigs of one simulation must have the same step, sub-steps and integrator")
        self.rigs = tuple(rigs)
        count = len(rigs)
        sim = rigs[0].sim
        self._arms = [rig.arm for rig in rigs]
        self._tableau: Tableau = TABLEAUS[sim.integrator]
        base = [sim.substeps if sim.substeps != AUTO else base_substeps(arm, sim) for arm in self._arms]
        self._adaptive = sim.substeps == AUTO
        self._base_substeps = np.array(base)
        self._lengths = sim.step / self._base_substeps
        """Length of an integration step of each rig, before it is divided further, s, (N,)."""
        self._duration = sim.step if self._adaptive else float(self._lengths[0]) * base[0]
        self.substeps = self._base_substeps.copy()
        """Number of integration steps of the last step, (N,)."""
        self.position = np.empty((4, count))
        """q: rad, rad, m, rad, (4, N)."""
        self.velocity = np.zeros((4, count))
        """q̇: rad/s, rad/s, m/s, rad/s, (4, N)."""
        self.error = np.zeros((4, count))
        """Embedded error estimate of q for the last integration step, (4, N)."""
        reach = max(arm.l2 + arm.l3 for arm in self._arms)
        self.world = World([rig.scene for rig in rigs], reach, ballistic=sim.plant_version > 1)
        self.dynamics = ReducedDynamics(self._arms)
        self._integrators = self._steppers()
        self._integrator = self._integrators[0]
        self._l1 = np.array([arm.l1 for arm in self._arms])
        self._lower = np.array([arm.lower for arm in self._arms]).T.copy()
        self._stop = np.array([arm.upper for arm in self._arms]).T.copy()
        self._upper = self._stop.copy()
        """Upper stops; that of the quill is reduced where an object is below the tool."""
        self._free3 = np.empty(count)
        """d3 up to which the tool cannot touch any object, m, (N,)."""
        self._at_lower = np.zeros((4, count), dtype=np.bool_)
        self._at_upper = np.zeros((4, count), dtype=np.bool_)
        self._regular = np.ones((4, 4, count), dtype=np.bool_)
        """Where an integration step is valid: each joint is above its lower stop, below its upper stop, did not turn,
        and its error estimate is small; (4, 4, N)."""
        self._refined = False
        self._switched = np.zeros(count, dtype=np.bool_)
        self._low = np.zeros(count, dtype=np.bool_)
        self._contact_known = np.full((4, count), np.nan)
        """θ1, θ2, d3 at the start of the step, and θ4, for which `_upper` was computed, (4, N)."""
        self._contact_pose = np.empty((4, count))
        self._contact_differs = np.zeros((4, count), dtype=np.bool_)
        self._contact_unknown = np.zeros(count, dtype=np.bool_)
        self._start_position = np.empty((4, count))
        self._start_velocity = np.empty((4, count))
        self._limits = LimitFlags(self._stop[2])
        self._touching_plane = False
        self._surface = np.empty(count)
        """Upper stop of the quill at the start of the integration step, m, (N,)."""
        self._leaving = np.zeros(count, dtype=np.bool_)
        self._work = np.empty((4, count))
        self._step_error = np.zeros((4, count))
        self._tolerance = np.empty((4, count))
        self._tolerance[:] = np.array(STEP_TOLERANCE)[:, np.newaxis]
        self._error_bound = np.empty((4, count))
        self._error_bound[:] = np.array(ERROR_BOUND)[:, np.newaxis]
        self._inaccurate = np.zeros((4, count), dtype=np.bool_)
        self._nothing_held = (np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_))
        self._held = self._nothing_held
        turns = np.array([longest_turn(arm, sim) for arm in self._arms])
        self._largest_speed2 = turns / self._lengths
        """Speed of joint 2 above which an integration step is divided, rad/s, (N,)."""
        self._turn_limited = bool(np.isfinite(turns).any())
        self._plane = PlaneSolver(
            self._arms, self.dynamics, self._tableau, self._lower[:2], self._stop[:2], turns, sim.step
        )
        self._events: list[PlantEvent] = []
        self._left: list[PlantEvent] = []
        """Impacts in the last integration step of fixed length."""
        self.position[:] = np.array([arm.start for arm in self._arms]).T
        self._refresh_derived_state()

    @property
    def count(self) -> int:
        """Number of rigs."""
        return len(self.rigs)

    @property
    def limit_flags(self) -> Sequence[int]:
        """For each rig: bit j-1 joint j at its lower stop, bit 3+j at its upper stop, bit 8 tool touches an object."""
        return self._limits.flags

    def is_inaccurate(self) -> bool:
        """Return whether the error estimate of the last step exceeds its bound for any rig."""
        np.absolute(self.error, self._work)
        np.greater(self._work, self._error_bound, self._inaccurate)
        return any_true(self._inaccurate)

    def tool(self, rigs: Ints | slice) -> Floats:
        """Return the tool poses (x, y, z, yaw) of rigs, (4, K); (1)–(4)."""
        theta1, theta2, d3, theta4 = position = self.position[:, rigs]
        l2, l3 = self.dynamics.l2[rigs], self.dynamics.l3[rigs]
        pose = np.empty_like(position)
        sum12 = theta1 + theta2
        pose[0] = l2 * np.cos(theta1) + l3 * np.cos(sum12)
        pose[1] = l2 * np.sin(theta1) + l3 * np.sin(sum12)
        np.subtract(self._l1[rigs], d3, pose[2])
        np.add(sum12, theta4, pose[3])
        return pose

    def _tool_velocity(self, rigs: Ints) -> Floats:
        """Return the derivatives of the tool poses of rigs, (4, K)."""
        theta1, theta2 = self.position[:2, rigs]
        v1, v2, v3, v4 = self.velocity[:, rigs]
        w2 = v1 + v2
        link1, link2 = self.dynamics.l2[rigs] * v1, self.dynamics.l3[rigs] * w2
        vx = -link1 * np.sin(theta1) - link2 * np.sin(theta1 + theta2)
        vy = link1 * np.cos(theta1) + link2 * np.cos(theta1 + theta2)
        return np.stack([vx, vy, -v3, w2 + v4])

    def reset(self, rig: int) -> None:
        """Move a rig and its parts to the start pose, at rest."""
        self.position[:, rig] = self._arms[rig].start
        self.velocity[:, rig] = 0.0
        self.error[:, rig] = 0.0
        self.world.reset(rig)
        self._refresh_derived_state()

    def set_state(
        self,
        rig: int,
        position: ArrayLike,
        velocity: ArrayLike,
        parts: Sequence[tuple[float, float, float, float]] | None = None,
        held: int = NO_PART,
    ) -> None:
        """Set the state of a rig: q and q̇, (4,) each, and the poses (x, y, z, yaw) of its parts; None: unchanged."""
        self.position[:, rig] = position
        self.velocity[:, rig] = velocity
        if parts is not None:
            self.world.set_state(rig, parts, held, self.tool(np.array([rig]))[:, 0])
        self._refresh_derived_state()

    def copy_state_from(self, other: "Plant", mine: Sequence[int], theirs: Sequence[int]) -> None:
        """Copy the state of the rigs `theirs` of another plant with the same parameters to the rigs `mine`."""
        here, there = np.array(mine, dtype=np.int64), np.array(theirs, dtype=np.int64)
        self.position[:, here] = other.position[:, there]
        self.velocity[:, here] = other.velocity[:, there]
        self.error[:, here] = other.error[:, there]
        self.world.copy_state_from(other.world, here, there)
        self._refresh_derived_state()

    def step(self, effort: Floats, magnet: Bools) -> Sequence[PlantEvent]:
        """Advance every rig by one step of the loop; return the events, in a list that the next step reuses.

        Args:
            effort: τ1, τ2, τ3, τ4 of each rig, finite, constant over the step; N·m, N·m, N, N·m, (4, N).
            magnet: whether each magnet is on, (N,).
        """
        events = self._events
        if events:
            events.clear()
        world = self.world
        world.begin_step()
        np.not_equal(magnet, world.holds, self._switched)
        if any_true(self._switched):
            self._switch_magnets(magnet)
        if self._adaptive:
            if self._refined:
                self.substeps[:] = self._base_substeps
                self._refined = False
            for number, integrator in enumerate(self._integrators):
                self._adaptive_substep(number, integrator, effort)
        else:
            for _ in self._integrators:
                self._substep(effort)
        if world.holding:
            holding = np.flatnonzero(world.holds)
            world.move_held_parts(holding, self.tool(holding))
        if world.falling:
            world.fall(self._duration)
            self._invalidate_contact()
        return events

    def _switch_magnets(self, magnet: Bools) -> None:
        world = self.world
        dropping = np.flatnonzero(self._switched & world.holds)
        if dropping.size:
            for rig in dropping:
                self._events.append(PlantEvent(PlantEventKind.PART_DROPPED, int(rig), part=int(world.held[rig])))
            world.release(dropping, self.tool(dropping), self._tool_velocity(dropping))
            self.dynamics.set_payload(world.payload())
        switching_on = np.flatnonzero(self._switched & magnet)
        if switching_on.size:
            picked = world.pick(switching_on, self.tool(switching_on))
            if picked.size:
                for rig in picked:
                    self._events.append(PlantEvent(PlantEventKind.PART_PICKED, int(rig), part=int(world.held[rig])))
                self._add_payload(picked)
        if self._events:
            self._invalidate_contact()

    def _add_payload(self, rigs: Ints) -> None:
        """Apply the inelastic impact of a picked part at rest: momentum is conserved, energy is not."""
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
        speed34, start34, start_speed34 = velocity[2:], self._start_position[2:], self._start_velocity[2:]
        turned34 = start_speed34 * speed34 < 0
        np.greater(position[2], self._free3, self._low)
        turns = any_true(turned34)
        if turns:
            self._add_turned_tools(turned34[0])
        if any_true(self._low):
            self._find_contact()
        if turns:
            # Until it turns, a joint moves at most half as far as with its speed at the start: friction only slows it.
            reach = start34 + 0.5 * self._lengths * start_speed34
            turned34 &= (reach < self._lower[2:]) | (reach > self._upper[2:])
            turns = any_true(turned34)
        lower, upper = self._at_lower, self._at_upper
        np.less_equal(position, self._lower, lower)
        np.greater_equal(position, self._upper, upper)
        lower34, upper34 = lower[2:], upper[2:]
        at_lower, at_upper = lower.tobytes(), upper.tobytes()
        at_limit = _TRUE in at_lower or _TRUE in at_upper
        self._left.clear()
        if at_limit:
            # A joint that was at its stop before has no impact.
            turned34 |= (lower34 & (start34 > self._lower[2:])) | (upper34 & (start34 < self._upper[2:]))
            turns = any_true(turned34)
        if turns:
            joint, rig = turned34.nonzero()
            impact = first_impact(*self._linear_arguments(joint, rig, effort), self._lengths[rig])
            self._left += self._linear_hits(joint, rig, *impact)
        if not at_limit:
            if self._limits.any:
                self._touching_plane = False
                self._limits.update(self._at_lower, self._at_upper, self._upper[2], None, self._events)
            self._events += self._left
            return
        plane = 2 * self.count
        self._touching_plane = _TRUE in at_lower[:plane] or _TRUE in at_upper[:plane]
        impact_velocity = velocity.copy()
        if self._touching_plane:
            self._impact(effort)
            np.less_equal(position, self._lower, lower)
            np.greater_equal(position, self._upper, upper)
        # Joints 3 and 4 are decoupled: an impact sets their position to the limit.
        np.maximum(position, self._lower, out=position)
        np.minimum(position, self._upper, out=position)
        np.maximum(speed34, 0.0, out=speed34, where=lower34)
        np.minimum(speed34, 0.0, out=speed34, where=upper34)
        # A joint that is not at its stop at the end of the step has left it.
        left = []
        for hit in self._left:
            row = (hit.joint or 3) - 1
            if (upper if hit.upper else lower)[row, hit.rig]:
                impact_velocity[row, hit.rig] = hit.speed
            else:
                left.append(hit)
        self._limits.update(lower, upper, self._upper[2], impact_velocity, self._events)
        self._events += left

    def _add_turned_tools(self, turned: Bools) -> None:
        """Add to `_low` the tools that turned, (N,), and may have touched an object within the integration step."""
        # While it turns, a tool moves less than with its speed at the start.
        self._low |= turned & (self._start_position[2] + self._lengths * self._start_velocity[2] > self._free3)

    def _steppers(self) -> list[FixedStep]:
        """Return the integrator of each integration step of a step; a rig with fewer of them has a length of zero."""
        base, dynamics, tableau = self._base_substeps, self.dynamics, self._tableau
        if base.min() == base.max():
            return [FixedStep(dynamics, tableau, float(self._lengths[0]))] * int(base[0])
        lengths = (np.where(number < base, self._lengths, 0.0) for number in range(int(base.max())))
        return [FixedStep(dynamics, tableau, length) for length in lengths]

    def _adaptive_substep(self, number: int, integrator: FixedStep, effort: Floats) -> None:
        """Make integration step `number` of a step, which is divided further for the rigs that need it."""
        position, velocity = self.position, self.velocity
        error = self._step_error if number else self.error
        above, below, straight, accurate = regular = self._regular
        self._start_position[:] = position
        start_velocity = self._start_velocity
        start_velocity[:] = velocity
        integrator.advance(position, velocity, effort, error)
        # A joint that turned within the step may have reached a stop.
        np.multiply(start_velocity, velocity, self._work)
        np.greater_equal(self._work, 0.0, straight)
        np.greater(position[2], self._free3, self._low)
        if _FALSE in straight[2].tobytes():
            self._add_turned_tools(~straight[2])
        leaves = False
        if any_true(self._low):
            self._surface[:] = self._upper[2]
            self._find_contact()
            leaves = self._limits.any and self._leaves_surface()
        np.absolute(error, error)
        np.less_equal(error, self._tolerance, accurate)
        if self._turn_limited:
            accurate[1] &= np.maximum(np.abs(start_velocity[1]), np.abs(velocity[1])) <= self._largest_speed2
        np.greater(position, self._lower, above)
        np.less(position, self._upper, below)
        if leaves or self._touching_plane or _FALSE in regular.tobytes():
            self._resolve(number, error, effort, leaves)
        elif self._limits.any:
            self._update_limits()
        if number:
            np.add(self.error, error, self.error)

    def _resolve(self, number: int, error: Floats, effort: Floats, leaves: bool) -> None:
        """Repeat an integration step for the rigs that reach or leave a stop, or are not accurate enough."""
        position, velocity, lower, upper = self.position, self.velocity, self._lower, self._upper
        start, start_velocity = self._start_position, self._start_velocity
        above, below, straight, accurate = self._regular
        repeat = ~(above & below & accurate)
        if _FALSE in straight.tobytes():
            repeat |= self._arrivals(~straight)
        if self._touching_plane:
            repeat[:2] |= (start[:2] <= lower[:2]) | (start[:2] >= upper[:2])
        if leaves:
            repeat[2] |= self._leaving
        if len(self._integrators) > 1:
            repeat &= number < self._base_substeps
        if not any_true(repeat):
            if self._limits.any:
                self._update_limits()
            return
        plane = np.logical_or(repeat[0], repeat[1])
        if any_true(plane):
            self._resolve_plane(np.flatnonzero(plane), error, effort)
            if any_true(self._low):
                self._find_contact()
                repeat[2] |= position[2] >= upper[2]
                leaves = self._limits.any and self._leaves_surface()
                if leaves:
                    repeat[2] |= self._leaving
        linear = repeat[2:]
        if any_true(linear):
            # A joint that is pushed against its stop from rest stays there.
            clipped = np.minimum(np.maximum(position[2:], lower[2:]), upper[2:])
            rests = linear & (clipped == start[2:]) & (start_velocity[2:] == 0)
            np.copyto(position[2:], clipped, where=rests)
            np.copyto(velocity[2:], 0.0, where=rests)
            np.copyto(error[2:], 0.0, where=rests)
            linear &= ~rests
            if any_true(linear):
                joint, rig = linear.nonzero()
                length = self._lengths[rig]
                if leaves:
                    leaving = (joint == 0) & self._leaving[rig]
                    length[leaving] *= 1 - self._edge_fraction(rig[leaving])
                self._resolve_linear(joint, rig, length, error, effort)
        self._update_limits()

    def _update_limits(self) -> None:
        at_lower, at_upper = self._at_lower, self._at_upper
        np.less_equal(self.position, self._lower, at_lower)
        np.greater_equal(self.position, self._upper, at_upper)
        self._touching_plane = any_true(at_lower[:2]) or any_true(at_upper[:2])
        self._limits.update(at_lower, at_upper, self._upper[2], None, self._events)

    def _arrivals(self, turned: Bools) -> Bools:
        """Return where a joint that turned within the integration step reached a stop before."""
        start, velocity, lower, upper, work = (
            self._start_position,
            self._start_velocity,
            self._lower,
            self._upper,
            self._work,
        )
        # While it turns, a joint moves less than with twice its speed: few joints can be near enough to a stop.
        np.multiply(velocity, 2 * self._lengths, work)
        np.add(start, work, work)
        arrives = turned & ((work < lower) | (work > upper))
        if any_true(arrives):
            at = np.nonzero(arrives)
            length = self._lengths[at[1]]
            fraction = first_arrival(
                start[at], self.position[at], length * velocity[at], length * self.velocity[at], lower[at], upper[at]
            )
            arrives[at] = fraction < 1
        return arrives

    def _resolve_plane(self, rigs: Ints, error: Floats, effort: Floats) -> None:
        q, v = self._start_position[:, rigs], self._start_velocity[:, rigs]
        errors, steps, impacts = self._plane.solve(
            rigs, q, v, effort[:, rigs], self._lengths[rigs], self.substeps[rigs]
        )
        self.position[:2, rigs], self.velocity[:2, rigs] = q[:2], v[:2]
        error[:2, rigs] = errors
        self.substeps[rigs] += steps - 1
        self._refined = True
        for rig, joint, is_upper, speed in impacts:
            self._events.append(PlantEvent(PlantEventKind.LIMIT_HIT, rig, joint + 1, is_upper, speed))

    def _leaves_surface(self) -> bool:
        """Return whether a tool that rested on an object is above a lower one after the integration step."""
        np.greater(self._upper[2], self._surface, self._leaving)
        self._leaving &= (self._start_position[2] >= self._surface) & (self._start_velocity[2] == 0)
        return any_true(self._leaving)

    def _edge_fraction(self, rigs: Ints) -> Floats:
        """Return the fraction of the integration step after which tools leave the object that they rested on, (K,)."""
        world, dynamics, length = self.world, self.dynamics, self._lengths[rigs]
        start, end = self._start_position[:, rigs], self.position[:, rigs]
        rates = length * self._start_velocity[:, rigs], length * self.velocity[:, rigs]
        held = world.held_height[rigs]
        bottom = self._l1[rigs] - start[2] - held
        low, high = np.zeros(rigs.size), np.ones(rigs.size)
        for _ in range(EDGE_BISECTIONS):
            middle = (low + high) / 2
            theta1, theta2, _, theta4 = hermite(start, end, *rates, middle)
            sum12 = theta1 + theta2
            x = dynamics.l2[rigs] * np.cos(theta1) + dynamics.l3[rigs] * np.cos(sum12)
            y = dynamics.l2[rigs] * np.sin(theta1) + dynamics.l3[rigs] * np.sin(sum12)
            x, y = world.footprint_center(rigs, np.stack([x, y, start[2], sum12 + theta4]))
            rests = self._l1[rigs] - held - world.contact(rigs, x, y, bottom) <= self._surface[rigs]
            low, high = np.where(rests, middle, low), np.where(rests, high, middle)
        return low

    def _resolve_linear(self, joint: Ints, rig: Ints, length: Floats, error: Floats, effort: Floats) -> None:
        """Move joints 3 and 4, `joint` 0 and 1, of rigs by their closed form for the last `length` of the step, s."""
        row = joint + 2
        motion = move_between_stops(*self._linear_arguments(joint, rig, effort), length)
        self.position[row, rig], self.velocity[row, rig] = motion.position, motion.velocity
        error[row, rig] = 0.0
        self._events += self._linear_hits(joint, rig, motion.side, motion.speed)

    def _linear_arguments(
        self, joint: Ints, rig: Ints, effort: Floats
    ) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
        """Return q, v, acceleration, rate, lower and upper stops of joints at the start of the step, (K,) each."""
        row = joint + 2
        start, start_velocity = self._start_position[row, rig], self._start_velocity[row, rig]
        acceleration, rate = self.dynamics.linear_coefficients(joint, rig, effort)
        return start, start_velocity, acceleration, rate, self._lower[row, rig], self._upper[row, rig]

    def _linear_hits(self, joint: Ints, rig: Ints, side: Floats, speed: Floats) -> list[PlantEvent]:
        """Return the impacts of joints 3 and 4; `side`: +1 at the upper stop, -1 at the lower stop, 0: no impact."""
        hits = []
        for index in np.flatnonzero(side != 0).tolist():
            number, is_upper = int(rig[index]), bool(side[index] > 0)
            below = is_upper and joint[index] == 0 and self._upper[2, number] < self._stop[2, number]
            hit = 0 if below else int(joint[index]) + 3
            hits.append(PlantEvent(PlantEventKind.LIMIT_HIT, number, hit, is_upper, float(speed[index])))
        return hits

    def _hold_pressed(self, effort: Floats) -> bool:
        """Hold joints 1 and 2 that are pressed against a stop at the start of a step; return whether any is."""
        rates = self._integrator.accelerations(self.position, self.velocity, effort)
        # Only a joint at rest at a stop is held; a joint that moves off the stop is free.
        side = np.where(self.velocity[:2] == 0, _sides(self.position, self._lower, self._stop), 0.0)
        if not any_true(side * rates[:2] > 0):
            return False
        theta2 = self.position[1]
        _, _, held1, held2 = stop_outward(rates[0], rates[1], side[0], side[1], self.dynamics.mass_matrix_12(theta2))
        self._held = held1, held2
        self.dynamics.hold(held1, held2, theta2)
        return True

    def _find_contact(self) -> None:
        """Limit the quill's upper stop by the object below the tool, where the tool may reach it."""
        world, pose = self.world, self._contact_pose
        # The surface below is known if neither the tool nor the scene has changed since it was computed.
        pose[:] = self.position
        pose[2] = self._start_position[2]
        np.not_equal(pose, self._contact_known, self._contact_differs)
        np.logical_and(self._contact_differs, self._low, self._contact_differs)
        if not any_true(self._contact_differs):
            return
        np.logical_or.reduce(self._contact_differs, axis=0, out=self._contact_unknown)
        # A slice for all rigs: with few rigs, the copy of selected columns costs more than the computation.
        rigs = np.flatnonzero(self._contact_unknown) if _FALSE in self._contact_unknown.tobytes() else ALL_RIGS
        self._contact_known[:, rigs] = pose[:, rigs]
        tip = self.tool(rigs)
        bottom = self._l1[rigs] - self._start_position[2, rigs] - world.held_height[rigs]
        x, y = world.footprint_center(rigs, tip)
        below = world.contact(rigs, x, y, bottom)
        self._upper[2, rigs] = np.minimum(self._stop[2, rigs], self._l1[rigs] - world.held_height[rigs] - below)

    def _impact(self, effort: Floats) -> None:
        """Stop joints 1 and 2 at their limits, at the time of the impact."""
        position, velocity = self.position, self.velocity
        beyond = (position[:2] < self._lower[:2]) | (position[:2] > self._stop[:2])
        if any_true(beyond):
            step = float(self._lengths[0])
            rigs = np.flatnonzero(beyond.any(axis=0))
            limit = np.where(position[:2] > self._stop[:2], self._stop[:2], self._lower[:2])[:, rigs]
            q0, v0 = self._start_position[:, rigs], self._start_velocity[:, rigs]
            q1, v1 = position[:, rigs], velocity[:, rigs]
            outside = beyond[:, rigs]
            fractions = np.ones((2, rigs.size))
            for joint in (0, 1):
                fraction = crossing(q0[joint], q1[joint], v0[joint] * step, v1[joint] * step, limit[joint])
                fractions[joint] = np.where(outside[joint], fraction, 1.0)
            first = fractions.min(axis=0)
            arms = [self._arms[rig] for rig in rigs]
            dynamics = ReducedDynamics(arms)
            dynamics.set_payload(self.dynamics.payload[rigs])
            dynamics.hold(self._held[0][rigs], self._held[1][rigs], q0[1])
            acting = effort[:, rigs]
            plane, plane_rate = q0.copy(), v0.copy()
            FixedStep(dynamics, self._tableau, first * step).advance(plane, plane_rate, acting)
            hitting = outside & (fractions == first)
            np.copyto(plane[:2], limit, where=hitting)
            side = _sides(plane, self._lower[:, rigs], self._stop[:, rigs])
            for joint, column in np.argwhere(hitting & (side * plane_rate[:2] > 0)).tolist():
                rig, rate = int(rigs[column]), float(plane_rate[joint, column])
                self._left.append(PlantEvent(PlantEventKind.LIMIT_HIT, rig, joint + 1, rate > 0, abs(rate)))
            self._stop_plane(dynamics, plane, plane_rate, side)
            # The remainder of the step starts at the stop, pressed against it or leaving it.
            rest = FixedStep(dynamics, self._tableau, (1.0 - first) * step)
            rates = rest.accelerations(plane, plane_rate, acting)
            mass = dynamics.mass_matrix_12(plane[1])
            resting = np.where(plane_rate[:2] == 0, side, 0.0)
            _, _, held1, held2 = stop_outward(rates[0], rates[1], resting[0], resting[1], mass)
            dynamics.hold(held1, held2, plane[1])
            rest.advance(plane, plane_rate, acting)
            # Joints 3 and 4 have already made the whole step.
            position[:2, rigs], velocity[:2, rigs] = plane[:2], plane_rate[:2]
            np.maximum(position[:2], self._lower[:2], out=position[:2])
            np.minimum(position[:2], self._stop[:2], out=position[:2])
        # A joint at a stop at the end, by a second impact in the step or since before, must not move outward.
        self._stop_plane(self.dynamics, position, velocity, _sides(position, self._lower, self._stop))

    @staticmethod
    def _stop_plane(dynamics: ReducedDynamics, position: Floats, velocity: Floats, side: Floats) -> None:
        if any_true(side * velocity[:2] > 0):
            mass = dynamics.mass_matrix_12(position[1])
            velocity[0], velocity[1], _, _ = stop_outward(velocity[0], velocity[1], side[0], side[1], mass)

    def _refresh_derived_state(self) -> None:
        """Recompute everything that depends on position, velocity and parts."""
        self.dynamics.set_payload(self.world.payload())
        self._invalidate_contact()
        np.greater(self.position[2], self._free3, self._low)
        if any_true(self._low):
            self._start_position[:] = self.position
            self._find_contact()
        self._update_limits()

    def _invalidate_contact(self) -> None:
        """Invalidate the computed surfaces below the tools, because the scene has changed."""
        self._contact_known.fill(np.nan)
        self._upper[2] = self._stop[2]
        np.subtract(self._l1, self.world.held_height, out=self._free3)
        np.subtract(self._free3, self.world.highest, out=self._free3)
        np.subtract(self._free3, CONTACT_TOLERANCE_M, out=self._free3)


def _sides(position: Floats, lower: Floats, upper: Floats) -> Floats:
    """Return +1 where joints 1 and 2 are at their upper stops, -1 at their lower stops, else 0, (2, N)."""
    return (position[:2] >= upper[:2]).astype(np.float64) - (position[:2] <= lower[:2])
