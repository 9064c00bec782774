"""Events of the simulation: joint limits, parts, lost commands, resets, accuracy, divergence and overruns."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.process.outage import STALL_NS
from hilrig_runtime.timing.rate import Tick
from hilrig_runtime.timing.rate_limiter import RateLimiter, repeat_suffix
from hilrig_schemas import Event
from hilrig_schemas.v1.event_pb2 import IntegrationData, LimitData, OverrunData, PartData, WatchdogData
from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_sim.arm.stability import ERROR_BOUND
from hilrig_sim.commands import CommandLatch
from hilrig_sim.plant.limits import PlantEvent, PlantEventKind
from hilrig_sim.plant.plant import Plant

Floats = NDArray[np.float64]

LIMIT_EVENT_PERIOD_NS: Final = 1_000_000_000
"""Shortest time between two events of one limit of a rig, ns: a joint may chatter at its stop."""
MAX_LIMITS: Final = 4096
"""Number of limits whose events are rate-limited; a rig has 9."""
OVERRUN_EVENT_PERIOD_NS: Final = 1_000_000_000
"""Shortest time between two overrun events, ns."""
ACCURACY_EVENT_PERIOD_NS: Final = 1_000_000_000
"""Shortest time between two events of one rig that its steps are inaccurate, ns."""
MAX_RIGS: Final = 4096
"""Number of rigs whose accuracy events are rate-limited."""


class SimulationEvents:
    """Emits the events of the simulation, rate-limited where they may occur in bursts."""

    def __init__(self, emit: Callable[[Event], None], rigs: Sequence[str], plant: Plant) -> None:
        self._emit = emit
        self._rigs = tuple(rigs)
        self._plant = plant
        self._limits: RateLimiter[tuple[str, int, bool]] = RateLimiter(LIMIT_EVENT_PERIOD_NS, MAX_LIMITS)
        self._overruns: RateLimiter[None] = RateLimiter(OVERRUN_EVENT_PERIOD_NS)
        self._inaccurate: RateLimiter[str] = RateLimiter(ACCURACY_EVENT_PERIOD_NS, MAX_RIGS)
        self._errors: dict[str, Floats] = {}
        """Largest error estimate of each joint since the last event, by rig."""
        self.overran = False
        """Whether there are overruns that were not reported yet."""
        self._overrun_step = 0
        self._missed = 0
        self._worst_ns = 0

    def set_rigs(self, rigs: Sequence[str], plant: Plant) -> None:
        """Replace the rigs, because one was added or removed."""
        self._rigs = tuple(rigs)
        self._plant = plant

    def report_plant_events(
        self, events: Sequence[PlantEvent], step: int, now_ns: int, sessions: Sequence[str]
    ) -> None:
        """Emit the events of a step of the plant; `step` is the first one whose state shows them."""
        for plant_event in events:
            is_limit = plant_event.kind is PlantEventKind.LIMIT_HIT
            event = self._limit(plant_event, now_ns) if is_limit else self._part(plant_event)
            if event is not None:
                event.rig = self._rigs[plant_event.rig]
                event.session = sessions[plant_event.rig]
                event.step = step
                self._emit(event)

    def report_command_changes(self, rig: int, command: CommandLatch, step: int) -> None:
        """Emit events for lost and resumed commands, and for resets."""
        silence = WatchdogData(silent_ns=command.silent_ns, timeout_ns=command.timeout_ns)
        events = []
        if command.command_lost:
            text = (
                f"no command received for {command.silent_ns / 1e6:.0f} ms: torque set to zero until the next command"
            )
            events.append(Event(kind=Event.COMMAND_LOST, severity=Event.WARNING, text=text, watchdog_data=silence))
        if command.command_resumed:
            text = f"commands received again after {command.silent_ns / 1e6:.0f} ms"
            events.append(Event(kind=Event.COMMAND_BACK, severity=Event.INFO, text=text, watchdog_data=silence))
        if command.reset:
            events.append(Event(kind=Event.RESET, severity=Event.INFO, text="reset to the start pose"))
        for event in events:
            event.rig, event.session, event.step = self._rigs[rig], command.session, step
            self._emit(event)

    def report_divergence(self, rig: int, session: str, step: int) -> None:
        """Emit the event of a diverged rig, which is at its start pose from `step` on."""
        text = (
            "the simulation diverged, because the motion was too fast for the step; reset to the start pose: use less "
            "torque, or set a shorter sim.step_ms or more sim.substeps"
        )
        event = Event(
            kind=Event.RESET, severity=Event.ERROR, text=text, rig=self._rigs[rig], session=session, step=step
        )
        self._emit(event)

    def report_inaccurate(self, rig: int, error: Floats, session: str, step: int, now_ns: int) -> None:
        """Emit that the error estimate of a step exceeds its bound, rate-limited; `step` is the one after it."""
        name = self._rigs[rig]
        worst = self._errors[name] = np.maximum(self._errors.get(name, error), error)
        count = self._inaccurate.record(name, now_ns)
        if not count:
            return
        del self._errors[name]
        joint = int(np.argmax(worst / ERROR_BOUND))
        size = f"{worst[joint] * JOINT_SCALE[joint]:.3g} {'mm' if joint == 2 else '°'}"
        text = (
            f"inaccurate step: the estimated error of joint {joint + 1} is {size}; use less torque, a shorter "
            f'sim.step_ms or sim.substeps = "auto"{repeat_suffix(count)}'
        )
        data = IntegrationData(error=worst.tolist(), steps=count)
        event = Event(kind=Event.INACCURATE_STEP, severity=Event.WARNING, text=text, integration_data=data)
        event.rig, event.session, event.step = name, session, step
        self._emit(event)

    def record_overrun(self, tick: Tick, step: int, step_ns: int, now_ns: int, sessions: Sequence[str]) -> None:
        """Record a tick that was more than a step late, or skipped steps, and emit it, rate-limited.

        `sessions`: those of the rigs. A stall is an event of each rig, so that each recording has it.
        """
        self._overrun_step = step
        self._missed += tick.missed_steps
        # Lateness against the original deadline: `lateness_ns` is against the one after the skipped steps.
        self._worst_ns = max(self._worst_ns, tick.lateness_ns + tick.missed_steps * step_ns)
        self.overran = True
        if self._worst_ns > STALL_NS:
            self._emit_overruns(zip(self._rigs, sessions, strict=True))
        elif self._overruns.record(None, now_ns):
            self._emit_overruns()

    def report_overruns(self, now_ns: int) -> None:
        """Emit one event for the overruns that were not reported, if its period has ended; call it while `overran`."""
        for _ in self._overruns.pop_remainders(now_ns):
            self._emit_overruns()

    def _emit_overruns(self, rigs: Iterable[tuple[str, str]] = (("", ""),)) -> None:
        """Emit the overruns as events of the rigs, each with its session; by default as an event of the service."""
        data = OverrunData(lateness_ns=self._worst_ns, missed_steps=self._missed)
        steps = f"{self._missed} step{'' if self._missed == 1 else 's'}"
        text = f"simulation overrun: up to {self._worst_ns / 1e6:.1f} ms late, {steps} skipped"
        step = self._overrun_step
        for rig, session in rigs:
            event = Event(kind=Event.OVERRUN, severity=Event.WARNING, text=text, step=step, overrun_data=data)
            event.rig, event.session = rig, session
            self._emit(event)
        self._missed = self._worst_ns = 0
        self.overran = False

    def _limit(self, hit: PlantEvent, now_ns: int) -> Event | None:
        count = self._limits.record((self._rigs[hit.rig], hit.joint, hit.upper), now_ns)
        if not count:
            return None
        linear = hit.joint in (0, 3)
        speed = f"{hit.speed * 1e3:.0f} mm/s" if linear else f"{math.degrees(hit.speed):.0f} °/s"
        if hit.joint == 0:
            text = f"the tool hit an object below it at {speed}"
        else:
            text = f"joint {hit.joint} hit its {'upper' if hit.upper else 'lower'} stop at {speed}"
        text += repeat_suffix(count)
        data = LimitData(joint=hit.joint, upper=hit.upper, speed=hit.speed)
        return Event(kind=Event.LIMIT_HIT, severity=Event.INFO, text=text, limit_data=data)

    def _part(self, plant_event: PlantEvent) -> Event:
        world, rig, part = self._plant.world, plant_event.rig, plant_event.part
        name = world.part_names[rig][part]
        mass = float(world.mass[part, rig])
        data = PartData(
            part=name,
            x=float(world.x[part, rig]),
            y=float(world.y[part, rig]),
            z=float(world.z[part, rig]),
            mass=mass,
        )
        picked = plant_event.kind is PlantEventKind.PART_PICKED
        return Event(
            kind=Event.PART_PICKED if picked else Event.PART_DROPPED,
            severity=Event.INFO,
            text=f"the magnet {'picked' if picked else 'released'} {name!r} ({mass:g} kg)",
            part_data=data,
        )
