"""One rig as a Modbus device: its registers, its lease, its watchdog, its session.

Pure but for a clock and an outlet that are passed in. A read shows one state of the simulation, whole: the newest
one, fetched when the read is executed. A write goes out as one `TorqueCommand` before the answer does. Whoever runs
a device calls `check` when `due_ns` says so.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge import codec, registers
from hilrig_modbus_edge.client import NO_BASIS, Client, Host, Served, address_of
from hilrig_modbus_edge.image import StateImage
from hilrig_modbus_edge.lease import Lease
from hilrig_modbus_edge.registers import Status, Table
from hilrig_modbus_edge.session import Session, session_id
from hilrig_modbus_edge.throttle import Throttle
from hilrig_modbus_edge.watchdog import Watchdog, WatchdogState
from hilrig_runtime.clock import Clock
from hilrig_runtime.config import EdgeConfig
from hilrig_runtime.service import Arrival
from hilrig_schemas import Event, LeaseStatus, TorqueCommand

MS: Final = 1_000_000
REFUSAL_PERIOD_NS: Final = 1_000 * MS
"""A client whose writes are refused is told of once in so long."""


HOSTS_KEPT: Final = 64
_OF_A_WRITE: Final = (
    "controller",
    "basis_incarnation",
    "basis_step",
    "state_arrived_ns",
    "state_served_ns",
    "state_injected_ns",
    "write_arrived_ns",
)


class ModbusError(Exception):
    """A request that gets an exception response."""

    def __init__(self, code: ExcCodes) -> None:
        super().__init__(f"exception {code:02X}, {code.name}")
        self.code = code


class Outlet(Protocol):
    """Where a device's words go."""

    def send_command(self, command: TorqueCommand) -> None:
        """A new command; the message is reused after the call."""

    def repeat_command(self, command: TorqueCommand) -> None:
        """The standing command again, for those who wait to hear that it still holds."""

    def emit(self, event: Event) -> None:
        """Something happened."""

    def sessions_changed(self) -> None:
        """A session began or ended."""

    def watch(self, deadline_ns: int) -> None:
        """The watchdog began to watch: `check` must be called at the deadline."""


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """What a lab says of its devices, in nanoseconds."""

    watchdog_ns: int = 1_000 * MS
    watchdog_min_ns: int = 100 * MS
    watchdog_max_ns: int = 10_000 * MS
    lease_ns: int = 5_000 * MS
    grace_ns: int = 5_000 * MS
    repeat_ns: int = 200 * MS

    @classmethod
    def of(cls, edge: EdgeConfig) -> "DeviceSettings":
        """As configured."""
        return cls(
            watchdog_ns=round(edge.watchdog_ms * MS),
            watchdog_min_ns=round(edge.watchdog_min_ms * MS),
            watchdog_max_ns=round(edge.watchdog_max_ms * MS),
            lease_ns=round(edge.lease_timeout_ms * MS),
            grace_ns=round(edge.session_grace_ms * MS),
            repeat_ns=round(edge.repeat_ms * MS),
        )


