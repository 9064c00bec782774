"""The simulation as a service: at each absolute deadline, command in, state out, then the plant moves on.

The order within a tick is the contract of docs/timing.md. The newest commands are latched, the tick is stamped, the
state x_k is published with the effort that acts from now on, and only then is x_k+1 computed: a state leaves at the
start of its step.
"""

from collections.abc import Sequence
from math import isfinite
from typing import Final

import numpy as np

from hilrig_runtime.rate import Rate, Tick
from hilrig_runtime.realtime import freeze_garbage
from hilrig_runtime.service import Service
from hilrig_runtime.turns import Turns
from hilrig_schemas import JointState, PartState, RigReport, topics
from hilrig_sim.commands import CommandFollower, StepTimes
from hilrig_sim.configured import rig_parameters
from hilrig_sim.membership import Membership
from hilrig_sim.model import RigParameters
from hilrig_sim.plant import Plant
from hilrig_sim.reports import Reporter
from hilrig_sim.world import NONE

MANY: Final = 16
"""Rigs from which on it pays to wake up before the tick."""
AHEAD: Final = 8
"""What part of a step before it."""
ALL_PARTS_PERIOD_NS: Final = 1_000_000_000
"""All parts are stated at least so often, ns."""


def run(service: Service) -> None:
    """Simulate every rig of the lab until the service is to stop.

    Raises:
        InputError: the lab's parameters do not fit together.
    """
    lab = service.lab
    parameters = [rig_parameters(lab, rig) for rig in service.rigs]
    simulation = Simulation(service, parameters)
    step_ns = lab.sim.step_ns
    turns = Turns()
    with Membership(service, simulation, turns):
        rate = Rate(step_ns, service.clock)
        freeze_garbage()
        service.ready()
        stopping = service.stopping
        # What can't be computed is dealt with where it shows, not warned of.
        with np.errstate(all="ignore"):
            while not stopping.is_set():
                simulation.look_ahead(rate.next_ns)
                tick = rate.wait()
                simulation.tick(tick)
                turns.run_waiting()
                service.beat(service.clock.monotonic_ns())


