"""One rig as a Modbus device: serves reads from the newest state and publishes writes as commands.

The device does no I/O: clock and output port are passed in. A read shows one state of the simulation as a whole: the
newest one when the read is executed. A write is published as one `TorqueCommand` before its response is sent. The
owner calls `check` every few milliseconds; the device schedules its own deadlines with `DeviceOutput.call_at`.
"""

import random
from collections.abc import Set as AbstractSet
from typing import Final

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.device.client import (
    Client,
    ConnectedController,
    PollTimes,
    ServedState,
    controller_of,
)
from hilrig_modbus_edge.device.command_publisher import CommandPublisher
from hilrig_modbus_edge.device.command_sender import CommandSender
from hilrig_modbus_edge.device.events import STATE_TIMEOUT_NS, EventEmitter
from hilrig_modbus_edge.device.impairment_controller import ImpairmentController
from hilrig_modbus_edge.device.ports import DeviceOutput, NoOwner, Ownership
from hilrig_modbus_edge.device.session import Session, SessionState
from hilrig_modbus_edge.device.settings import MS, DeviceSettings
from hilrig_modbus_edge.device.state_reader import StateReader
from hilrig_modbus_edge.device.watchdog import WatchdogState
from hilrig_modbus_edge.device.write_access import WriteAccess
from hilrig_modbus_edge.device.writers import EXTENDED, MAGNET, RESET, TORQUES
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_modbus_edge.registers.image import StateImage
from hilrig_modbus_edge.registers.map import (
    DISCRETE_END,
    ECHO_ADDRESS,
    EXTENDED_END,
    INPUT_END,
    MAGNET_COIL,
    MIRROR_ADDRESS,
    MIRROR_END,
    PAPER_END,
    POSITION_ADDRESS,
    RESET_COIL,
    SWITCH_ADDRESS,
    SWITCH_END,
    TORQUE_ADDRESS,
    WATCHDOG_ADDRESS,
    Status,
    struct_of,
)
from hilrig_runtime.addresses import format_address
from hilrig_runtime.config.claim_codes import CLAIM_ADDRESS, CLAIM_REGISTERS
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.process.outage import OutageDetector
from hilrig_runtime.timing.clock import Clock
from hilrig_runtime.timing.rate_limiter import repeat_suffix
from hilrig_schemas import Event, LeaseStatus

# Looking up an enumeration member is a function call: the one that each request needs is looked up once.
_INPUT_REGISTER: Final = RegisterTable.INPUT_REGISTER
_HOLDING_REGISTER: Final = RegisterTable.HOLDING_REGISTER
_EXTENDED: Final = struct_of(_HOLDING_REGISTER, ECHO_ADDRESS, EXTENDED_END)
_SWITCHES: Final = struct_of(_HOLDING_REGISTER, SWITCH_ADDRESS, SWITCH_END)
_BLOCKS: Final = {
    _INPUT_REGISTER: ((0, INPUT_END),),
    _HOLDING_REGISTER: (
        (TORQUE_ADDRESS, PAPER_END),
        (ECHO_ADDRESS, EXTENDED_END),
        (MIRROR_ADDRESS, MIRROR_END),
        (SWITCH_ADDRESS, SWITCH_END),
    ),
    RegisterTable.COIL: ((MAGNET_COIL, MAGNET_COIL + 1), (RESET_COIL, RESET_COIL + 1)),
    RegisterTable.DISCRETE_INPUT: ((0, DISCRETE_END),),
}
"""By table: first address of each block without a gap, and the address after it."""
_ADDRESSES: Final = 0x10000
MAX_REMEMBERED_CONTROLLERS: Final = 64
"""Number of controllers above which those without a connection are removed."""


