"""What the simulation tells people of: limits hit, parts picked and dropped, commands lost, resets, overruns."""

import math
from collections.abc import Callable, Sequence
from typing import Final

from hilrig_runtime.timing.rate import Tick
from hilrig_schemas import Event
from hilrig_schemas.v1.event_pb2 import LimitData, OverrunData, PartData, WatchdogData
from hilrig_sim.commands import CommandFollower
from hilrig_sim.plant.limits import Happening, PlantEvent
from hilrig_sim.plant.plant import Plant

QUIET_NS: Final = 250_000_000
"""A rig's limit is told of at most once in so long: a joint may rattle at its stop."""
OVERRUN_QUIET_NS: Final = 1_000_000_000
"""Overruns are gathered for so long, ns."""


class Reporter:
    """Makes events out of what happened, and holds back those that would come in bursts."""

    def __init__(self, emit: Callable[[Event], None], rigs: Sequence[str], plant: Plant) -> None:
        self._emit = emit
        self._rigs = tuple(rigs)
        self._plant = plant
        self._limit_told_ns: dict[tuple[int, int, bool], int] = {}
        self._overrun_told_ns = -OVERRUN_QUIET_NS
        self.overran = False
        """Overruns were noted that were not told of."""
        self._overrun_step = 0
        self._missed = 0
        self._worst_ns = 0

    def regroup(self, rigs: Sequence[str], plant: Plant) -> None:
        """Tell of these rigs from now on."""
        self._rigs = tuple(rigs)
        self._plant = plant
        self._limit_told_ns.clear()

    def tell_of_plant(self, events: Sequence[PlantEvent], step: int, now_ns: int, sessions: Sequence[str]) -> None:
        """What a step of the plant brought; `step` is the first whose state shows it."""
        for happened in events:
            is_limit = happened.happening is Happening.LIMIT_HIT
            event = self._limit(happened, now_ns) if is_limit else self._part(happened)
            if event is not None:
                event.rig = self._rigs[happened.rig]
                event.session = sessions[happened.rig]
                event.step = step
                self._emit(event)

    def tell_of_commands(self, rig: int, follower: CommandFollower, step: int) -> None:
        """Commands that stopped or came again, and resets."""
        silence = WatchdogData(silent_ns=follower.silent_ns, timeout_ns=follower.timeout_ns)
        events = []
        if follower.lost:
            text = f"no command for {follower.silent_ns / 1e6:.0f} ms: zero torque"
            events.append(Event(kind=Event.COMMAND_LOST, severity=Event.WARNING, text=text, watchdog_data=silence))
        if follower.back:
            text = f"commands again after {follower.silent_ns / 1e6:.0f} ms"
            events.append(Event(kind=Event.COMMAND_BACK, severity=Event.INFO, text=text, watchdog_data=silence))
        if follower.reset:
            events.append(Event(kind=Event.RESET, severity=Event.INFO, text="back at the start pose"))
        for event in events:
            event.rig, event.session, event.step = self._rigs[rig], follower.session, step
            self._emit(event)

    def tell_of_escape(self, rig: int, session: str, step: int) -> None:
        """A rig whose motion was too fast for the step, and which is back at its start pose from `step` on."""
        text = "the motion was too fast for the step: back at the start pose"
        event = Event(
            kind=Event.RESET, severity=Event.ERROR, text=text, rig=self._rigs[rig], session=session, step=step
        )
        self._emit(event)

    def note_overrun(self, tick: Tick, step: int, step_ns: int) -> None:
        """A tick that came more than a step late, or gave up deadlines; `tell_of_overruns` says so."""
        self.overran = True
        self._overrun_step = step
        self._missed += tick.missed_steps
        # Behind the deadline that it was meant for: its lateness is against the one that was taken up again.
        self._worst_ns = max(self._worst_ns, tick.lateness_ns + tick.missed_steps * step_ns)

    def tell_of_overruns(self, now_ns: int) -> None:
        """What was noted since they were last told of, all together and once in a while; `overran`: there is some."""
        if now_ns - self._overrun_told_ns < OVERRUN_QUIET_NS:
            return
        data = OverrunData(lateness_ns=self._worst_ns, missed_steps=self._missed)
        steps = f"{self._missed} step{'' if self._missed == 1 else 's'}"
        text = f"the simulation came {self._worst_ns / 1e6:.1f} ms late and gave up {steps}"
        step = self._overrun_step
        self._emit(Event(kind=Event.OVERRUN, severity=Event.WARNING, text=text, step=step, overrun_data=data))
        self._overrun_told_ns = now_ns
        self._missed = self._worst_ns = 0
        self.overran = False

    def _limit(self, hit: PlantEvent, now_ns: int) -> Event | None:
        place = (hit.rig, hit.joint, hit.upper)
        told_ns = self._limit_told_ns.get(place)
        self._limit_told_ns[place] = now_ns
        if told_ns is not None and now_ns - told_ns < QUIET_NS:
            return None
        linear = hit.joint in (0, 3)
        speed = f"{hit.speed * 1e3:.0f} mm/s" if linear else f"{math.degrees(hit.speed):.0f} °/s"
        if hit.joint == 0:
            text = f"the tool came down on what is below it at {speed}"
        else:
            text = f"joint {hit.joint} came to its {'upper' if hit.upper else 'lower'} stop at {speed}"
        data = LimitData(joint=hit.joint, upper=hit.upper, speed=hit.speed)
        return Event(kind=Event.LIMIT_HIT, severity=Event.INFO, text=text, limit_data=data)

    def _part(self, happened: PlantEvent) -> Event:
        world, rig, part = self._plant.world, happened.rig, happened.part
        name = world.part_names[rig][part]
        mass = float(world.mass[part, rig])
        data = PartData(
            part=name,
            x=float(world.x[part, rig]),
            y=float(world.y[part, rig]),
            z=float(world.z[part, rig]),
            mass=mass,
        )
        picked = happened.happening is Happening.PART_PICKED
        return Event(
            kind=Event.PART_PICKED if picked else Event.PART_DROPPED,
            severity=Event.INFO,
            text=f"the magnet {'took' if picked else 'let go of'} {name!r} ({mass:g} kg)",
            part_data=data,
        )
