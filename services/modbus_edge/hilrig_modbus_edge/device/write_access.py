"""Write access to a rig: lease, watchdog and session.

The first controller that writes acquires the lease, for all its connections. Its writes are accepted, and feed the
watchdog unless the emulated network drops them. The lease expires a timeout after the last request of any kind of its
writing connections, or, after the watchdog has tripped, with the write of another controller. A session starts with a
lease and ends a grace time after it. Time is passed in or read from the given clock.
"""

import random
from collections.abc import Set as AbstractSet
from typing import Final, Generic, NoReturn, Protocol, TypeVar

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.command_scheduler import TimerHandle
from hilrig_modbus_edge.device.client import Client, ConnectedController
from hilrig_modbus_edge.device.command_publisher import CommandPublisher
from hilrig_modbus_edge.device.events import EventEmitter, LeaseEventReporter, StallReporter
from hilrig_modbus_edge.device.impairment_controller import ImpairmentController
from hilrig_modbus_edge.device.ports import DeviceOutput, Ownership, Refusal
from hilrig_modbus_edge.device.session import Session, SessionState
from hilrig_modbus_edge.device.settings import MS, DeviceSettings
from hilrig_modbus_edge.device.watchdog import Watchdog
from hilrig_modbus_edge.device.writers import EXTENDED, ITEMS, MAGNET, Writers
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_runtime.process.session_id import session_id
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, LeaseStatus

CONTROLLER_CHANGE_PERIOD_NS: Final = 1_000 * MS
"""Shortest time between two changes of the controller that writes, ns: two controllers that write alternately would
otherwise create a recording per write."""


class Holder(Protocol):
    """A controller that can hold a lease; compared by identity."""

    @property
    def last_request_ns(self) -> int:
        """Time of its last request, ns, monotonic clock."""


HolderT = TypeVar("HolderT", bound=Holder)


class Lease(Generic[HolderT]):
    """Exclusive write permission: at most one holder, which keeps it while it sends requests. Time is passed in."""

    def __init__(self, timeout_ns: int) -> None:
        self.timeout_ns = timeout_ns
        self.holder: HolderT | None = None

    def acquire(self, controller: HolderT) -> bool:
        """Give the lease to `controller` if it is free; return whether `controller` holds it now."""
        if self.holder is None:
            self.holder = controller
        return self.holder is controller

    def release(self) -> HolderT | None:
        """Release the lease and return the previous holder."""
        holder, self.holder = self.holder, None
        return holder

    def expired(self, now_ns: int) -> bool:
        """Return whether the holder has sent no request for the timeout."""
        return self.holder is not None and now_ns - self.holder.last_request_ns >= self.timeout_ns


