"""One rig as a Modbus device: what a request reads, and what it writes.

Pure but for a clock and an outlet that are passed in. A read shows one state of the simulation, whole: the newest
one, fetched when the read is executed. A write goes out as one `TorqueCommand` before the answer does. Whoever runs
a device calls `check` every few milliseconds, and at the deadline that `Outlet.watch` was told.
"""

import random
from collections.abc import Callable
from typing import Final

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.device.client import Client, Host, address_of
from hilrig_modbus_edge.device.command_publisher import Commander
from hilrig_modbus_edge.device.events import Journal, times
from hilrig_modbus_edge.device.session import Session
from hilrig_modbus_edge.device.settings import MS, DeviceSettings, Outlet
from hilrig_modbus_edge.device.watchdog import WatchdogState
from hilrig_modbus_edge.device.write_access import Tenure
from hilrig_modbus_edge.impairment.controller import ImpairedLoop
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_modbus_edge.registers import map as registers
from hilrig_modbus_edge.registers.image import StateImage
from hilrig_modbus_edge.registers.map import PAPER_END, POSITION, Status, Table
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import Event, LeaseStatus

# A name in an enumeration is looked up by a function; what each request asks for is looked up once.
_INPUT_REGISTER: Final = Table.INPUT_REGISTER
HOSTS_KEPT: Final = 64
"""Hosts remembered though they have no connection now."""