class Device:
    """See the module. Not thread-safe: one thread owns it."""

    def __init__(
        self,
        rig: str,
        settings: DeviceSettings,
        clock: Clock,
        outlet: Outlet,
        newest_state: Callable[[], Arrival | None],
        letters: random.Random | None = None,
    ) -> None:
        self.rig = rig
        self.settings = settings
        self.lease: Lease[Client] = Lease(settings.lease_ns)
        self.watchdog = Watchdog(settings.watchdog_ns)
        self.session: Session | None = None
        self.clients: set[Client] = set()
        self._hosts: dict[str, Host] = {}
        self._clock = clock
        self._monotonic_ns = clock.monotonic_ns
        self._outlet = outlet
        self._newest_state = newest_state
        self._state = StateImage()
        self._throttle = Throttle(REFUSAL_PERIOD_NS)
        self._letters = random.SystemRandom() if letters is None else letters
        self._session_count = 0
        self._torque = bytearray(8)
        self._echo = 0
        self._last_writer = ""
        self._session_told = ""
        # Whose word the command is and what it was based on: most writes change neither.
        self._commander: Client | None = None
        self._basis: Served | None = None
        self._repeat_due_ns = clock.monotonic_ns()
        self._command = TorqueCommand(rig=rig, effort=(0.0, 0.0, 0.0, 0.0), safe=True)

    # -- connections

    def connect(self, host: str, port: int, *, may_write: bool = True) -> Client:
        """A controller connected."""
        known = self._hosts.setdefault(host, Host(host))
        known.connections += 1
        client = Client(address_of(host, port), known, may_write, last_request_ns=self._monotonic_ns())
        self.clients.add(client)
        return client

    def disconnect(self, client: Client, reason: str) -> None:
        """A controller's connection ended; its lease ends with it, its torque stands until the watchdog trips."""
        if client not in self.clients:
            return
        self.clients.remove(client)
        client.host.connections -= 1
        if self.lease.holder is client:
            self._lose_lease(reason)
        # What a host was shown stays the basis of its next connection: a chain of one-shot commands is one loop.
        if len(self._hosts) > HOSTS_KEPT:
            self._hosts = {address: host for address, host in self._hosts.items() if host.connections}

    def connection_refused(self, address: str, reason: str, times: int) -> None:
        """A controller was not let in, `times` times since this was last said."""
        text = f"{address} may not connect to {self.rig}: {reason}{_times(times)}"
        self._emit(Event.CONNECTION_REFUSED, Event.WARNING, text, address, reason)

    def connections_of(self, host: str) -> int:
        """How many connections a host has."""
        return self._hosts[host].connections if host in self._hosts else 0

    # -- reads

    def read_registers(self, client: Client, table: Table, address: int, count: int) -> bytes:
        """Registers as they go into an answer, big-endian.

        Raises:
            ModbusError: 02 where there is no such register, 04 where no state has come yet.
        """
        end = address + count
        if table is Table.INPUT_REGISTER:
            if end > registers.INPUT_END:
                raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
            return self._input_image(client)[2 * address : 2 * end]
        if end <= registers.POSITION:
            return bytes(self._torque[2 * address : 2 * end])
        if end <= registers.PAPER_END:
            positions = self._show(client).position_words
            return (bytes(self._torque) + positions)[2 * address : 2 * end]
        if address >= registers.ECHO and end <= registers.EXTENDED_END:
            image = self._echo.to_bytes(2, "big") + (self.watchdog.timeout_ns // MS).to_bytes(2, "big")
            return image[2 * (address - registers.ECHO) : 2 * (end - registers.ECHO)]
        raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)

    def read_bits(self, client: Client, table: Table, address: int, count: int) -> int:
        """Bits as a number, the first one least significant.

        Raises:
            ModbusError: 02 where there is no such bit.
        """
        if table is Table.DISCRETE_INPUT:
            if address + count > registers.DISCRETE_END:
                raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
            self._look()
            return (self._status(client) >> address) & ((1 << count) - 1)
        if count == 1 and address == registers.MAGNET:
            return int(self._command.magnet)
        if count == 1 and address == registers.RESET:
            return 0
        raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)

    def check_readable(self, address: int, count: int) -> None:
        """Nothing, if these holding registers can be read now.

        Raises:
            ModbusError: 02 where there is no such register, 04 where no state has come yet.
        """
        end = address + count
        if end > registers.PAPER_END and not (address >= registers.ECHO and end <= registers.EXTENDED_END):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
        if registers.POSITION < end <= registers.PAPER_END and self._look().arrival is None:
            raise ModbusError(ExcCodes.DEVICE_FAILURE)

    # -- writes

    def check_writable(self, address: int, count: int) -> None:
        """Nothing, if a controller may write all of these holding registers.

        Raises:
            ModbusError: 02 otherwise.
        """
        end = address + count
        if end > registers.POSITION and not (address >= registers.ECHO and end <= registers.EXTENDED_END):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)

    def write_registers(self, client: Client, address: int, words: bytes, arrived_ns: int) -> None:
        """Write holding registers, all of them or none; torques go out at once.

        Raises:
            ModbusError: 02 where one is not the controller's to write, 04 a time-out outside the lab's bounds,
                06 another controller holds the rig, 01 this one may only read.
        """
        end = address + len(words) // 2
        if end <= registers.POSITION:
            self._accept(client, arrived_ns)
            self._torque[2 * address : 2 * end] = words
            self._write_command(client, arrived_ns)
            return
        self.check_writable(address, len(words) // 2)
        timeout_ns = self.watchdog.timeout_ns
        if end == registers.EXTENDED_END:
            timeout_ns = int.from_bytes(words[-2:], "big") * MS
            self._check_timeout(timeout_ns)
        self._accept(client, arrived_ns)
        if address == registers.ECHO:
            self._echo = int.from_bytes(words[:2], "big")
        self.watchdog.timeout_ns = timeout_ns
        self._rewatch()
        self._tell_session()

    def write_coil(self, client: Client, address: int, on: bool, arrived_ns: int) -> None:
        """Switch the magnet, or reset the rig.

        Raises:
            ModbusError: as `write_registers`.
        """
        if address not in (registers.MAGNET, registers.RESET):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
        self._accept(client, arrived_ns)
        if address == registers.MAGNET:
            self._command.magnet = on
        elif on:
            self._torque[:] = bytes(8)
            self._command.resets += 1
        else:
            self._tell_session()
            return
        self._write_command(client, arrived_ns)

    # -- time

    def check(self, now_ns: int) -> None:
        """Do what has become due: trip, lose the lease, end the session, repeat the command; ns, monotonic clock."""
        silent_ns = self.watchdog.check(now_ns)
        if silent_ns:
            self._trip(silent_ns, now_ns)
        if self.lease.expired(now_ns):
            self._lose_lease(f"no request for {self.settings.lease_ns / 1e9:g} s")
        if self.session is not None and self.session.over(now_ns, self.settings.grace_ns):
            self._end_session("the controller is gone")
        if now_ns >= self._repeat_due_ns:
            self._repeat_due_ns = now_ns + self.settings.repeat_ns
            self._outlet.repeat_command(self._command)

    def begin(self) -> None:
        """Say the first word: no torque."""
        self._send_own_command()

    @property
    def has_state(self) -> bool:
        """Whether a state has come, so that positions can be read."""
        return self._look().arrival is not None

    def look(self) -> None:
        """See the newest state without showing it to anyone, so that what is said of the last one stays true."""
        self._look()

    def shut(self, reason: str) -> None:
        """The edge stops: no torque, no lease, no session."""
        if self.lease.holder is not None:
            self._lose_lease(reason)
        self.watchdog.rest()
        self._torque[:] = bytes(8)
        if self.session is not None:
            self._end_session(reason)
        else:
            self._send_own_command()

    def release(self, reason: str) -> str:
        """Take the rig from its controller, for the teacher: who held it; empty: nobody.

        For the lease's time-out that connection does not get it back: others could not be faster than its next write.
        """
        holder = self.lease.holder
        if holder is None:
            return ""
        holder.barred_until_ns = self._monotonic_ns() + self.settings.lease_ns
        self._lose_lease(reason)
        return holder.address

    def lease_status(self) -> LeaseStatus:
        """How the lease stands."""
        holder = self.lease.holder
        return LeaseStatus(
            rig=self.rig,
            holder="" if holder is None else holder.address,
            silent_ns=0 if holder is None else self._monotonic_ns() - holder.last_request_ns,
            session="" if self.session is None else self.session.id,
            connections=len(self.clients),
            watchdog_tripped=self.watchdog.tripped,
            watchdog_timeout_ns=self.watchdog.timeout_ns,
        )

    # -- inside

    def _accept(self, client: Client, now_ns: int) -> None:
        if not client.may_write:
            self._refuse(client, now_ns, "its certificate lets it read only", ExcCodes.ILLEGAL_FUNCTION)
        if self.lease.holder is not client:
            if now_ns < client.barred_until_ns:
                self._refuse(client, now_ns, "the rig was taken from it", ExcCodes.DEVICE_BUSY)
            if not self.lease.take(client):
                self._refuse(client, now_ns, "another controller holds the rig", ExcCodes.DEVICE_BUSY)
            self._open_session(client)
            self._emit(Event.LEASE_GRANTED, Event.INFO, f"{client.address} holds {self.rig}", client.address)
            self._last_writer = client.address
        watchdog = self.watchdog
        if watchdog.fed_ns is not None:
            watchdog.fed_ns = now_ns
            return
        if watchdog.feed(now_ns):
            text = f"{client.address} writes again: the watchdog is armed"
            event = self._event(Event.WATCHDOG_REARM, Event.INFO, text)
            event.watchdog_data.timeout_ns = watchdog.timeout_ns
            self._outlet.emit(event)
        self._rewatch()

    def _rewatch(self) -> None:
        deadline_ns = self.watchdog.deadline_ns
        if deadline_ns is not None:
            self._outlet.watch(deadline_ns)

    def _refuse(self, client: Client, now_ns: int, reason: str, code: ExcCodes) -> None:
        times = self._throttle.count(client, now_ns)
        if times:
            text = f"{client.address} may not write to {self.rig}: {reason}{_times(times)}"
            self._emit(Event.LEASE_REFUSED, Event.WARNING, text, client.address, reason)
        raise ModbusError(code)

    def _lose_lease(self, reason: str) -> None:
        holder = self.lease.release()
        if holder is None:
            return
        if self.session is not None:
            self.session.gone_ns = self._monotonic_ns()
        if not any(self._torque):
            self.watchdog.rest()
        self._emit(
            Event.LEASE_LOST, Event.INFO, f"{holder.address} holds {self.rig} no more: {reason}", holder.address, reason
        )

    def _open_session(self, client: Client) -> None:
        if self.session is not None and self.session.host == client.host.address:
            self.session.gone_ns = None
            return
        if self.session is not None:
            self._end_session(f"{client.address} took the rig")
        self._session_count += 1
        wall_ns = self._clock.wall_ns()
        self.session = Session(
            self.rig,
            session_id(self.rig, wall_ns, self._letters),
            self._session_count,
            client.address,
            client.host.address,
            wall_ns,
        )
        self._command.session = self.session.id
        self.watchdog.timeout_ns = self.settings.watchdog_ns
        event = self._event(Event.SESSION_START, Event.INFO, f"session {self.session.id} of {client.address}")
        event.session_data.controller = client.address
        event.session_data.reason = "a controller took the rig"
        self._outlet.emit(event)
        self._outlet.sessions_changed()

    def _end_session(self, reason: str) -> None:
        session = self.session
        if session is None:
            return
        event = self._event(Event.SESSION_END, Event.INFO, f"session {session.id} is over: {reason}")
        event.session_data.controller = session.controller
        event.session_data.reason = reason
        self.session = None
        self._command.session = ""
        # The simulation learns from a command that the session is over; it is new, for it belongs to no session.
        self._send_own_command()
        self._outlet.emit(event)
        self._outlet.sessions_changed()

    def _trip(self, silent_ns: int, now_ns: int) -> None:
        self._torque[:] = bytes(8)
        self._send_own_command()
        holder, silent_ms = self.lease.holder, silent_ns // MS
        if holder is None:
            why = f"{self._last_writer} is gone"
        elif now_ns - holder.last_request_ns >= self.watchdog.timeout_ns:
            why = f"{holder.address} is silent"
        else:
            why = f"{holder.address} reads but does not write"
        event = self._event(Event.WATCHDOG_TRIP, Event.WARNING, f"torque to zero: {why}, no write for {silent_ms} ms")
        event.watchdog_data.silent_ns = silent_ns
        event.watchdog_data.timeout_ns = self.watchdog.timeout_ns
        self._outlet.emit(event)

    def _check_timeout(self, timeout_ns: int) -> None:
        settings = self.settings
        if timeout_ns != settings.watchdog_ns and not (
            settings.watchdog_min_ns <= timeout_ns <= settings.watchdog_max_ns
        ):
            raise ModbusError(ExcCodes.DEVICE_FAILURE)

    def _write_command(self, client: Client, arrived_ns: int) -> None:
        command = self._command
        command.effort[:] = codec.effort_of(self._torque)
        command.seq += 1
        if client is not self._commander:
            self._commander = client
            command.controller = client.address
            command.safe = False
        command.echo = self._echo
        basis = client.basis
        if basis is not self._basis:
            self._basis = basis
            (
                command.basis_incarnation,
                command.basis_step,
                command.state_arrived_ns,
                command.state_served_ns,
                command.state_injected_ns,
            ) = basis or NO_BASIS
        command.write_arrived_ns = arrived_ns
        self._send()

    def _send_own_command(self) -> None:
        """The standing torques as a word of the edge's own, which no controller's loop is measured by."""
        command = self._command
        command.effort[:] = codec.effort_of(self._torque)
        command.seq += 1
        command.safe = not any(self._torque)
        for field in _OF_A_WRITE:
            command.ClearField(field)
        self._commander = self._basis = None
        self._send()

    def _tell_session(self) -> None:
        """A write that moved nothing may have begun a session: the simulation learns of it from a command."""
        if self._command.session != self._session_told:
            self._send_own_command()

    def _send(self) -> None:
        command = self._command
        now_ns = self._monotonic_ns()
        command.wall_ns = self._clock.wall_ns()
        command.sent_ns = now_ns
        self._repeat_due_ns = now_ns + self.settings.repeat_ns
        self._session_told = command.session
        self._outlet.send_command(command)

    def _look(self) -> StateImage:
        arrival = self._newest_state()
        state = self._state
        if arrival is not state.arrival and arrival is not None:
            state.take(arrival)
        return state

    def _show(self, client: Client) -> StateImage:
        state = self._look()
        if state.arrival is None:
            raise ModbusError(ExcCodes.DEVICE_FAILURE)
        # Stamped after the look at the bus: a state is never shown before it came.
        client.shown((state.incarnation, state.step, state.arrived_ns, self._monotonic_ns(), 0))
        return state

    def _input_image(self, client: Client) -> bytes:
        state = self._show(client)
        holder = self.lease.holder
        lease = 0 if holder is None else 1 if holder is client else 2
        return state.input_words(
            status=self._status(client),
            lease=lease,
            watchdog=self.watchdog.state,
            timeout_ms=self.watchdog.timeout_ns // MS,
            session=0 if self.session is None else self.session.number,
            age_ms=(self._monotonic_ns() - state.arrived_ns) // MS,
        )

    def _status(self, client: Client) -> int:
        status = self._state.status(self._monotonic_ns())
        if self.session is not None:
            status |= Status.SESSION_OPEN
        holder = self.lease.holder
        if holder is not None:
            status |= Status.LEASE_HELD
            if holder is client:
                status |= Status.LEASE_IS_YOURS
        if self.watchdog.timeout_ns:
            status |= Status.WATCHDOG_ON
        if self.watchdog.state is WatchdogState.TRIPPED:
            status |= Status.WATCHDOG_TRIPPED
        if not client.may_write:
            status |= Status.READ_ONLY
        return int(status)

    def _event(self, kind: Event.Kind, severity: Event.Severity, text: str) -> Event:
        session = "" if self.session is None else self.session.id
        return Event(rig=self.rig, session=session, kind=kind, severity=severity, text=text, step=self._state.step)

    def _emit(self, kind: Event.Kind, severity: Event.Severity, text: str, controller: str, reason: str = "") -> None:
        event = self._event(kind, severity, text)
        event.controller_data.controller = controller
        event.controller_data.reason = reason
        holder = self.lease.holder
        if holder is not None and holder.address != controller:
            event.controller_data.holder = holder.address
        self._outlet.emit(event)


def _times(count: int) -> str:
    return f" ({count} times)" if count > 1 else ""