class WriteAccess:
    """Decides which connection may write to a rig, and stops the rig when the writes stop."""

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
        ownership: Ownership,
        rng: random.Random | None,
    ) -> None:
        self.lease: Lease[ConnectedController] = Lease(settings.lease_ns)
        self.watchdog = Watchdog(settings.watchdog_ns)
        self._session = session
        self._clients = clients
        self._ownership = ownership
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
        self._writers = Writers()
        self._session_count = 0
        self._reserved_for: Client | None = None
        """The only client that may write; None: any."""
        self._session_note = ""
        self._last_writer: Client | None = None
        """The newest writing connection, which may be closed."""
        self._permitted: AbstractSet[str] | None = None
        """Names in the certificates of the clients that may write; None: all clients."""
        self._controller_change_ns = 0
        """Earliest time at which another controller may end a session, ns, monotonic clock."""
        self._watchdog_timer: TimerHandle | None = None

    def reserve(self, client: Client, session_note: str) -> None:
        """Let only `client` write; `session_note` is added to the event of each session's start."""
        self._reserved_for = client
        self._session_note = session_note

    def authorize_write(self, client: Client, begin: int, end: int, now_ns: int) -> None:
        """Authorize a valid write of the items of `Writers` from `begin` to before `end`; ns, monotonic clock.

        Raises:
            ModbusError: 06 another controller holds the lease, or another connection of this one writes the same; 01
                the client is read-only.
        """
        if self._writers.rewrite(client, begin, end, now_ns):
            return
        refusal = self.authorize(client, begin, end, now_ns)
        if refusal is not None:
            self.deny(client, refusal, now_ns)
        if self.lease.holder not in (None, client.controller):
            self._release_lease(f"the watchdog has tripped, and {client.label} writes")
        if self.lease.holder is None:
            self._acquire_lease(client, now_ns)
        self._writers.record(client, begin, end, now_ns)
        client.writes = True
        self._last_writer = client

    def deny(self, client: Client, refusal: Refusal, now_ns: int) -> NoReturn:
        """Report a refused write, rate-limited; ns, monotonic clock.

        Raises:
            ModbusError: always, with the code of the refusal.
        """
        self._lease_events.lease_denied(client, refusal, now_ns)
        raise ModbusError(refusal.code)

    def permit(self, names: AbstractSet[str] | None) -> None:
        """Set the certificates (names) whose clients may write; None: all clients. Others lose the lease at once."""
        self._permitted = names
        holder = self.lease.holder
        if holder is not None and not any(self.may_write(client) for client in holder.clients):
            self._release_lease("it may no longer write to the rig ([edge.tls.clients])")

    def owner_denial(self, client: Client) -> str:
        """Return why a client may not write because the rig has another owner, or none yet; empty: it may."""
        return self._ownership.denial(client, reserved=client is self._reserved_for)

    def owner_changed(self, reason: str) -> None:
        """Set the torque to zero and end lease and session, if they are those of another owner."""
        session = self._session.current
        if session is not None and session.student != self._ownership.student:
            self._commands.zero()
            self._release_lease(reason)
            self._end_session(reason)

    def may_write(self, client: Client) -> bool:
        """Return whether a client may write if the rig is free: by the role and the name in its certificate."""
        is_permitted = self._permitted is None or client.certificate in self._permitted or client is self._reserved_for
        return client.may_write and is_permitted

    def authorize(self, client: Client, begin: int, end: int, now_ns: int) -> Refusal | None:
        """Return why a client may not write to the rig now; None: it may. The only place of these reasons.

        Args:
            client: connection that writes; its controller is that of `controller_of`.
            begin: first item of `Writers` that it writes.
            end: item after the last one.
            now_ns: time, ns, monotonic clock.
        """
        if not client.may_write:
            return Refusal(
                "read-only",
                "read-only: the client certificate lacks the role operator; use a certificate with that role",
                ExcCodes.ILLEGAL_FUNCTION,
            )
        reserved_for = self._reserved_for
        if reserved_for not in (None, client):
            return Refusal(
                "reserved",
                f"the edge is a client of {reserved_for.address}, which alone commands {self._rig}; to write to the "
                "rig, remove its controller from lab.toml",
                ExcCodes.DEVICE_BUSY,
                reserved_for.address,
            )
        if not self.may_write(client):
            return Refusal("not listed", self._not_listed(client), ExcCodes.ILLEGAL_FUNCTION)
        if denial := self.owner_denial(client):
            return Refusal("owner", denial, ExcCodes.DEVICE_BUSY, student=self._ownership.student)
        if now_ns < client.lease_cooldown_until_ns:
            wait_s = (client.lease_cooldown_until_ns - now_ns) / 1e9
            return Refusal("revoked", f"its lease was revoked; write again in {wait_s:.1f} s", ExcCodes.DEVICE_BUSY)
        since_ns = now_ns - (self.watchdog.timeout_ns or self.lease.timeout_ns)
        if self.lease.holder not in (None, client.controller) and not (
            # On an impaired link the watchdog trips although the holder writes.
            self.watchdog.tripped and self._writers.other(client, 0, ITEMS, since_ns) is None
        ):
            return Refusal(
                "lease",
                f"{self._last_writer_label} holds the lease; stop that client, or run: "
                f"hilrig lease {self._rig} --release",
                ExcCodes.DEVICE_BUSY,
                self._holder,
            )
        other = self._writers.other(client, begin, end, since_ns)
        if other is not None:
            written = "torques" if begin < MAGNET else "the same coil" if begin < EXTENDED else "the same register"
            return Refusal(
                "two programs",
                f"two programs on {client.controller.name} write {written}, the other one is {other.address}: stop one",
                ExcCodes.DEVICE_BUSY,
                other.address,
            )
        session = self._session.current
        if session is not None and session.controller is not client.controller and now_ns < self._controller_change_ns:
            return Refusal(
                "new lease",
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
            verb = "writes" if self._reserved_for is None else "answers"
            text = f"watchdog of {self._rig} re-armed: {client.label} {verb} again"
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
        """Release the lease if no connection that wrote is left; its torque stays applied until the watchdog trips."""
        self._writers.remove(client)
        if client.writes and not any(other.writes for other in client.controller.clients):
            self._release_lease(reason, disconnected=True)

    def check(self, now_ns: int) -> None:
        """Do everything that is due: watchdog trip, lease expiry, end of the session; ns, monotonic clock."""
        silent_ns = self.watchdog.check(now_ns)
        if silent_ns:
            self._trip(silent_ns, now_ns)
        self._lease_events.check(now_ns)
        self.stalls.check(now_ns)
        if self.lease.expired(now_ns):
            self._release_lease(self._lease_end())
        session = self._session.current
        if session is not None and session.expired(now_ns, self._settings.grace_ns):
            self._end_session(
                "no lease holder for the grace time (edge.session_grace_ms)"
                if self._reserved_for is None
                else f"{self._lease_end()} (edge.session_grace_ms)"
            )

    def release(self, reason: str) -> str:
        """Revoke the lease, on request of an operator; return the previous holder, empty: none.

        For the lease timeout the open connections of that controller cannot acquire it again. Otherwise their next
        write would do so before any other client could.
        """
        controller, address = self.lease.holder, self._holder
        if controller is not None:
            for client in controller.clients:
                client.lease_cooldown_until_ns = self._monotonic_ns() + self._settings.lease_ns
            self._release_lease(reason)
        return address

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
            client_of="" if self._reserved_for is None else self._reserved_for.address,
            controller_fault="" if self._reserved_for is None else self._reserved_for.fault,
            skipped_states=0 if self._reserved_for is None else self._reserved_for.skipped_states,
            student=self._ownership.student,
            claimed_from=self._ownership.claimed_from,
        )

    @property
    def _holder(self) -> str:
        """Address of the newest writing connection of the lease holder; empty: none."""
        return "" if self.lease.holder is None or self._last_writer is None else self._last_writer.address

    @property
    def _last_writer_label(self) -> str:
        return "" if self._last_writer is None else self._last_writer.label

    def _not_listed(self, client: Client) -> str:
        """Reason why a client may only read, because [edge.tls.clients] does not permit it."""
        if not client.certificate:
            return (
                "read-only: lab.toml has [edge.tls.clients], so writing needs a certificate; connect to the TLS port "
                "with one that is listed there"
            )
        return (
            f"read-only: [edge.tls.clients] does not list {self._rig} for {client.certificate}; add it in lab.toml, "
            "then send SIGHUP to the edge"
        )

    def _acquire_lease(self, client: Client, now_ns: int) -> None:
        session = self._session.current
        if session is not None and session.controller is not client.controller:
            self._controller_change_ns = now_ns + CONTROLLER_CHANGE_PERIOD_NS
            self._end_session(f"{client.label} acquired the lease")
        self.lease.acquire(client.controller)
        self._start_or_continue_session(client)
        self._lease_events.lease_acquired(client, now_ns)

    def _release_lease(self, reason: str, *, disconnected: bool = False) -> None:
        controller = self.lease.release()
        if controller is None:
            return
        self._writers.clear()
        self._commands.is_reset_requested = False
        for client in controller.clients:
            client.writes = False
        if self._session.current is not None:
            self._session.current.released_ns = self._monotonic_ns()
        if not self._commands.has_torque:
            # There is no torque to stop.
            self.watchdog.disarm()
        if self._last_writer is not None:
            self._lease_events.lease_released(self._last_writer, reason, disconnected=disconnected)

    def _start_or_continue_session(self, client: Client) -> None:
        if self._session.current is not None:
            self._session.current.released_ns = None
            return
        self._lease_events.flush_denials()
        self._session_count += 1
        wall_ns = self._wall_ns()
        student = self._ownership.student
        identity = session_id(self._rig, wall_ns, self._rng, student)
        number = self._session_count
        self._session.current = Session(
            self._rig, identity, number, client.address, client.certificate, client.controller, wall_ns, student
        )
        # What another connection read before the session is no basis in it: it may have been another program.
        client.controller.clear_served()
        # Watchdog timeout and echo value were written by the client of the previous session: restore the defaults.
        self.watchdog.timeout_ns = self._settings.watchdog_ns
        self._commands.echo = 0
        text, reason = f"session {identity} started by {client.label}", "lease acquired"
        if self._reserved_for is not None:
            text, reason = (
                f"session {identity} started as client of {client.address}",
                "torques read from the controller",
            )
        if self._session_note:
            text, reason = f"{text}: {self._session_note}", f"{reason}: {self._session_note}"
        event = self._events.event(Event.SESSION_START, Event.INFO, text)
        event.session_data.controller = client.address
        event.session_data.certificate = client.certificate
        event.session_data.student = student
        event.session_data.reason = reason
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
        self._lease_events.flush_denials()
        event = self._events.event(Event.SESSION_END, Event.INFO, f"session {session.id} ended: {reason}")
        event.session_data.controller = session.address
        event.session_data.certificate = session.certificate
        event.session_data.student = session.student
        event.session_data.reason = reason
        # This command tells the simulation that the session has ended. It is a new one, because it has no session.
        self._session.current = None
        self._commands.publish_internal()
        self._events.emit(event)
        self._output.sessions_changed()

    def _trip(self, silent_ns: int, now_ns: int) -> None:
        self._commands.zero()
        self._commands.publish_internal()
        holder, writer = self.lease.holder, self._last_writer_label
        missing, rearming = "write", "write"
        if self._reserved_for is not None:
            missing, rearming = "torque of its program", "one"
            cause = self._reserved_for.fault or f"no new state was written to {self._reserved_for.address}"
        elif holder is None:
            cause = f"{writer} no longer holds the lease"
        elif (quiet_ns := now_ns - holder.last_request_ns) >= self.watchdog.timeout_ns // 2:
            # It may have been unplugged after a read.
            cause = f"no request from {writer} for {quiet_ns / 1e9:.1f} s"
        else:
            cause = f"{writer} reads but does not write"
        text = (
            f"watchdog of {self._rig} tripped: no {missing} for {silent_ns // MS} ms, torque set to zero: {cause}; "
            f"the next {rearming} re-arms it"
        )
        event = self._events.event(Event.WATCHDOG_TRIP, Event.WARNING, text)
        event.watchdog_data.silent_ns = silent_ns
        event.watchdog_data.timeout_ns = self.watchdog.timeout_ns
        self._events.emit(event)

    def _lease_end(self) -> str:
        """Reason for the end of the lease after its timeout."""
        client = self._reserved_for
        if client is None:
            return f"no request for {self._settings.lease_ns / 1e9:g} s (edge.lease_timeout_ms)"
        silent_s = (self._monotonic_ns() - client.last_request_ns) / 1e9
        return f"no new torque was read for {silent_s:.1f} s: {client.fault or 'its requests take longer'}"

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