class Simulation:
    """The rigs of one process: plant, commands and states."""

    def __init__(self, service: Service, parameters: list[RigParameters]) -> None:
        lab = service.lab
        self._service = service
        self._plant = Plant(parameters)
        self._warm_up()
        tls = lab.bus.tls
        self._commands = service.latest_of_batches(topics.COMMANDS, {} if tls is None else tls.edges)
        self._step_ns = lab.sim.step_ns
        self._clock = service.clock
        self._counters = service.counters
        self._incarnation = service.incarnation
        self._times = StepTimes()
        self._step = 0
        self._effort = np.zeros((4, len(parameters)))
        self._magnet = np.zeros(len(parameters), dtype=np.bool_)
        self._reporter = Reporter(service.emit, [rig.name for rig in service.rigs], self._plant)
        self._rigs = [
            _Rig(index, rig.name, values, service, self._plant)
            for index, (rig, values) in enumerate(zip(service.rigs, parameters, strict=True))
        ]
        self._states = service.batch_sender(topics.STATES)
        for rig in self._rigs:
            service.add_to_batch(self._states, topics.STATE, rig.name)
        self._see(self._rigs)
        service.health.rig_reports = self._rig_reports

    def look_ahead(self, tick_ns: int) -> None:
        """Wait until shortly before the tick at `tick_ns`, then decode the commands that are there: of many rigs it
        would keep the first state from leaving."""
        if len(self._rigs) < MANY:
            return
        self._clock.sleep_until_ns(tick_ns - self._step_ns // AHEAD)
        newest, rigs, latest_ns = self._commands.get, self._rigs, tick_ns - self._step_ns // (4 * AHEAD)
        for first in range(0, len(rigs), MANY):
            if self._clock.monotonic_ns() > latest_ns:
                # The others are decoded at the tick, which must not be late.
                return
            for rig in rigs[first : first + MANY]:
                rig.follower.expect(newest(rig.name))

    def tick(self, tick: Tick) -> None:
        """Latch, stamp, publish, integrate."""
        self._step = step = self._step + 1
        newest, rigs, plant = self._commands.get, self._rigs, self._plant
        arrivals = [newest(rig.name) for rig in rigs]
        # Stamped after they were taken: no command arrives later than the tick that applies it.
        sampled_ns, wall_ns = self._clock.monotonic_ns(), self._clock.wall_ns()
        self._times.add(step, sampled_ns)
        for rig, arrival in zip(rigs, arrivals, strict=True):
            follower = rig.follower
            follower.latch(arrival, sampled_ns)
            if follower.changed:
                self._effort[:, rig.index] = follower.effort
                self._magnet[rig.index] = follower.magnet
            if follower.reset:
                plant.reset(rig.index)
                self._see([rig])
        # Of all rigs alike: encoded once, it joins each state's other bytes.
        of_all = JointState(
            step=step,
            sampled_ns=sampled_ns,
            wall_ns=wall_ns,
            lateness_ns=sampled_ns - tick.deadline_ns,
            missed_steps=tick.missed_steps,
        ).SerializeToString()
        times = self._times
        self._states.send([of_all + rig.encoded(times, sampled_ns) for rig in rigs])
        for rig in rigs:
            if rig.follower.lost or rig.follower.back or rig.follower.reset:
                self._reporter.tell_of_commands(rig.index, rig.follower, step)
        events = plant.step(self._effort, self._magnet)
        if events:
            self._reporter.tell_of_plant(events, step + 1, sampled_ns, [rig.follower.session for rig in rigs])
        if not isfinite(plant.velocity.sum()):
            self._catch(step + 1)
        self._see(rigs)
        self._counters.count_tick(tick, self._step_ns)
        if tick.missed_steps or tick.lateness_ns > self._step_ns:
            self._reporter.tell_of_overrun(tick, step, sampled_ns)

    @property
    def parameters(self) -> tuple[RigParameters, ...]:
        """Of every rig, in their order."""
        return self._plant.rigs

    def add(self, name: str, plant: Plant) -> None:
        """Simulate one more rig, the last one of `plant`; the others of it are those that are simulated now."""
        count = len(self._rigs)
        plant.adopt(self._plant, range(count), range(count))
        self._rigs.append(_Rig(count, name, plant.rigs[count], self._service, plant))
        self._effort = np.hstack([self._effort, np.zeros((4, 1))])
        self._magnet = np.append(self._magnet, False)
        self._service.add_to_batch(self._states, topics.STATE, name)
        self._regroup(plant)

    def remove(self, index: int, plant: Plant) -> None:
        """Simulate a rig no more; `plant` has all the others."""
        kept = [number for number in range(len(self._rigs)) if number != index]
        plant.adopt(self._plant, range(len(kept)), kept)
        del self._rigs[index]
        self._effort, self._magnet = self._effort[:, kept].copy(), self._magnet[kept]
        self._states.remove(index)
        self._regroup(plant)

    def _see(self, rigs: "Sequence[_Rig]") -> None:
        """Write into the states what the next step begins with: known long before its tick, which has less to do so."""
        plant = self._plant
        positions, velocities, errors = (each.T.tolist() for each in (plant.position, plant.velocity, plant.error))
        limit_flags = plant.limit_flags
        for rig in rigs:
            state, index = rig.state, rig.index
            state.position[:] = positions[index]
            state.velocity[:] = velocities[index]
            state.integration_error[:] = errors[index]
            state.limit_flags = limit_flags[index]

    def _regroup(self, plant: Plant) -> None:
        self._plant = plant
        for index, rig in enumerate(self._rigs):
            rig.move_to(index, plant)
        self._reporter.regroup([rig.name for rig in self._rigs], plant)
        self._see(self._rigs)

    def _rig_reports(self) -> list[RigReport]:
        return [rig.report() for rig in self._rigs]

    def _catch(self, step: int) -> None:
        """Bring rigs back whose motion the step could not follow: better at the start than nowhere for ever."""
        for rig in self._rigs:
            if not np.isfinite(self._plant.velocity[:, rig.index]).all():
                self._plant.reset(rig.index)
                self._reporter.tell_of_escape(rig.index, rig.follower.session, step)

    def _warm_up(self) -> None:
        """Take the first steps, which are slow, before time counts."""
        effort, magnet = np.zeros((4, self._plant.count)), np.zeros(self._plant.count, dtype=np.bool_)
        for _ in range(3):
            self._plant.step(effort, magnet)
        for rig in range(self._plant.count):
            self._plant.reset(rig)


class _Rig:
    """What one rig sends: a message that is filled anew each step."""

    def __init__(self, index: int, name: str, parameters: RigParameters, service: Service, plant: Plant) -> None:
        self.name = name
        self.follower = CommandFollower(service.incarnation, service.lab.sim.command_timeout_ns)
        self.state = JointState(
            rig=name,
            incarnation=service.incarnation,
            effort=self.follower.effort,
            external_force_z=parameters.arm.external_force_z,
            external_torque_z=parameters.arm.external_torque_z,
            safe=True,
        )
        self._effort = self.state.effort
        self._said = ("", False, True)
        """Session, magnet and whether it is safe, as they stand in the state."""
        self.move_to(index, plant)
        self._loops_us: list[int] = []
        self._has_commanded = False
        self._parts_due_ns = 0

    def move_to(self, index: int, plant: Plant) -> None:
        """Be the rig `index` of a plant."""
        self.index = index
        self._world = plant.world
        self._part_names = plant.world.part_names[index]

    def encoded(self, times: StepTimes, sampled_ns: int) -> bytes:
        """Complete the state with what seldom changes, and encode it."""
        state, follower, world, index = self.state, self.follower, self._world, self.index
        if follower.changed:
            said = (follower.session, follower.magnet, follower.safe)
            if said != self._said:
                # A string that is set anew takes memory until the message is gone, also where it is the same.
                if follower.session != self._said[0]:
                    state.session = follower.session
                state.magnet, state.safe = follower.magnet, follower.safe
                self._said = said
            self._effort[:] = follower.effort
            state.command_seq = follower.seq
        if follower.is_new:
            basis_ns = times.get(follower.basis_step)
            state.command_arrived_ns = follower.arrived_ns
            state.basis_step = follower.basis_step if basis_ns is not None else 0
            state.loop_latency_ns = sampled_ns - basis_ns if basis_ns is not None else 0
            if basis_ns is not None:
                self._loops_us.append((sampled_ns - basis_ns) // 1000)
            self._has_commanded = True
        elif self._has_commanded:
            state.command_arrived_ns = state.basis_step = state.loop_latency_ns = 0
            self._has_commanded = False
        if self._part_names and (world.moving[index] or sampled_ns >= self._parts_due_ns):
            self._parts_due_ns = sampled_ns + ALL_PARTS_PERIOD_NS
            parts = self._encoded_parts()
            return state.SerializeToString() + parts
        return state.SerializeToString()

    def report(self) -> RigReport:
        """What is to be known of the rig since the last report."""
        loops_us, self._loops_us = self._loops_us, []
        return RigReport(rig=self.name, loop_us=loops_us, safe=self.follower.safe)

    def _encoded_parts(self) -> bytes:
        """The parts, encoded so that they join the state's other bytes; what the magnet holds goes into the state.

        A message that is used again keeps the memory of every part that was ever added to it; this one is not.
        """
        world, index = self._world, self.index
        poses = zip(
            self._part_names,
            world.x[:, index].tolist(),
            world.y[:, index].tolist(),
            world.z[:, index].tolist(),
            world.yaw[:, index].tolist(),
            strict=False,
        )
        parts = [PartState(name=name, x=x, y=y, z=z, yaw=yaw) for name, x, y, z, yaw in poses]
        held = int(world.held[index])
        held_part = self._part_names[held] if held != NONE else ""
        if self.state.held_part != held_part:
            self.state.held_part = held_part
        return JointState(parts=parts).SerializeToString()
