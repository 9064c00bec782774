"""Applies the active network impairment to the state link and command link of one rig, and reports changes.

Only the state link and the clients' commands are impaired; lease, watchdog and internal commands are not. Without an
impairment, no part of it is called by a read or write.
"""

from typing import Literal

from hilrig_modbus_edge.device.command_publisher import CommandPublisher
from hilrig_modbus_edge.device.events import EventEmitter
from hilrig_modbus_edge.device.state_reader import StateReader
from hilrig_modbus_edge.impairment.delay_line import ImpairmentSamples
from hilrig_modbus_edge.impairment.model import Impairment, link_seed
from hilrig_modbus_edge.impairment.schedule import ImpairmentSchedule
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, ImpairmentStatus


class ImpairmentController:
    """Impairment of one rig: activates settings and follows the schedule."""

    def __init__(
        self,
        rig: str,
        lab: ImpairmentConfig,
        clock: Clock,
        states: StateReader,
        commands: CommandPublisher,
        events: EventEmitter,
    ) -> None:
        self._rig = rig
        self._monotonic_ns = clock.monotonic_ns
        self._states = states
        self._commands = commands
        self._events = events
        self._schedule = ImpairmentSchedule(lab)

    def start(self) -> None:
        """Apply the setting of lab.toml."""
        if not self._schedule.links.is_inactive:
            self._apply()

    def start_session(self) -> None:
        """Restart schedule and delays for a session, and emit the active setting for its recording."""
        now_ns, before = self._monotonic_ns(), self._schedule.links
        self._schedule.start_session(now_ns)
        self._schedule.check(now_ns)
        if self._schedule.links != before or not before.is_inactive:
            self._apply()

    def set(self, config: ImpairmentConfig | None) -> None:
        """Override the impairment; None: restore the setting of lab.toml."""
        if config is None:
            self._schedule.clear_override()
        else:
            self._schedule.set_override(config)
        self._apply()

    def check(self, now_ns: int) -> None:
        """Follow the schedule; ns, monotonic clock."""
        if self._schedule.check(now_ns):
            self._apply()
        if self._states.delayed is not None:
            # Without readers, the received states must not accumulate.
            self._states.delayed.newest(now_ns)

    def status(self) -> ImpairmentStatus:
        """Return the active setting and its counters."""
        schedule = self._schedule
        status = ImpairmentStatus(
            rig=self._rig,
            text=schedule.links.describe(),
            links_json=schedule.links.model_dump_json(),
            seed=schedule.seed,
            source=schedule.source,
        )
        if self._states.delayed is not None:
            states = self._states.delayed.line
            status.states, status.states_lost, status.states_superseded = states.count, states.lost, states.superseded
        if self._commands.delayed is not None:
            commands = self._commands.delayed.line
            status.commands, status.commands_lost = commands.count, commands.lost
            status.commands_superseded = commands.superseded
        return status

    def _apply(self) -> None:
        schedule = self._schedule
        links = schedule.links
        self._states.set_impairment(self._samples("state"))
        self._commands.set_impairment(self._samples("command"))
        seed_text = "" if links.is_inactive else f", seed {schedule.seed}"
        text = f"impairment of {self._rig}: {links.describe()}{seed_text} (source: {schedule.source})"
        event = self._events.event(Event.IMPAIRMENT_CHANGED, Event.INFO, text)
        event.configuration_data.text = links.model_dump_json()
        self._events.emit(event)

    def _samples(self, link: Literal["state", "command"]) -> ImpairmentSamples | None:
        """Return the samples of a link; None: it is not impaired."""
        settings = self._schedule.links.state if link == "state" else self._schedule.links.command
        if settings.is_inactive:
            return None
        return Impairment(settings, link_seed(self._schedule.seed, self._rig, link)).samples()
