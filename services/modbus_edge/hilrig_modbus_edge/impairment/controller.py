"""The loop of one rig as it is impaired: both ways set up, changed while it runs, told of and reported.

Without an impairment it stands beside the loop: states are taken where they come, and commands leave at once. Only
what a controller says is impaired; lease, watchdog and the edge's own word are not.
"""

from collections.abc import Callable

from hilrig_modbus_edge.device.command_publisher import Commander
from hilrig_modbus_edge.device.events import Journal
from hilrig_modbus_edge.device.settings import Outlet
from hilrig_modbus_edge.impairment.delay_line import StateWay
from hilrig_modbus_edge.impairment.model import Impairment, way_seed
from hilrig_modbus_edge.impairment.schedule import Course
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, ImpairmentStatus


class ImpairedLoop:
    """See the module."""

    def __init__(
        self,
        rig: str,
        lab: ImpairmentConfig,
        clock: Clock,
        outlet: Outlet,
        commander: Commander,
        journal: Journal,
        newest_state: Callable[[], TimestampedPayload | None],
    ) -> None:
        self.newest_state = newest_state
        """The newest state that has come to the end of its way; None: none has yet."""
        self._rig = rig
        self._monotonic_ns = clock.monotonic_ns
        self._outlet = outlet
        self._commander = commander
        self._journal = journal
        self._newest_of_all = newest_state
        self._state_way: StateWay | None = None
        self._course = Course(lab)

    def begin(self) -> None:
        """Bring into force what the lab says."""
        if not self._course.links.is_inactive:
            self._bring_into_force()

    def begin_session(self) -> None:
        """A session began: its schedule and its delays begin anew, and its recording is told of them."""
        now_ns, before = self._monotonic_ns(), self._course.links
        self._course.begin_session(now_ns)
        self._course.check(now_ns)
        if self._course.links != before or not before.is_inactive:
            self._bring_into_force()

    def set(self, config: ImpairmentConfig | None) -> None:
        """Impair the loop so from now on; None: as the lab says."""
        if config is None:
            self._course.set_as_lab()
        else:
            self._course.set_by_hand(config)
        self._bring_into_force()

    def check(self, now_ns: int) -> None:
        """Follow the schedule; ns, monotonic clock."""
        if self._course.check(now_ns):
            self._bring_into_force()
        if self._state_way is not None:
            # Where nobody reads, what has arrived must not pile up.
            self._state_way.newest(now_ns)

    def status(self) -> ImpairmentStatus:
        """What is in force, and what it has done."""
        course = self._course
        status = ImpairmentStatus(
            rig=self._rig,
            text=course.links.describe(),
            links_json=course.links.model_dump_json(),
            seed=course.seed,
            source=course.source,
        )
        if self._state_way is not None:
            line = self._state_way.line
            status.states, status.states_lost, status.states_superseded = line.count, line.lost, line.overtaken
        way = self._commander.way
        if way is not None:
            status.commands, status.commands_lost, status.commands_superseded = way.count, way.lost, way.overtaken
        return status

    def _bring_into_force(self) -> None:
        course = self._course
        links, seed = course.links, course.seed
        if links.state.is_inactive:
            self._free_state_way()
        else:
            self._impair_states(Impairment(links.state, way_seed(seed, self._rig, "state")))
        fates = None
        if not links.command.is_inactive:
            fates = Impairment(links.command, way_seed(seed, self._rig, "command")).each()
        self._commander.impair(fates)
        seeded = "" if links.is_inactive else f", seed {seed}"
        text = f"impairment of {self._rig}: {links.describe()}{seeded} (by {course.source})"
        event = self._journal.event(Event.IMPAIRMENT_CHANGED, Event.INFO, text)
        event.configuration_data.text = links.model_dump_json()
        self._journal.tell(event)

    def _impair_states(self, impairment: Impairment) -> None:
        if self._state_way is not None:
            self._state_way.line.follow(impairment.each())
            return
        # What was shown last stays until the first state has come to the end of its way.
        way = self._state_way = StateWay(impairment.each(), self._newest_of_all())
        self.newest_state = lambda: way.newest(self._monotonic_ns())
        self._outlet.follow_states(way.arrive)

    def _free_state_way(self) -> None:
        if self._state_way is not None:
            self._state_way = None
            self.newest_state = self._newest_of_all
            self._outlet.follow_states(None)
