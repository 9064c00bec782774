"""Who writes to a rig, for how long, and what happens when he stops: lease, watchdog and session together.

A write is accepted from the lease's holder, and feeds the watchdog; the lease runs from the last request of any kind.
A session begins with a lease and outlives it by a grace time. Pure: time is passed in, or read from a clock that was.
"""

import random
from collections.abc import Callable
from typing import Final

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.command_publisher import Commander
from hilrig_modbus_edge.device.events import Journal
from hilrig_modbus_edge.device.lease import Lease
from hilrig_modbus_edge.device.lease_events import Handover
from hilrig_modbus_edge.device.session import Session
from hilrig_modbus_edge.device.settings import MS, DeviceSettings, Outlet
from hilrig_modbus_edge.device.watchdog import Watchdog
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_runtime.process.session_id import session_id
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, LeaseStatus

HANDOVER_PERIOD_NS: Final = 1_000 * MS
"""From host to host a rig goes once in so long: two that take turns with each write would make a recording of each."""


class Tenure:
    """See the module."""

    def __init__(
        self,
        rig: str,
        settings: DeviceSettings,
        clock: Clock,
        outlet: Outlet,
        commander: Commander,
        journal: Journal,
        letters: random.Random | None = None,
        begin_session: Callable[[], None] = lambda: None,
    ) -> None:
        self.lease: Lease[Client] = Lease(settings.lease_ns)
        self.watchdog = Watchdog(settings.watchdog_ns)
        self.session: Session | None = None
        self._rig = rig
        self._settings = settings
        self._monotonic_ns = clock.monotonic_ns
        self._wall_ns = clock.wall_ns
        self._outlet = outlet
        self._commander = commander
        self._journal = journal
        self._letters = random.SystemRandom() if letters is None else letters
        self._handover = Handover(rig, journal)
        self._session_count = 0
        self._last_writer = ""
        self._handover_due_ns = 0
        """When another host may end a session again, ns, monotonic clock."""
        self._begin_session = begin_session

    def accept(self, client: Client, now_ns: int) -> None:
        """Accept a write that is right otherwise; ns, monotonic clock.

        Raises:
            ModbusError: 06 another controller holds the rig, 01 this one may only read.
        """
        if self.lease.holder is not client:
            self._take_lease(client, now_ns)
        watchdog = self.watchdog
        if watchdog.fed_ns is not None:
            watchdog.fed_ns = now_ns
            return
        if watchdog.feed(now_ns):
            text = f"{client.address} writes again: the watchdog is armed"
            event = self._journal.event(Event.WATCHDOG_REARM, Event.INFO, text)
            event.watchdog_data.timeout_ns = watchdog.timeout_ns
            self._journal.tell(event)
        self._watch()

    def lost(self, fed_ns: int | None) -> None:
        """The write that was just accepted is lost on an impaired way: it was no word to the watchdog.

        `fed_ns` is when the watchdog was fed before; None: it did not watch, and watches from this write on.
        """
        if fed_ns is not None:
            self.watchdog.fed_ns = fed_ns

    def check_timeout(self, timeout_ns: int) -> None:
        """Nothing, if a controller may set the watchdog's time-out so.

        Raises:
            ModbusError: 04 it is outside the lab's bounds.
        """
        settings = self._settings
        if timeout_ns != settings.watchdog_ns and not (
            settings.watchdog_min_ns <= timeout_ns <= settings.watchdog_max_ns
        ):
            raise ModbusError(ExcCodes.DEVICE_FAILURE)

    def set_timeout(self, timeout_ns: int) -> None:
        """Set the watchdog's time-out; it holds from the last write on."""
        self.watchdog.timeout_ns = timeout_ns
        self._watch()

    def disconnected(self, client: Client, reason: str) -> None:
        """A connection ended; the lease ends with it, the torque stands until the watchdog trips."""
        if self.lease.holder is client:
            self._lose_lease(reason, of_itself=True)

    def check(self, now_ns: int) -> None:
        """Trip, lose the lease, end the session: what has become due; ns, monotonic clock."""
        silent_ns = self.watchdog.check(now_ns)
        if silent_ns:
            self._trip(silent_ns, now_ns)
        self._handover.check(now_ns)
        if self.lease.expired(now_ns):
            self._lose_lease(f"no request for {self._settings.lease_ns / 1e9:g} s")
        if self.session is not None and self.session.over(now_ns, self._settings.grace_ns):
            self._end_session("the controller is gone")

    def release(self, reason: str) -> str:
        """Take the rig from its controller, for the teacher: who held it; empty: nobody.

        For the lease's time-out that connection does not get it back: others could not be faster than its next write.
        """
        holder = self.lease.holder
        if holder is None:
            return ""
        holder.barred_until_ns = self._monotonic_ns() + self._settings.lease_ns
        self._lose_lease(reason)
        return holder.address

    def shut(self, reason: str) -> None:
        """The edge stops: no torque, no lease, no session."""
        self._lose_lease(reason)
        self.watchdog.rest()
        self._commander.zero()
        if self.session is not None:
            self._end_session(reason)
        else:
            self._commander.say()

    def status(self) -> LeaseStatus:
        """How the lease and the watchdog stand."""
        holder = self.lease.holder
        return LeaseStatus(
            rig=self._rig,
            holder=self._holder,
            silent_ns=0 if holder is None else self._monotonic_ns() - holder.last_request_ns,
            session="" if self.session is None else self.session.id,
            watchdog_tripped=self.watchdog.tripped,
            watchdog_timeout_ns=self.watchdog.timeout_ns,
        )

    @property
    def _holder(self) -> str:
        """Address of who holds the rig; empty: nobody."""
        holder = self.lease.holder
        return "" if holder is None else holder.address

    def _take_lease(self, client: Client, now_ns: int) -> None:
        session = self.session
        if not client.may_write:
            reason = "its certificate has not the role operator, so it may read only"
            self._refuse(client, now_ns, reason, ExcCodes.ILLEGAL_FUNCTION)
        if now_ns < client.barred_until_ns:
            self._refuse(client, now_ns, "the rig was taken from it", ExcCodes.DEVICE_BUSY)
        if self.lease.holder is not None:
            self._refuse(client, now_ns, f"{self._holder} holds it", ExcCodes.DEVICE_BUSY)
        if session is not None and session.host.address != client.host.address:
            if now_ns < self._handover_due_ns:
                reason = f"{session.host.address} took it less than a second ago"
                self._refuse(client, now_ns, reason, ExcCodes.DEVICE_BUSY)
            self._handover_due_ns = now_ns + HANDOVER_PERIOD_NS
            self._end_session(f"{client.address} took the rig")
        self.lease.take(client)
        self._last_writer = client.address
        self._go_on_with_session(client)
        self._handover.taken(client, now_ns)

    def _refuse(self, client: Client, now_ns: int, reason: str, code: ExcCodes) -> None:
        self._handover.refused(client, reason, self._holder, now_ns)
        raise ModbusError(code)

    def _lose_lease(self, reason: str, *, of_itself: bool = False) -> None:
        holder = self.lease.release()
        if holder is None:
            return
        if self.session is not None:
            self.session.gone_ns = self._monotonic_ns()
        if not self._commander.moves:
            # There is nothing to stop.
            self.watchdog.rest()
        self._handover.left(holder, reason, of_itself=of_itself)

    def _go_on_with_session(self, client: Client) -> None:
        if self.session is not None:
            self.session.gone_ns = None
            return
        self._session_count += 1
        wall_ns = self._wall_ns()
        identity = session_id(self._rig, wall_ns, self._letters)
        self.session = Session(self._rig, identity, self._session_count, client.address, client.host, wall_ns)
        self._commander.session = self._journal.session = identity
        # A time-out that the one before set by register was his, and so was his echo word.
        self.watchdog.timeout_ns = self._settings.watchdog_ns
        self._commander.echo = 0
        event = self._journal.event(Event.SESSION_START, Event.INFO, f"session {identity} of {client.address}")
        event.session_data.controller = client.address
        event.session_data.reason = "a controller took the rig"
        self._journal.tell(event)
        self._outlet.sessions_changed()
        self._begin_session()

    def _end_session(self, reason: str) -> None:
        session, self.session = self.session, None
        if session is None:
            return
        # The next session's first command is not based on what this one read, however long ago.
        session.host.forget_served()
        event = self._journal.event(Event.SESSION_END, Event.INFO, f"session {session.id} is over: {reason}")
        event.session_data.controller = session.controller
        event.session_data.reason = reason
        # The simulation learns from a command that the session is over; it is new, for it belongs to no session.
        self._commander.session = self._journal.session = ""
        self._commander.say()
        self._journal.tell(event)
        self._outlet.sessions_changed()

    def _trip(self, silent_ns: int, now_ns: int) -> None:
        self._commander.zero()
        self._commander.say()
        holder = self.lease.holder
        if holder is None:
            why = f"{self._last_writer} is gone"
        elif now_ns - holder.last_request_ns >= self.watchdog.timeout_ns:
            why = f"{holder.address} is silent"
        else:
            why = f"{holder.address} reads but does not write"
        text = f"torque to zero: {why}, no write for {silent_ns // MS} ms"
        event = self._journal.event(Event.WATCHDOG_TRIP, Event.WARNING, text)
        event.watchdog_data.silent_ns = silent_ns
        event.watchdog_data.timeout_ns = self.watchdog.timeout_ns
        self._journal.tell(event)

    def _watch(self) -> None:
        deadline_ns = self.watchdog.deadline_ns
        if deadline_ns is not None:
            self._outlet.watch(deadline_ns)