class Device:
    """See the module. Not thread-safe: one thread owns it."""

    def __init__(
        self,
        rig: str,
        settings: DeviceSettings,
        clock: Clock,
        outlet: Outlet,
        newest_state: Callable[[], TimestampedPayload | None],
        letters: random.Random | None = None,
    ) -> None:
        self.rig = rig
        self.clients: set[Client] = set()
        self._hosts: dict[str, Host] = {}
        self._monotonic_ns = clock.monotonic_ns
        self._state = StateImage()
        self._journal = Journal(rig, outlet)
        self._commander = Commander(rig, clock, outlet, settings.repeat_ns)
        self.impaired = ImpairedLoop(
            rig, settings.impairment, clock, outlet, self._commander, self._journal, newest_state
        )
        begin_session = self.impaired.begin_session
        self._tenure = Tenure(rig, settings, clock, outlet, self._commander, self._journal, letters, begin_session)
        self.lease = self._tenure.lease
        self.watchdog = self._tenure.watchdog

    @property
    def session(self) -> Session | None:
        """The session that is open."""
        return self._tenure.session

    # -- connections

    def connect(self, host: str, port: int, *, may_write: bool = True) -> Client:
        """A controller connected."""
        known = self._hosts.setdefault(host, Host(host))
        client = Client(address_of(host, port), known, may_write, last_request_ns=self._monotonic_ns())
        known.clients.add(client)
        self.clients.add(client)
        return client

    def disconnect(self, client: Client, reason: str) -> None:
        """A controller's connection ended; its lease ends with it, its torque stands until the watchdog trips."""
        if client not in self.clients:
            return
        self.clients.remove(client)
        client.host.clients.remove(client)
        self._tenure.disconnected(client, reason)
        # Within a session, what a host was served stays the basis of its next connection: a chain of one-shot commands
        # is one loop.
        if len(self._hosts) > HOSTS_KEPT:
            self._hosts = {address: host for address, host in self._hosts.items() if host.clients}

    def connection_refused(self, address: str, reason: str, count: int) -> None:
        """A controller was not let in, `count` times since this was last said."""
        text = f"{address} may not connect to {self.rig}: {reason}{times(count)}"
        self._journal.tell_of_controller(Event.CONNECTION_REFUSED, Event.WARNING, text, address, reason=reason)

    def connections_of(self, host: str) -> int:
        """How many connections a host has."""
        return len(self._hosts[host].clients) if host in self._hosts else 0

    # -- reads

    def read_registers(self, client: Client, table: Table, address: int, count: int) -> bytes:
        """Registers as they go into an answer, big-endian.

        Raises:
            ModbusError: 02 where there is no such register, 04 where no state has come yet.
        """
        end = address + count
        if table is _INPUT_REGISTER:
            if end > registers.INPUT_END:
                raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
            return self._input_image(client)[2 * address : 2 * end]
        if end <= POSITION:
            return bytes(self._commander.torque[2 * address : 2 * end])
        if end <= PAPER_END:
            positions = self._show(client).position_words
            if address >= POSITION:
                return positions[2 * (address - POSITION) : 2 * (end - POSITION)]
            return bytes(self._commander.torque[2 * address :]) + positions[: 2 * (end - POSITION)]
        if address >= registers.ECHO and end <= registers.EXTENDED_END:
            image = self._commander.echo.to_bytes(2, "big") + (self.watchdog.timeout_ns // MS).to_bytes(2, "big")
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
            return int(self._commander.magnet)
        if count == 1 and address == registers.RESET:
            return 0
        raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)

    def check_readable(self, address: int, count: int) -> None:
        """Nothing, if these holding registers can be read now.

        Raises:
            ModbusError: 02 where there is no such register, 04 where no state has come yet.
        """
        end = address + count
        if end > PAPER_END and not (address >= registers.ECHO and end <= registers.EXTENDED_END):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
        if POSITION < end <= PAPER_END and self._look().arrival is None:
            raise ModbusError(ExcCodes.DEVICE_FAILURE)

    # -- writes

    def check_writable(self, address: int, count: int) -> None:
        """Nothing, if a controller may write all of these holding registers.

        Raises:
            ModbusError: 02 otherwise.
        """
        end = address + count
        if end > POSITION and not (address >= registers.ECHO and end <= registers.EXTENDED_END):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)

    def write_registers(self, client: Client, address: int, words: bytes, arrived_ns: int) -> None:
        """Write holding registers, all of them or none; torques go out at once.

        Raises:
            ModbusError: 02 where one is not the controller's to write, 04 a time-out outside the lab's bounds,
                06 another controller holds the rig, 01 this one may only read.
        """
        end = address + len(words) // 2
        if end <= POSITION:
            fed_ns = self.watchdog.fed_ns
            self._tenure.accept(client, arrived_ns)
            self._commander.torque[2 * address : 2 * end] = words
            if not self._commander.write(client, arrived_ns):
                self._tenure.lost(fed_ns)
            return
        self.check_writable(address, len(words) // 2)
        timeout_ns = self.watchdog.timeout_ns
        if end == registers.EXTENDED_END:
            timeout_ns = int.from_bytes(words[-2:], "big") * MS
            self._tenure.check_timeout(timeout_ns)
        self._tenure.accept(client, arrived_ns)
        if address == registers.ECHO:
            self._commander.echo = int.from_bytes(words[:2], "big")
        self._tenure.set_timeout(timeout_ns)
        self._commander.say_session()

    def write_coil(self, client: Client, address: int, on: bool, arrived_ns: int) -> None:
        """Switch the magnet, or reset the rig.

        Raises:
            ModbusError: as `write_registers`.
        """
        if address not in (registers.MAGNET, registers.RESET):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
        fed_ns = self.watchdog.fed_ns
        self._tenure.accept(client, arrived_ns)
        if address == registers.MAGNET:
            self._commander.magnet = on
        elif on:
            self._commander.reset()
        else:
            self._commander.say_session()
            return
        if not self._commander.write(client, arrived_ns):
            self._tenure.lost(fed_ns)

    # -- time

    def check(self, now_ns: int) -> None:
        """Do what has become due: trip, lose the lease, end the session, repeat the command; ns, monotonic clock."""
        self._tenure.check(now_ns)
        self._commander.repeat_if_due(now_ns)
        self.impaired.check(now_ns)

    def send_due(self, now_ns: int) -> None:
        """Send the commands that have come to the end of an impaired way; ns, monotonic clock."""
        self._commander.send_due(now_ns)

    def begin(self) -> None:
        """Say the first word: no torque; and impair the loop, where the lab says so."""
        self._commander.say()
        self.impaired.begin()

    def shut(self, reason: str) -> None:
        """The edge stops: no torque, no lease, no session."""
        self._tenure.shut(reason)

    @property
    def has_state(self) -> bool:
        """Whether a state has come, so that positions can be read."""
        return self._look().arrival is not None

    def look(self) -> None:
        """See the newest state without showing it to anyone, so that what is said of the last one stays true."""
        self._look()

    # -- the teacher

    def release(self, reason: str) -> str:
        """Take the rig from its controller: who held it; empty: nobody. See `Tenure.release`."""
        return self._tenure.release(reason)

    def reset(self) -> None:
        """Put the arm back to its start pose, without torque; the controller that holds it goes on from there."""
        self._commander.reset()
        self._commander.say()

    def lease_status(self) -> LeaseStatus:
        """How the lease and the watchdog stand."""
        status = self._tenure.status()
        status.connections = len(self.clients)
        return status

    # -- inside

    def _look(self) -> StateImage:
        arrival = self.impaired.newest_state()
        state = self._state
        if arrival is not state.arrival and arrival is not None:
            state.take(arrival)
            self._journal.step = state.step
        return state

    def _show(self, client: Client) -> StateImage:
        state = self._look()
        if state.arrival is None:
            raise ModbusError(ExcCodes.DEVICE_FAILURE)
        # Stamped after the look at the bus: a state is never shown before it came.
        client.shown((state.basis, self._monotonic_ns()))
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