class Device:
    """Modbus device of one rig. Not thread-safe: one thread owns it."""

    def __init__(
        self,
        rig: str,
        settings: DeviceSettings,
        clock: Clock,
        output: DeviceOutput,
        states: LatestValueCache,
        sender: CommandSender,
        rng: random.Random | None = None,
        ownership: Ownership | None = None,
    ) -> None:
        self.rig = rig
        self._ownership: Ownership = NoOwner() if ownership is None else ownership
        self.clients: set[Client] = set()
        self._controllers: dict[str, ConnectedController] = {}
        self._lease_setting = settings.lease
        self._reads_gaps = settings.unmapped_reads == "zeros"
        self._monotonic_ns = clock.monotonic_ns
        self._wall_ns = clock.wall_ns
        self._state_outages = OutageDetector(STATE_TIMEOUT_NS)
        self._session = SessionState()
        self._states = StateReader(rig, clock, output, states)
        self._sender = sender
        self._events = EventEmitter(rig, output, self._session, self._states.image)
        self._commands = CommandPublisher(rig, clock, output, sender, self._session)
        self.impairment = ImpairmentController(
            rig, settings.impairment, clock, self._states, self._commands, self._events
        )
        self._write_access = WriteAccess(
            rig,
            settings,
            clock,
            output,
            self._commands,
            self.impairment,
            self._events,
            self._session,
            self.clients,
            self._ownership,
            rng,
        )
        self.lease = self._write_access.lease
        self.watchdog = self._write_access.watchdog

    @property
    def session(self) -> Session | None:
        """The open session; None: none is open."""
        return self._session.current

    # -- connections

    def connect(self, host: str, port: int, *, may_write: bool = True, certificate: str = "") -> Client:
        """Add a connection and return its client; `certificate`: the name in its certificate."""
        now_ns = self._monotonic_ns()
        client = Client(host, format_address(host, port), certificate, may_write, last_request_ns=now_ns)
        name = controller_of(client, self._lease_setting)
        client.controller = self._controllers.setdefault(name, ConnectedController(name))
        client.controller.clients.add(client)
        self.clients.add(client)
        return client

    def reserve(self, host: str, port: int, session_note: str) -> Client:
        """Reserve the rig for a controller that is a server, and return it as a client: no other one may write.

        Args:
            host: host of the controller.
            port: its port.
            session_note: added to the event of each session's start; empty: nothing.
        """
        client = self.connect(host, port)
        self._write_access.reserve(client, session_note)
        return client

    def disconnect(self, client: Client, reason: str) -> None:
        """Remove a connection and release its lease; its torque stays applied until the watchdog trips."""
        if client not in self.clients:
            return
        self.clients.remove(client)
        client.controller.clients.remove(client)
        self._write_access.on_disconnect(client, reason)
        # Within a session, the state that a controller was served stays the basis of its next connection: a sequence of
        # one-shot commands is one loop.
        if len(self._controllers) > MAX_REMEMBERED_CONTROLLERS:
            known = self._controllers.items()
            self._controllers = {
                name: one for name, one in known if one.clients or (self.session and one is self.session.controller)
            }

    def report_refused_connection(self, address: str, reason: str, count: int) -> None:
        """Emit an event for `count` refused connections of a host."""
        text = f"{address}: connection to {self.rig} refused: {reason}{repeat_suffix(count)}"
        self._events.emit_for_controller(Event.CONNECTION_REFUSED, Event.WARNING, text, address, reason=reason)

    def report_stall(self, late_ns: int, now_ns: int) -> None:
        """Report a tick of the edge that is late by more than its period, if a session is open; ns, monotonic clock."""
        if self.session is not None:
            self._write_access.stalls.record(late_ns, now_ns)

    def connections_of(self, host: str) -> int:
        """Return the number of connections of a host."""
        return sum(client.host == host for client in self.clients)

    # -- reads

    def read_registers(self, client: Client, table: RegisterTable, address: int, count: int) -> bytes:
        """Return registers as they are encoded in a response, big-endian.

        Raises:
            ModbusError: 02 a register does not exist, 04 no state was received yet.
        """
        end = address + count
        if table is _INPUT_REGISTER:
            if end <= INPUT_END:
                return self._input_image(client)[2 * address : 2 * end]
        elif end <= POSITION_ADDRESS:
            return bytes(self._commands.torque[2 * address : 2 * end])
        elif end <= PAPER_END:
            positions = self._serve_state(client).position_words
            if address >= POSITION_ADDRESS:
                return positions[2 * (address - POSITION_ADDRESS) : 2 * (end - POSITION_ADDRESS)]
            return bytes(self._commands.torque[2 * address :]) + positions[: 2 * (end - POSITION_ADDRESS)]
        self._check_exists(table, address, end)
        words = bytearray(2 * count)
        for begin, stop in _BLOCKS[table]:
            first, last = max(address, begin), min(end, stop)
            if first < last:
                block = self._read_block(client, table, begin)
                words[2 * (first - address) : 2 * (last - address)] = block[2 * (first - begin) : 2 * (last - begin)]
        return bytes(words)

    def read_bits(self, client: Client, table: RegisterTable, address: int, count: int) -> int:
        """Return bits as a number, the first one least significant.

        Raises:
            ModbusError: 02 a bit does not exist.
        """
        end = address + count
        self._check_exists(table, address, end)
        if table is RegisterTable.DISCRETE_INPUT:
            self._states.refresh()
            return (self._status(client) >> address) & ((1 << count) - 1)
        # The reset coil reads 0.
        return int(self._commands.magnet) << (MAGNET_COIL - address) if address <= MAGNET_COIL < end else 0

    def check_readable(self, address: int, count: int) -> None:
        """Check that holding registers can be read now.

        Raises:
            ModbusError: 02 a register does not exist, 04 no state was received yet.
        """
        end = address + count
        self._check_exists(_HOLDING_REGISTER, address, end)
        has_position = address < PAPER_END and end > POSITION_ADDRESS
        if (has_position or (address < MIRROR_END and end > MIRROR_ADDRESS)) and not self.has_state:
            raise ModbusError(ExcCodes.DEVICE_FAILURE)

    def _check_exists(self, table: RegisterTable, address: int, end: int) -> None:
        """Check that a block can be read: every address of it exists, or one does and others may be missing.

        Raises:
            ModbusError: 02 it can't.
        """
        existing = sum(max(0, min(end, stop) - max(address, begin)) for begin, stop in _BLOCKS[table])
        if existing < end - address and not (self._reads_gaps and existing and end <= _ADDRESSES):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)

    def _read_block(self, client: Client, table: RegisterTable, begin: int) -> bytes:
        """Return the registers of the block of `_BLOCKS` that begins at this address."""
        if table is _INPUT_REGISTER or begin == MIRROR_ADDRESS:
            return self._input_image(client)
        if begin == ECHO_ADDRESS:
            return _EXTENDED.pack(self._commands.echo, self.watchdog.timeout_ns // MS)
        if begin == SWITCH_ADDRESS:
            return _SWITCHES.pack(self._commands.magnet, self._commands.is_reset_requested)
        return bytes(self._commands.torque) + self._serve_state(client).position_words

    # -- writes

    def check_writable(self, address: int, count: int) -> None:
        """Check that a client may write all of these holding registers.

        Raises:
            ModbusError: 02 a register does not exist or is read-only.
        """
        end = address + count
        if (
            end > POSITION_ADDRESS
            and not (address >= ECHO_ADDRESS and end <= EXTENDED_END)
            and not (address >= SWITCH_ADDRESS and end <= SWITCH_END)
        ):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)

    def write_registers(
        self, client: Client, address: int, words: bytes, arrived_ns: int, received_ns: int = 0
    ) -> None:
        """Write holding registers, all or none; torques are published at once.

        Args:
            client: connection that writes.
            address: first register.
            words: values, big-endian.
            arrived_ns: arrival of the write at this process, ns, monotonic clock.
            received_ns: kernel's receive timestamp of the write, ns, monotonic clock; 0: unavailable.

        Raises:
            ModbusError: 02 a register does not exist or is read-only, 04 the watchdog timeout is outside the bounds
                of the lab, 06 another controller holds the lease or another connection writes the same, 01 the client
                is read-only.
        """
        end = address + len(words) // 2
        if end <= POSITION_ADDRESS:
            self._write_access.authorize_write(client, TORQUES + address, TORQUES + end, arrived_ns)
            self._commands.torque[2 * address : 2 * end] = words
            self._publish_write(client, arrived_ns, received_ns)
            return
        if (address, end) == (CLAIM_ADDRESS, CLAIM_ADDRESS + CLAIM_REGISTERS) and self._ownership.takes_codes:
            self._claim(client, words.decode("ascii", "replace"), arrived_ns)
            return
        self.check_writable(address, len(words) // 2)
        if address >= SWITCH_ADDRESS:
            self._write_switches(client, address, words, arrived_ns, received_ns)
            return
        sets_timeout = address <= WATCHDOG_ADDRESS < end
        if sets_timeout:
            at = 2 * (WATCHDOG_ADDRESS - address)
            timeout_ns = int.from_bytes(words[at : at + 2], "big") * MS
            self._write_access.check_timeout(timeout_ns)
        extended = EXTENDED - ECHO_ADDRESS
        self._write_access.authorize_write(client, extended + address, extended + end, arrived_ns)
        if address == ECHO_ADDRESS:
            self._commands.echo = int.from_bytes(words[:2], "big")
        if sets_timeout:
            self._write_access.set_timeout(timeout_ns)
        # These are registers of the edge, so the emulated network does not drop the write.
        self._commands.publish_session()
        self._write_access.feed_watchdog(client, arrived_ns)

    def write_coil(self, client: Client, address: int, on: bool, arrived_ns: int, received_ns: int = 0) -> None:
        """Switch the magnet, or reset the rig; arguments as `write_registers`.

        Raises:
            ModbusError: as `write_registers`.
        """
        if address not in (MAGNET_COIL, RESET_COIL):
            raise ModbusError(ExcCodes.ILLEGAL_ADDRESS)
        item = MAGNET if address == MAGNET_COIL else RESET
        self._write_access.authorize_write(client, item, item + 1, arrived_ns)
        if address == RESET_COIL and not on:
            self._commands.publish_session()
            self._write_access.feed_watchdog(client, arrived_ns)
            return
        if address == MAGNET_COIL:
            self._commands.magnet = on
        else:
            self._commands.reset()
        self._publish_write(client, arrived_ns, received_ns)

    def _write_switches(self, client: Client, address: int, words: bytes, arrived_ns: int, received_ns: int) -> None:
        """Write the magnet register, the reset register, or both; arguments as `write_registers`."""
        item, on = MAGNET + address - SWITCH_ADDRESS, [any(words[at : at + 2]) for at in range(0, len(words), 2)]
        self._write_access.authorize_write(client, item, item + len(on), arrived_ns)
        is_reset = item + len(on) > RESET and on[-1] and not self._commands.is_reset_requested
        if item + len(on) > RESET:
            self._commands.is_reset_requested = on[-1]
        if is_reset:
            self._commands.reset()
        if item == MAGNET:
            self._commands.magnet = on[0]
        self._publish_write(client, arrived_ns, received_ns)

    def command(
        self, client: Client, torque: bytes, magnet: bool, basis: ServedState, polled: PollTimes, arrived_ns: int
    ) -> None:
        """Publish torques and magnet that were read from the controller that the rig is reserved for.

        Args:
            client: that controller, as `reserve` returned it.
            torque: the four torque registers, big-endian.
            magnet: whether the magnet is on.
            basis: state that the torques answer, and the time at which its positions were sent (ns, monotonic clock).
            polled: how the torques were read.
            arrived_ns: time at which they had been read, ns, monotonic clock.

        Raises:
            ModbusError: 06 its lease was revoked a moment ago.
        """
        client.record_request(arrived_ns)
        client.basis, client.polled = basis, polled
        self._write_access.authorize_write(client, TORQUES, TORQUES + POSITION_ADDRESS, arrived_ns)
        if magnet != self._commands.magnet:
            self._write_access.authorize_write(client, MAGNET, MAGNET + 1, arrived_ns)
            self._commands.magnet = magnet
        self._commands.torque[:] = torque
        self._publish_write(client, arrived_ns, 0)

    def report_fault(self, client: Client, text: str, reason: str) -> None:
        """Emit an event for a failed request to the controller that the rig is reserved for."""
        self._events.emit_for_controller(Event.CONTROLLER_FAULT, Event.WARNING, text, client.address, reason=reason)

    def report_back(self, client: Client, text: str) -> None:
        """Emit an event, because that controller answers again."""
        self._events.emit_for_controller(Event.CONTROLLER_BACK, Event.INFO, text, client.address)

    def _publish_write(self, client: Client, arrived_ns: int, received_ns: int) -> None:
        """Publish the written registers; a command that the emulated network drops does not feed the watchdog."""
        if self._commands.publish_write(client, arrived_ns, received_ns):
            self._write_access.feed_watchdog(client, arrived_ns)

    # -- time

    def check(self, now_ns: int) -> None:
        """Do everything that is due: trip, lease expiry, end of session, repetition, schedule, outages.

        `now_ns`: monotonic clock.
        """
        outage = self._state_outages.check(self._states.last_arrived_ns, now_ns)
        if outage is not None:
            self._events.emit_state_outage(outage, self._wall_ns() - now_ns)
        ends_wall_ns = self._ownership.ends_wall_ns
        if ends_wall_ns is not None and self._wall_ns() >= ends_wall_ns:
            self.end_claim("the lab slot has ended")
        self._write_access.check(now_ns)
        self._sender.repeat_if_due(now_ns)
        self.impairment.check(now_ns)

    def start(self) -> None:
        """Publish the first command, zero torque, and apply the impairment of lab.toml."""
        self._commands.publish_internal()
        self.impairment.start()

    def stop(self, reason: str) -> None:
        """Set the torque to zero, release the lease and end the session, because the edge stops."""
        self._write_access.stop(reason)

    @property
    def has_state(self) -> bool:
        """Whether a state was received, so that positions can be read."""
        return self.refresh_state().arrival is not None

    @property
    def next_state_ns(self) -> int | None:
        """Time at which the impaired state link delivers the next state, ns, monotonic clock; None: not known."""
        return self._states.next_ns

    def refresh_state(self) -> StateImage:
        """Update the register image to the newest state, without serving it to a client, and return the image."""
        return self._states.refresh()

    # -- operator

    def permit(self, names: AbstractSet[str] | None) -> None:
        """Set the certificates whose clients may write; see `WriteAccess.permit`."""
        self._write_access.permit(names)

    def release(self, reason: str) -> str:
        """Revoke the lease; return the previous holder, empty: none. See `WriteAccess.release`."""
        return self._write_access.release(reason)

    def end_claim(self, reason: str) -> str:
        """End the claim of a student, with lease and session; return the student, empty: the rig was not claimed."""
        student = self._ownership.end()
        if student:
            text = f"claim of {self.rig} by {student} has ended: {reason}"
            self._events.emit_for_controller(Event.CLAIM, Event.INFO, text, "", reason=reason, student=student)
            self._write_access.owner_changed(f"the claim of {student} has ended: {reason}")
        return student

    def owner_denial(self, client: Client) -> str:
        """Return why a client may not write because the rig has another owner, or none yet; empty: it may."""
        return self._write_access.owner_denial(client)

    def reset(self) -> None:
        """Move the arm to its start pose with zero torque; the lease holder continues from there."""
        self._commands.reset()
        self._commands.publish_internal()

    def lease_status(self) -> LeaseStatus:
        """Return the status of lease, session, watchdog and connections."""
        status = self._write_access.status()
        status.connections = len(self.clients)
        return status

    # -- inside

    def _claim(self, client: Client, code: str, now_ns: int) -> None:
        """Claim the rig for the student with this code; its torque registers stay as they are."""
        in_use = self.lease.holder not in (None, client.controller)
        refusal = self._ownership.claim(client, code, in_use=in_use, now_ns=now_ns, wall_ns=self._wall_ns())
        if refusal is not None:
            self._write_access.deny(client, refusal, now_ns)
        student, machine = self._ownership.student, self._ownership.claimed_from
        text = f"{self.rig} claimed by {student} from {machine}"
        self._events.emit_for_controller(
            Event.CLAIM, Event.INFO, text, client.address, certificate=client.certificate, student=student
        )
        self._write_access.owner_changed(f"claimed by {student}")

    def _serve_state(self, client: Client) -> StateImage:
        """Return the newest state and record that `client` is served it."""
        state = self._states.refresh()
        if state.arrival is None:
            raise ModbusError(ExcCodes.DEVICE_FAILURE)
        # The time is taken after the newest state was fetched: a state is never served before it arrived.
        client.record_served((state.basis, self._monotonic_ns()))
        return state

    def _input_image(self, client: Client) -> bytes:
        state = self._serve_state(client)
        holder, session = self.lease.holder, self._session.current
        lease = 0 if holder is None else 1 if holder is client.controller else 2
        return state.input_words(
            status=self._status(client),
            lease=lease,
            watchdog=self.watchdog.state,
            timeout_ms=self.watchdog.timeout_ns // MS,
            session=0 if session is None else session.number,
            age_ms=(self._monotonic_ns() - state.arrived_ns) // MS,
        )

    def _status(self, client: Client) -> int:
        status = self._states.image.status(self._monotonic_ns())
        if self._session.current is not None:
            status |= Status.SESSION_OPEN
        holder = self.lease.holder
        if holder is not None:
            status |= Status.LEASE_HELD
            if holder is client.controller:
                status |= Status.LEASE_IS_YOURS
        if self.watchdog.timeout_ns:
            status |= Status.WATCHDOG_ON
        if self.watchdog.state is WatchdogState.TRIPPED:
            status |= Status.WATCHDOG_TRIPPED
        if not self._write_access.may_write(client):
            status |= Status.READ_ONLY
        return status
