"""The simulation of a lab's rigs, tick by tick: command in, state out, then the plant moves on.

The order within a tick is the contract of docs/timing.md. The newest commands are latched, the tick is stamped, the
state x_k is published with the effort that acts from now on, and only then is x_k+1 computed: a state leaves at the
start of its step.
"""

from collections.abc import Mapping
from math import isfinite
from typing import Final

import numpy as np

from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.rate import Tick
from hilrig_schemas import JointState, RigReport, topics
from hilrig_sim.arm.model import RigParameters
from hilrig_sim.commands import StepTimes
from hilrig_sim.events import SimulationEvents
from hilrig_sim.plant.plant import Plant
from hilrig_sim.state_encoder import RigState, loop_bytes, motion_bytes

PRE_ENCODE_MIN_RIGS: Final = 16
"""Rigs from which on states are encoded before the tick. With 128 rigs it raises the share of loops that close within
one step from 92 to 98 %; with fewer than 16 no figure changes (`bench/ablation.py`)."""
PRE_ENCODE_LEAD: Final = 4
"""Part of a step before the tick at which pre-encoding starts, as a divisor: a quarter."""


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
        self._times = StepTimes()
        self._step = 0
        self._effort = np.zeros((4, len(parameters)))
        self._magnet = np.zeros(len(parameters), dtype=np.bool_)
        self._events = SimulationEvents(service.emit, [rig.name for rig in service.rigs], self._plant)
        self._rigs = [
            self._rig_state(index, rig.name, values, self._plant)
            for index, (rig, values) in enumerate(zip(service.rigs, parameters, strict=True))
        ]
        self._states = service.batch_sender(topics.STATES)
        for rig in self._rigs:
            service.add_to_batch(self._states, topics.STATE, rig.name)
        self._see()
        service.health.rig_reports = self._rig_reports

    def pre_encode(self, tick_ns: int) -> None:
        """Latch commands and encode the states a quarter of a step before the tick at `tick_ns`, ns, monotonic clock.

        Encoding the states of many rigs at the tick would delay their transmission. A command that arrives later is
        latched at the tick, and its rig's state is encoded again. With few rigs nothing is done.
        """
        if len(self._rigs) < PRE_ENCODE_MIN_RIGS:
            return
        self._clock.sleep_until_ns(tick_ns - self._step_ns // PRE_ENCODE_LEAD)
        for rig in self._rigs:
            if self._clock.monotonic_ns() >= tick_ns:
                return
            rig.follow(self._commands.get(rig.name), tick_ns)
            # The pose after a reset is known at the tick only.
            if not rig.follower.reset:
                rig.encode(self._times, tick_ns)

    def tick(self, tick: Tick) -> None:
        """Latch, stamp, publish, integrate."""
        self._step = step = self._step + 1
        newest, rigs, plant, times = self._commands.get, self._rigs, self._plant, self._times
        arrivals = [newest(rig.name) for rig in rigs]
        # Stamped after they were taken: no command arrives later than the tick that applies it.
        sampled_ns, wall_ns = self._clock.monotonic_ns(), self._clock.wall_ns()
        times.add(step, sampled_ns)
        # What was prepared for a tick that was held up is looked at again: a command may have become too old.
        overrun = tick.missed_steps > 0 or tick.lateness_ns > self._step_ns
        for rig, arrival in zip(rigs, arrivals, strict=True):
            if arrival is not rig.arrival or not rig.encoded or overrun:
                rig.follow(arrival, sampled_ns)
                if rig.follower.reset:
                    plant.reset(rig.index)
                    rig.begin(motion_bytes(plant)[rig.index], plant.limit_flags[rig.index])
                rig.encode(times, sampled_ns)
        # Of all rigs alike: encoded once, it joins each state's other bytes.
        of_all = JointState(
            step=step,
            sampled_ns=sampled_ns,
            wall_ns=wall_ns,
            lateness_ns=sampled_ns - tick.deadline_ns,
            missed_steps=tick.missed_steps,
        ).SerializeToString()
        # Most loops answer to the same state.
        latencies_ns = {basis: sampled_ns - (times.get(basis) or sampled_ns) for basis in {r.basis_step for r in rigs}}
        ends = {basis: loop_bytes(latency_ns) for basis, latency_ns in latencies_ns.items()}
        self._states.send([of_all + rig.encoded + ends[rig.basis_step] for rig in rigs])
        self._after_sending(latencies_ns)
        events = plant.step(self._effort, self._magnet)
        if events:
            self._events.report_plant_events(events, step + 1, sampled_ns, [rig.follower.session for rig in rigs])
        if not isfinite(plant.velocity.sum()):
            self._catch(step + 1)
        self._see()
        self._counters.count_tick(tick, self._step_ns)
        if overrun:
            self._events.record_overrun(tick, step, self._step_ns)
        if self._events.overran:
            self._events.report_overruns(sampled_ns)

    def _after_sending(self, latencies_ns: Mapping[int, int]) -> None:
        """Hand the efforts to the plant, and tell of commands that were lost."""
        changed = []
        for rig in self._rigs:
            follower = rig.follower
            rig.sent(latencies_ns[rig.basis_step])
            if follower.changed:
                changed.append((rig.index, follower.effort, follower.magnet))
            if follower.lost or follower.back or follower.reset:
                self._events.report_command_changes(rig.index, follower, self._step)
        if changed:
            indices, efforts, magnets = zip(*changed, strict=True)
            self._effort[:, indices] = np.array(efforts).T
            self._magnet[[*indices]] = magnets

    @property
    def parameters(self) -> tuple[RigParameters, ...]:
        """Of every rig, in their order."""
        return self._plant.rigs

    def add(self, name: str, plant: Plant) -> None:
        """Simulate one more rig, the last one of `plant`; the others of it are those that are simulated now."""
        count = len(self._rigs)
        plant.copy_state_from(self._plant, range(count), range(count))
        self._rigs.append(self._rig_state(count, name, plant.rigs[count], plant))
        self._effort = np.hstack([self._effort, np.zeros((4, 1))])
        self._magnet = np.append(self._magnet, False)
        self._service.add_to_batch(self._states, topics.STATE, name)
        self._regroup(plant)

    def remove(self, index: int, plant: Plant) -> None:
        """Simulate a rig no more; `plant` has all the others."""
        kept = [number for number in range(len(self._rigs)) if number != index]
        plant.copy_state_from(self._plant, range(len(kept)), kept)
        del self._rigs[index]
        self._effort, self._magnet = self._effort[:, kept].copy(), self._magnet[kept]
        self._states.remove(index)
        self._regroup(plant)

    def _rig_state(self, index: int, name: str, parameters: RigParameters, plant: Plant) -> RigState:
        timeout_ns = self._service.lab.sim.command_timeout_ns
        return RigState(index, name, parameters, self._service.incarnation, timeout_ns, plant)

    def _see(self) -> None:
        """Give the states what the next step begins with: known long before its tick, which has less to do so."""
        plant = self._plant
        for rig, motion, flags in zip(self._rigs, motion_bytes(plant), plant.limit_flags, strict=True):
            rig.begin(motion, flags)

    def _regroup(self, plant: Plant) -> None:
        self._plant = plant
        for index, rig in enumerate(self._rigs):
            rig.move_to(index, plant)
        self._events.set_rigs([rig.name for rig in self._rigs], plant)
        self._see()

    def _rig_reports(self) -> list[RigReport]:
        return [rig.report() for rig in self._rigs]

    def _catch(self, step: int) -> None:
        """Bring rigs back whose motion the step could not follow: better at the start than nowhere for ever."""
        for rig in self._rigs:
            if not np.isfinite(self._plant.velocity[:, rig.index]).all():
                self._plant.reset(rig.index)
                self._events.report_divergence(rig.index, rig.follower.session, step)

    def _warm_up(self) -> None:
        """Take the first steps, which are slow, before time counts."""
        effort, magnet = np.zeros((4, self._plant.count)), np.zeros(self._plant.count, dtype=np.bool_)
        for _ in range(3):
            self._plant.step(effort, magnet)
        for rig in range(self._plant.count):
            self._plant.reset(rig)
