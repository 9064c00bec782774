"""Applies the active network impairment to the state link and command link of one rig, and reports changes.

Without an impairment, states are read where they are received and commands are published at once. Only the state link
and the clients' commands are impaired; lease, watchdog and internal commands are not.
"""

from collections.abc import Callable

from hilrig_modbus_edge.device.command_publisher import CommandPublisher
from hilrig_modbus_edge.device.events import EventEmitter
from hilrig_modbus_edge.device.output import DeviceOutput
from hilrig_modbus_edge.impairment.delay_line import DelayedStates
from hilrig_modbus_edge.impairment.model import Impairment, link_seed
from hilrig_modbus_edge.impairment.schedule import ImpairmentSchedule
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, ImpairmentStatus


class ImpairmentController:
    """Impairment of one rig: activates settings, follows the schedule, and provides the newest delivered state."""

    def __init__(
        self,
        rig: str,
        lab: ImpairmentConfig,
        clock: Clock,
        output: DeviceOutput,
        commands: CommandPublisher,
        events: EventEmitter,
        newest_state: Callable[[], TimestampedPayload | None],
    ) -> None:
        self.newest_state = newest_state
        """Return the newest state that the state link has delivered; None: none so far."""
        self._rig = rig
        self._monotonic_ns = clock.monotonic_ns
        self._output = output
        self._commands = commands
        self._events = events
        self._newest_received = newest_state
        self._delayed_states: DelayedStates | None = None
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
        if self._delayed_states is not None:
            # Without readers, the received states must not accumulate.
            self._delayed_states.newest(now_ns)

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
        if self._delayed_states is not None:
            line = self._delayed_states.line
            status.states, status.states_lost, status.states_superseded = line.count, line.lost, line.superseded
        commands = self._commands.delay_line
        if commands is not None:
            status.commands, status.commands_lost = commands.count, commands.lost
            status.commands_superseded = commands.superseded
        return status

    def _apply(self) -> None:
        schedule = self._schedule
        links, seed = schedule.links, schedule.seed
        if links.state.is_inactive:
            self._remove_state_impairment()
        else:
            self._impair_states(Impairment(links.state, link_seed(seed, self._rig, "state")))
        samples = None
        if not links.command.is_inactive:
            samples = Impairment(links.command, link_seed(seed, self._rig, "command")).samples()
        self._commands.set_impairment(samples)
        seed_text = "" if links.is_inactive else f", seed {seed}"
        text = f"impairment of {self._rig}: {links.describe()}{seed_text} (source: {schedule.source})"
        event = self._events.event(Event.IMPAIRMENT_CHANGED, Event.INFO, text)
        event.configuration_data.text = links.model_dump_json()
        self._events.emit(event)

    def _impair_states(self, impairment: Impairment) -> None:
        if self._delayed_states is not None:
            self._delayed_states.line.set_samples(impairment.samples())
            return
        # The last served state stays the newest one until the first state is delivered.
        delayed = self._delayed_states = DelayedStates(impairment.samples(), self._newest_received())
        self.newest_state = lambda: delayed.newest(self._monotonic_ns())
        self._output.follow_states(delayed.arrive)

    def _remove_state_impairment(self) -> None:
        if self._delayed_states is not None:
            self._delayed_states = None
            self.newest_state = self._newest_received
            self._output.follow_states(None)
