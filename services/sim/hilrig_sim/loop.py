"""Simulation loop of a lab's rigs: latch commands, publish states, step the plant.

The order within a tick is specified in docs/timing.md. The newest commands are latched, the tick is timestamped, the
state x_k is published with the effort that is applied from now on, and then x_k+1 is computed. So a state is published
at the start of its step.
"""

from math import isfinite
from typing import Final

import numpy as np

from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.rate import Tick
from hilrig_schemas import JointState, RigReport, topics
from hilrig_sim.arm.model import RigParameters
from hilrig_sim.arm.stability import ERROR_BOUND
from hilrig_sim.commands import CommandLatch, StepTimes
from hilrig_sim.events import SimulationEvents
from hilrig_sim.plant.plant import Plant
from hilrig_sim.state_encoder import RigStateEncoder, encode_loop_latency, encode_motion

PRE_ENCODE_MIN_RIGS: Final = 16
"""Number of rigs from which on states are encoded before the tick. With 128 rigs, this raises the fraction of loops
within one step from 92 to 98 %; below 16 rigs it has no measurable effect (`bench/ablation.py`)."""
PRE_ENCODE_STEP_DIVISOR: Final = 4
"""Pre-encoding starts a step divided by this number before the tick."""


class Simulation:
    """Simulation of the rigs of one process: plant, commands and states."""

    def __init__(self, service: Service, parameters: list[RigParameters]) -> None:
        lab = service.lab
        self._service = service
        self._plant = Plant(parameters)
        self._warm_up()
        tls = lab.bus.tls
        self._commands = service.latest_value_cache(topics.COMMANDS, {} if tls is None else tls.edges)
        self._step_ns = lab.sim.step_ns
        self._clock = service.clock
        self._counters = service.counters
        self._times = StepTimes()
        self._step = 0
        self._effort = np.zeros((4, len(parameters)))
        self._magnet = np.zeros(len(parameters), dtype=np.bool_)
        self._events = SimulationEvents(service.emit, [rig.name for rig in service.rigs], self._plant)
        self._rigs = [
            self._new_encoder(index, rig.name, values, self._plant)
            for index, (rig, values) in enumerate(zip(service.rigs, parameters, strict=True))
        ]
        self._latches = [self._new_latch() for _ in self._rigs]
        self._states = service.batch_publisher(topics.STATES)
        for rig in self._rigs:
            service.add_to_batch(self._states, topics.STATE, rig.name)
        self._update_motion()
        service.health.rig_reports = self._rig_reports

    def pre_encode(self, tick_ns: int) -> None:
        """Latch commands and encode the states a quarter of a step before the tick at `tick_ns`, ns, monotonic clock.

        Encoding the states of many rigs at the tick would delay their transmission. A command that arrives later is
        latched at the tick, and the state of its rig is encoded again. With few rigs this does nothing.
        """
        if len(self._rigs) < PRE_ENCODE_MIN_RIGS:
            return
        self._clock.sleep_until_ns(tick_ns - self._step_ns // PRE_ENCODE_STEP_DIVISOR)
        for rig, latch in zip(self._rigs, self._latches, strict=True):
            if self._clock.monotonic_ns() >= tick_ns:
                return
            latch.latch(self._commands.get(rig.name), tick_ns)
            # The pose after a reset is known at the tick only.
            if not latch.reset:
                rig.encode(latch, self._times, tick_ns)

    def tick(self, tick: Tick) -> None:
        """Latch the commands, take the timestamps, publish the states, step the plant."""
        self._step = step = self._step + 1
        rigs, latches, plant, times = self._rigs, self._latches, self._plant, self._times
        commands = [self._commands.get(rig.name) for rig in rigs]
        # Sampled after the commands were fetched: no command arrives after the tick that applies it.
        sampled_ns, wall_ns = self._clock.monotonic_ns(), self._clock.wall_ns()
        times.add(step, sampled_ns)
        # After a late tick, states are encoded again: a command may have timed out.
        overrun = tick.missed_steps > 0 or tick.lateness_ns > self._step_ns
        for rig, latch, command in zip(rigs, latches, commands, strict=True):
            if command is not latch.received or not rig.encoded or overrun:
                latch.latch(command, sampled_ns)
                if latch.reset:
                    plant.reset(rig.index)
                    rig.set_motion(encode_motion(plant)[rig.index], plant.limit_flags[rig.index])
                rig.encode(latch, times, sampled_ns)
        # The same for all rigs: encoded once, and prepended to each state.
        common = JointState(
            step=step,
            sampled_ns=sampled_ns,
            wall_ns=wall_ns,
            lateness_ns=sampled_ns - tick.deadline_ns,
            missed_steps=tick.missed_steps,
            run_delay_ns=self._service.health.take_run_delay() if overrun else 0,
        ).SerializeToString()
        # Most new commands are based on the same state.
        latencies_ns = {basis: sampled_ns - (times.get(basis) or sampled_ns) for basis in {r.basis_step for r in rigs}}
        ends = {basis: encode_loop_latency(latency_ns) for basis, latency_ns in latencies_ns.items()}
        self._states.publish([common + rig.encoded + ends[rig.basis_step] for rig in rigs])
        for rig, latch in zip(rigs, latches, strict=True):
            rig.on_published(step, latencies_ns[rig.basis_step], latch.changed)
        self._apply_commands()
        events = plant.step(self._effort, self._magnet)
        if events:
            self._events.report_plant_events(events, step + 1, sampled_ns, [latch.session for latch in latches])
        if not isfinite(plant.velocity.sum()):
            self._reset_diverged(step + 1)
        if plant.is_inaccurate():
            self._report_inaccurate(step + 1, sampled_ns)
        self._update_motion()
        self._counters.count_tick(tick, self._step_ns)
        if overrun:
            sessions = [latch.session for latch in latches]
            self._events.record_overrun(tick, step, self._step_ns, sampled_ns, sessions)
        elif self._events.overran:
            self._events.report_overruns(sampled_ns)

    def _apply_commands(self) -> None:
        """Set the efforts and magnets that latched commands changed, and emit the events of the commands."""
        changed = []
        for index, latch in enumerate(self._latches):
            if latch.changed:
                changed.append((index, latch.effort, latch.magnet))
            if latch.command_lost or latch.command_resumed or latch.reset:
                self._events.report_command_changes(index, latch, self._step)
            latch.start_step()
        if changed:
            indices, efforts, magnets = zip(*changed, strict=True)
            self._effort[:, indices] = np.array(efforts).T
            self._magnet[[*indices]] = magnets

    @property
    def parameters(self) -> tuple[RigParameters, ...]:
        """Parameters of every rig, in their order."""
        return self._plant.rigs

    def add(self, name: str, plant: Plant) -> None:
        """Add a rig, the last one of `plant`; its other rigs are the current ones."""
        count = len(self._rigs)
        plant.copy_state_from(self._plant, range(count), range(count))
        self._rigs.append(self._new_encoder(count, name, plant.rigs[count], plant))
        self._latches.append(self._new_latch())
        self._effort = np.hstack([self._effort, np.zeros((4, 1))])
        self._magnet = np.append(self._magnet, False)
        self._service.add_to_batch(self._states, topics.STATE, name)
        self._set_plant(plant)

    def remove(self, index: int, plant: Plant) -> None:
        """Remove a rig; `plant` has all the others."""
        kept = [number for number in range(len(self._rigs)) if number != index]
        plant.copy_state_from(self._plant, range(len(kept)), kept)
        del self._rigs[index], self._latches[index]
        self._effort, self._magnet = self._effort[:, kept].copy(), self._magnet[kept]
        self._states.remove(index)
        self._set_plant(plant)

    def _new_encoder(self, index: int, name: str, parameters: RigParameters, plant: Plant) -> RigStateEncoder:
        return RigStateEncoder(index, name, parameters, self._service.incarnation, plant)

    def _new_latch(self) -> CommandLatch:
        return CommandLatch(
            self._service.incarnation, self._service.lab.sim.command_timeout_ns, counters=self._counters
        )

    def _update_motion(self) -> None:
        """Encode the motion at the start of the next step now, so that its tick has less work."""
        plant = self._plant
        for rig, motion, flags in zip(self._rigs, encode_motion(plant), plant.limit_flags, strict=True):
            rig.set_motion(motion, flags)

    def _set_plant(self, plant: Plant) -> None:
        self._plant = plant
        for index, rig in enumerate(self._rigs):
            rig.set_index(index, plant)
        self._events.set_rigs([rig.name for rig in self._rigs], plant)
        self._update_motion()

    def _rig_reports(self) -> list[RigReport]:
        return [rig.report(latch.safe, self._times) for rig, latch in zip(self._rigs, self._latches, strict=True)]

    def _reset_diverged(self, step: int) -> None:
        """Reset the rigs whose state is not finite any more, because the motion was too fast for the step."""
        for index, latch in enumerate(self._latches):
            if not np.isfinite(self._plant.velocity[:, index]).all():
                self._plant.reset(index)
                self._events.report_divergence(index, latch.session, step)

    def _report_inaccurate(self, step: int, now_ns: int) -> None:
        """Count and report the rigs whose error estimate of the last step exceeds its bound."""
        error = np.abs(self._plant.error)
        for index in np.flatnonzero((error > np.array(ERROR_BOUND)[:, np.newaxis]).any(axis=0)).tolist():
            self._counters.inaccurate_steps += 1
            session = self._latches[index].session
            self._events.report_inaccurate(index, error[:, index], session, step, now_ns)

    def _warm_up(self) -> None:
        """Compute a few steps in advance, because the first ones are slow, and reset the rigs."""
        effort, magnet = np.zeros((4, self._plant.count)), np.zeros(self._plant.count, dtype=np.bool_)
        for _ in range(3):
            self._plant.step(effort, magnet)
        for rig in range(self._plant.count):
            self._plant.reset(rig)
