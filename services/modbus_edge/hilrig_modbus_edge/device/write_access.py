"""Write access to a rig: lease, watchdog and session.

The first client that writes acquires the lease. A write of the lease holder is accepted, and feeds the watchdog unless
the emulated network drops it. The lease expires a timeout after the holder's last request of any kind. A session starts
with a lease and ends a grace time after it. Time is passed in or read from the given clock.
"""

import random
from collections.abc import Set as AbstractSet
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.command_scheduler import TimerHandle
from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.command_publisher import CommandPublisher
from hilrig_modbus_edge.device.events import EventEmitter, LeaseEventReporter, StallReporter
from hilrig_modbus_edge.device.impairment_controller import ImpairmentController
from hilrig_modbus_edge.device.output import DeviceOutput
from hilrig_modbus_edge.device.session import Session, SessionState
from hilrig_modbus_edge.device.settings import MS, DeviceSettings
from hilrig_modbus_edge.device.watchdog import Watchdog
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_runtime.process.session_id import session_id
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, LeaseStatus

CONTROLLER_CHANGE_PERIOD_NS: Final = 1_000 * MS
"""Shortest time between two changes of the controller that writes, ns: two controllers that write alternately would
otherwise create a recording per write."""


class Refusal(NamedTuple):
    """A write that is refused."""

    reason: str
    """Human-readable."""
    code: ExcCodes


class Holder(Protocol):
    """A client that can hold a lease; compared by identity."""

    last_request_ns: int
    """Time of its last request, ns, monotonic clock."""


HolderT = TypeVar("HolderT", bound=Holder)


class Lease(Generic[HolderT]):
    """Exclusive write permission: at most one holder, which keeps it while it sends requests. Time is passed in."""

    def __init__(self, timeout_ns: int) -> None:
        self.timeout_ns = timeout_ns
        self.holder: HolderT | None = None

    def acquire(self, client: HolderT) -> bool:
        """Give the lease to `client` if it is free; return whether `client` holds it now."""
        if self.holder is None:
            self.holder = client
        return self.holder is client

    def release(self) -> HolderT | None:
        """Release the lease and return the previous holder."""
        holder, self.holder = self.holder, None
        return holder

    def expired(self, now_ns: int) -> bool:
        """Return whether the holder has sent no request for the timeout."""
        return self.holder is not None and now_ns - self.holder.last_request_ns >= self.timeout_ns


class WriteAccess:
    """Decides which client may write to a rig, and stops the rig when the writes stop."""

    def __init__(
        self,
        rig: str,
        settings: DeviceSettings,
        clock: Clock,
        output: DeviceOutput,
        commands: CommandPublisher,
        impairment: ImpairmentController,
        events: EventEmitter,
        session: SessionState,
        clients: AbstractSet[Client],
        rng: random.Random | None,
    ) -> None:
        self.lease: Lease[Client] = Lease(settings.lease_ns)
        self.watchdog = Watchdog(settings.watchdog_ns)
        self._session = session
        self._clients = clients
        self._rig = rig
        self._settings = settings
        self._monotonic_ns = clock.monotonic_ns
        self._wall_ns = clock.wall_ns
        self._output = output
        self._commands = commands
        self._impairment = impairment
        self._events = events
        self._rng = random.SystemRandom() if rng is None else rng
        self._lease_events = LeaseEventReporter(rig, events)
        self.stalls = StallReporter(events)
        self._session_count = 0
        self._last_writer = ""
        self._controller_change_ns = 0
        """Earliest time at which another controller may end a session, ns, monotonic clock."""
        self._watchdog_timer: TimerHandle | None = None

    def authorize_write(self, client: Client, now_ns: int) -> None:
        """Authorize a valid write; ns, monotonic clock.

        Raises:
            ModbusError: 06 another client holds the lease, 01 the client is read-only.
        """
        if self.lease.holder is client:
            return
        refusal = self.authorize(client, now_ns)
        if refusal is not None:
            self._lease_events.lease_denied(client, refusal.reason, self._holder, now_ns)
            raise ModbusError(refusal.code)
        self._acquire_lease(client, now_ns)

    def authorize(self, client: Client, now_ns: int) -> Refusal | None:
        """Return why a client may not write to the rig now; None: it may. The only place of these reasons.

        Args:
            client: connection that writes; its controller is that of `controller_of`.
            now_ns: time, ns, monotonic clock.
        """
        if not client.may_write:
            return Refusal(
                "read-only: the client certificate lacks the role operator; use a certificate with that role",
                ExcCodes.ILLEGAL_FUNCTION,
            )
        if now_ns < client.lease_cooldown_until_ns:
            wait_s = (client.lease_cooldown_until_ns - now_ns) / 1e9
            return Refusal(f"its lease was revoked; write again in {wait_s:.1f} s", ExcCodes.DEVICE_BUSY)
        if self.lease.holder not in (None, client):
            return Refusal(
                f"{self._holder} holds the lease; stop that client, or run: hilrig lease {self._rig} --release",
                ExcCodes.DEVICE_BUSY,
            )
        session = self._session.current
        if session is not None and session.controller is not client.controller and now_ns < self._controller_change_ns:
            return Refusal(
                f"{session.controller.name} acquired the lease less than 1 s ago; write again in 1 s",
                ExcCodes.DEVICE_BUSY,
            )
        return None

    def feed_watchdog(self, client: Client, now_ns: int) -> None:
        """Feed the watchdog with an authorized write that was not dropped; ns, monotonic clock."""
        watchdog = self.watchdog
        if watchdog.fed_ns is not None:
            watchdog.fed_ns = now_ns
            return
        if watchdog.feed(now_ns):
            text = f"watchdog of {self._rig} re-armed: {client.address} writes again"
            event = self._events.event(Event.WATCHDOG_REARM, Event.INFO, text)
            event.watchdog_data.timeout_ns = watchdog.timeout_ns
            self._events.emit(event)
        self._schedule_check()

    def check_timeout(self, timeout_ns: int) -> None:
        """Check a watchdog timeout that a client sets.

        Raises:
            ModbusError: 04 the timeout is outside the bounds of the lab.
        """
        settings = self._settings
        if timeout_ns != settings.watchdog_ns and not (
            settings.watchdog_min_ns <= timeout_ns <= settings.watchdog_max_ns
        ):
            raise ModbusError(ExcCodes.DEVICE_FAILURE)

    def set_timeout(self, timeout_ns: int) -> None:
        """Set the watchdog timeout; it counts from the last write."""
        self.watchdog.timeout_ns = timeout_ns
        self._schedule_check()

    def on_disconnect(self, client: Client, reason: str) -> None:
        """Release the lease of a closed connection; its torque stays applied until the watchdog trips."""
        if self.lease.holder is client:
            self._release_lease(reason, disconnected=True)

    def check(self, now_ns: int) -> None:
        """Do everything that is due: watchdog trip, lease expiry, end of the session; ns, monotonic clock."""
        silent_ns = self.watchdog.check(now_ns)
        if silent_ns:
            self._trip(silent_ns, now_ns)
        self._lease_events.check(now_ns)
        self.stalls.check(now_ns)
        if self.lease.expired(now_ns):
            self._release_lease(f"no request for {self._settings.lease_ns / 1e9:g} s (edge.lease_timeout_ms)")
        session = self._session.current
        if session is not None and session.expired(now_ns, self._settings.grace_ns):
            self._end_session("no lease holder for the grace time (edge.session_grace_ms)")

    def release(self, reason: str) -> str:
        """Revoke the lease, on request of an operator; return the previous holder, empty: none.

        For the lease timeout that connection cannot acquire it again. Otherwise its next write would do so before any
        other client could.
        """
        holder = self.lease.holder
        if holder is None:
            return ""
        holder.lease_cooldown_until_ns = self._monotonic_ns() + self._settings.lease_ns
        self._release_lease(reason)
        return holder.address

    def stop(self, reason: str) -> None:
        """Set the torque to zero, release the lease and end the session, because the edge stops."""
        self._release_lease(reason)
        self.watchdog.disarm()
        self._commands.zero()
        if self._session.current is not None:
            self._end_session(reason)
        else:
            self._commands.publish_internal()

    def status(self) -> LeaseStatus:
        """Return the status of lease, session and watchdog."""
        holder = self.lease.holder
        return LeaseStatus(
            rig=self._rig,
            holder=self._holder,
            silent_ns=0 if holder is None else self._monotonic_ns() - holder.last_request_ns,
            session=self._session.id,
            watchdog_tripped=self.watchdog.tripped,
            watchdog_timeout_ns=self.watchdog.timeout_ns,
        )

    @property
    def _holder(self) -> str:
        """Address of the lease holder; empty: none."""
        holder = self.lease.holder
        return "" if holder is None else holder.address

    def _acquire_lease(self, client: Client, now_ns: int) -> None:
        session = self._session.current
        if session is not None and session.controller is not client.controller:
            self._controller_change_ns = now_ns + CONTROLLER_CHANGE_PERIOD_NS
            self._end_session(f"{client.address} acquired the lease")
        self.lease.acquire(client)
        self._last_writer = client.address
        self._start_or_continue_session(client)
        self._lease_events.lease_acquired(client, now_ns)

    def _release_lease(self, reason: str, *, disconnected: bool = False) -> None:
        holder = self.lease.release()
        if holder is None:
            return
        if self._session.current is not None:
            self._session.current.released_ns = self._monotonic_ns()
        if not self._commands.has_torque:
            # There is no torque to stop.
            self.watchdog.disarm()
        self._lease_events.lease_released(holder, reason, disconnected=disconnected)

    def _start_or_continue_session(self, client: Client) -> None:
        if self._session.current is not None:
            self._session.current.released_ns = None
            return
        self._session_count += 1
        wall_ns = self._wall_ns()
        identity = session_id(self._rig, wall_ns, self._rng)
        number = self._session_count
        self._session.current = Session(self._rig, identity, number, client.address, client.controller, wall_ns)
        # What another connection read before the session is no basis in it: it may have been another program.
        client.controller.clear_served()
        # Watchdog timeout and echo value were written by the client of the previous session: restore the defaults.
        self.watchdog.timeout_ns = self._settings.watchdog_ns
        self._commands.echo = 0
        event = self._events.event(Event.SESSION_START, Event.INFO, f"session {identity} started by {client.address}")
        event.session_data.controller = client.address
        event.session_data.reason = "lease acquired"
        self._events.emit(event)
        self._output.sessions_changed()
        self._impairment.start_session()

    def _end_session(self, reason: str) -> None:
        session = self._session.current
        if session is None:
            return
        # No command of the next session is based on a state that was read in this one.
        for client in self._clients:
            client.clear_served()
        self.stalls.flush()
        event = self._events.event(Event.SESSION_END, Event.INFO, f"session {session.id} ended: {reason}")
        event.session_data.controller = session.address
        event.session_data.reason = reason
        # This command tells the simulation that the session has ended. It is a new one, because it has no session.
        self._session.current = None
        self._commands.publish_internal()
        self._events.emit(event)
        self._output.sessions_changed()

    def _trip(self, silent_ns: int, now_ns: int) -> None:
        self._commands.zero()
        self._commands.publish_internal()
        holder = self.lease.holder
        if holder is None:
            cause = f"{self._last_writer} no longer holds the lease"
        elif now_ns - holder.last_request_ns >= self.watchdog.timeout_ns:
            cause = f"{holder.address} sends no requests"
        else:
            cause = f"{holder.address} reads but does not write"
        text = (
            f"watchdog of {self._rig} tripped: no write for {silent_ns // MS} ms, torque set to zero: {cause}; "
            "the next write re-arms it"
        )
        event = self._events.event(Event.WATCHDOG_TRIP, Event.WARNING, text)
        event.watchdog_data.silent_ns = silent_ns
        event.watchdog_data.timeout_ns = self.watchdog.timeout_ns
        self._events.emit(event)

    def _schedule_check(self) -> None:
        """Schedule a check at the deadline of the watchdog.

        Writes move the deadline, but not the timer, because there are too many of them.
        """
        if self._watchdog_timer is not None:
            self._watchdog_timer.cancel()
        deadline_ns = self.watchdog.deadline_ns
        if deadline_ns is not None:
            self._watchdog_timer = self._output.call_at(deadline_ns, self._on_timer)

    def _on_timer(self) -> None:
        self.check(self._monotonic_ns())
        self._schedule_check()
