"""Cyclic exchange with a controller that is a Modbus server: writes the positions of each state, and reads its torques.

The read is scheduled so that its response is there a short time before the next tick of the simulation: the program of
the controller has the rest of the step. A cycle that takes longer than a step is followed by one with the newest state;
the states in between are skipped and counted.
"""

import asyncio
import logging
from dataclasses import dataclass
from functools import partial
from typing import Final

from hilrig_modbus_edge.client.faults import ControllerError, FaultKind
from hilrig_modbus_edge.client.tls_context import client_context
from hilrig_modbus_edge.client.transactions import ControllerConnection
from hilrig_modbus_edge.client.value_format import ValueFormat
from hilrig_modbus_edge.client.written_positions import STEP_MASK, WrittenPositions
from hilrig_modbus_edge.device.client import PollTimes, ServedState
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.device.settings import MS
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_modbus_edge.registers.image import StateImage, StateRef
from hilrig_modbus_edge.request_log import RequestLog
from hilrig_runtime.config.controller import ClientConfig, RegisterBlock, RegistersConfig, parse_controller
from hilrig_runtime.config.lab import RigSettings
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.timing.clock import Clock
from hilrig_runtime.timing.rate_limiter import RateLimiter, repeat_suffix

MIN_BACKOFF_S: Final = 0.1
MAX_BACKOFF_S: Final = 2.0
"""Longest pause after a failed request, s; the pause doubles from `MIN_BACKOFF_S`."""
FAULT_EVENT_PERIOD_NS: Final = 10_000 * MS
"""Shortest time between two events about one kind of fault, ns."""
MAX_STATE_WAIT_NS: Final = 100 * MS
"""Time without a state, but at least two steps, after which the torques are read all the same, ns."""
NOT_SUPERVISED: Final = "the device's program is not supervised (no echo register)"
NOT_RUNNING: Final = (
    "its program does not copy the step number into the echo register: it is stopped, or lacks the copy"
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ExchangeSettings:
    """Settings of an exchange; times in ns."""

    host: str
    port: int
    unit: int
    registers: RegistersConfig
    client: ClientConfig
    step_ns: int
    read_lead_ns: int
    """Time before a tick at which the torques should have been read."""

    @classmethod
    def of(cls, rig: RigSettings, step_ns: int) -> "ExchangeSettings":
        """Return the settings of a rig that has a controller."""
        assert rig.controller is not None
        lead_ms = rig.client.read_lead_ms
        lead_ns = step_ns // 4 if lead_ms is None else round(lead_ms * MS)
        host, port = parse_controller(rig.controller)
        return cls(host, port, rig.unit, rig.registers, rig.client, step_ns, lead_ns)


class ResponseTime:
    """Estimate of the time that reading the torques takes, ns: mean and mean deviation, as of TCP's retransmission."""

    def __init__(self) -> None:
        self._mean_ns = self._deviation_ns = 0

    def add(self, duration_ns: int) -> None:
        """Add a measured time, ns."""
        if not self._mean_ns:
            self._mean_ns, self._deviation_ns = duration_ns, duration_ns // 2
        self._deviation_ns += (abs(duration_ns - self._mean_ns) - self._deviation_ns) // 4
        self._mean_ns += (duration_ns - self._mean_ns) // 8

    @property
    def expected_ns(self) -> int:
        """Time that few reads exceed, ns."""
        return self._mean_ns + 2 * self._deviation_ns


@dataclass(frozen=True, slots=True)
class _Layout:
    """Requests of a cycle, and the positions of the values in the response with the torques, bytes."""

    written: RegisterBlock
    read: RegisterBlock
    magnet: RegisterBlock | None
    """The switch of the magnet if it has a request of its own."""
    torques_at: int
    echo_at: int | None
    """None: no echo register."""
    magnet_at: tuple[int, int] | None
    """The byte and its bit; None: not in this response."""

    @classmethod
    def of(cls, registers: RegistersConfig) -> "_Layout":
        read, echo, magnet = registers.read_block, registers.echo_block, registers.magnet_block
        magnet_at = None
        if magnet is not None and registers.separate_magnet_block is None:
            assert magnet.bit is not None
            # The high byte of a register comes first.
            magnet_at = 2 * (magnet.address - read.address) + 1 - magnet.bit // 8, magnet.bit % 8
        return cls(
            registers.written_block,
            read,
            registers.separate_magnet_block,
            2 * (registers.torque_block.address - read.address),
            None if echo is None else 2 * (echo.address - read.address),
            magnet_at,
        )


class Exchange:
    """Exchange of one rig with its controller; runs on the event loop of the edge. Its requests are logged.

    Raises `InputError` if a file of client.tls can't be used.
    """

    def __init__(
        self,
        settings: ExchangeSettings,
        device: Device,
        states: LatestValueCache,
        clock: Clock,
        request_log: RequestLog,
    ) -> None:
        self._settings = settings
        self._device = device
        self._states = states
        self._monotonic_ns = clock.monotonic_ns
        self._clock = clock
        self._request_log = request_log
        supervised = settings.registers.echo is not None
        self._client = device.reserve(settings.host, settings.port, "" if supervised else NOT_SUPERVISED)
        device.clients.discard(self._client)
        self._context = None if settings.client.tls is None else client_context(settings.client.tls)
        self._format = ValueFormat(settings.registers)
        self._layout = _Layout.of(settings.registers)
        self._written = WrittenPositions()
        self._state_arrived = asyncio.Event()
        self._newest: StateRef | None = None
        """The state that was written last."""
        self._echo: int | None = None
        """The echo that was read last; None: none was."""
        self._echo_changed_ns = self._stale_read_sent_ns = 0
        self._read_time = ResponseTime()
        self._magnet = False
        self._peer = ""
        self._fault_limiter: RateLimiter[FaultKind] = RateLimiter(FAULT_EVENT_PERIOD_NS)
        self._fault_since_ns = 0
        """Time of the first fault since torques were read; 0: there was none."""
        self._fault_reported = False
        self._task: asyncio.Task[None] | None = None

    @property
    def address(self) -> str:
        """Address of the controller, "host:port"."""
        return self._client.address

    def start(self) -> None:
        """Start the exchange, on the running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._run())
        self._task.add_done_callback(_log_failure)

    def stop(self) -> None:
        """End the exchange."""
        if self._task is not None:
            self._task.cancel()

    def on_states(self) -> None:
        """Note that states arrived."""
        self._state_arrived.set()

    # -- connections

    async def _run(self) -> None:
        settings, backoff_s = self._settings, MIN_BACKOFF_S
        while True:
            connection = ControllerConnection(
                settings.host,
                settings.port,
                settings.unit,
                settings.client,
                self._context,
                self._clock,
                on_late=self._on_late_response,
                log=partial(self._request_log.record, controller=self.address),
            )
            answered_ns = self._client.last_request_ns
            try:
                await connection.connect()
                self._device.clients.add(self._client)
                await self._serve(connection)
            except ControllerError as fault:
                self._report(fault)
            finally:
                self._device.clients.discard(self._client)
                connection.close()
            if self._client.last_request_ns != answered_ns:
                backoff_s = MIN_BACKOFF_S
            await asyncio.sleep(backoff_s)
            backoff_s = min(2 * backoff_s, MAX_BACKOFF_S)

    async def _serve(self, connection: ControllerConnection) -> None:
        """Exchange until the connection is unusable.

        Raises:
            ControllerError: the connection is unusable.
        """
        backoff_s, ready = MIN_BACKOFF_S, False
        self._note_peer(connection.peer)
        while True:
            answered_ns = self._client.last_request_ns
            try:
                if not ready:
                    # Nothing is written to a device that has no torque registers.
                    self._echo = self._echo_in(await self._read(connection))
                    ready = True
                await self._cycle(connection)
            except ControllerError as fault:
                if fault.closes:
                    raise
                self._report(fault)
                if fault.kind is not FaultKind.TIMEOUT:
                    if self._client.last_request_ns != answered_ns:
                        backoff_s = MIN_BACKOFF_S
                    await asyncio.sleep(backoff_s)
                    backoff_s = min(2 * backoff_s, MAX_BACKOFF_S)
            else:
                backoff_s = MIN_BACKOFF_S

    def _note_peer(self, peer: str) -> None:
        if self._peer and peer != self._peer:
            self._device.report_back(
                self._client, f"controller {self._client.address} is at {peer} now, not {self._peer}"
            )
        self._peer = peer

    # -- one cycle

    async def _cycle(self, connection: ControllerConnection) -> None:
        image = await self._next_state()
        if image is None:
            await self._read_and_command(connection)
            return
        served = image.basis, self._monotonic_ns()
        words = self._words_of(image)
        self._skip_to(image)
        layout = self._layout
        if self._settings.client.combined_request:
            # A device executes a request as a whole: the torques answer the positions of an earlier one.
            basis = self._written.newest_basis(served[1])
            self._written.add(served)
            data = await connection.write_and_read(layout.written, words, layout.read, "torques")
            self._written.acknowledge(served, self._monotonic_ns())
            await self._read_magnet(connection)
            self._command(data, basis, served[1])
            return
        self._written.add(served)
        await connection.write_registers(layout.written, words, "positions")
        self._written.acknowledge(served, self._monotonic_ns())
        wait_ns = self._read_due_ns() - self._monotonic_ns()
        if wait_ns > 0:
            await asyncio.sleep(wait_ns * 1e-9)
        await self._read_and_command(connection)

    async def _read_and_command(self, connection: ControllerConnection) -> None:
        begin_ns = self._monotonic_ns()
        await self._read_magnet(connection)
        sent_ns = self._monotonic_ns()
        basis = self._written.newest_basis(sent_ns)
        data = await self._read(connection)
        self._read_time.add(self._monotonic_ns() - begin_ns)
        self._command(data, basis, sent_ns)

    async def _read(self, connection: ControllerConnection) -> bytes:
        return await connection.read_registers(self._layout.read, "torques")

    async def _read_magnet(self, connection: ControllerConnection) -> None:
        magnet = self._layout.magnet
        if magnet is not None:
            self._magnet = await connection.read_bit(magnet, "the magnet")

    def _words_of(self, image: StateImage) -> bytes:
        words = self._format.positions(image)
        if self._layout.echo_at is None:
            return words
        return words + (image.step & STEP_MASK).to_bytes(2, "big")

    def _skip_to(self, image: StateImage) -> None:
        newest, self._newest = self._newest, image.basis
        if newest is not None and newest[0] == image.basis[0]:
            self._client.skipped_states += max(0, image.step - newest[1] - 1)

    async def _next_state(self) -> StateImage | None:
        """Wait for a state that was not written yet; None: none arrived, the torques are read all the same."""
        deadline_ns = self._monotonic_ns() + max(MAX_STATE_WAIT_NS, 2 * self._settings.step_ns)
        while True:
            self._state_arrived.clear()
            image = self._device.refresh_state()
            if image.arrival is not None and image.basis != self._newest:
                return image
            if self._monotonic_ns() >= deadline_ns:
                return None
            due_ns = self._device.next_state_ns
            due_ns = deadline_ns if due_ns is None else min(due_ns, deadline_ns)
            timer = asyncio.get_running_loop().call_at(due_ns * 1e-9, self._state_arrived.set)
            await self._state_arrived.wait()
            timer.cancel()

    def _read_due_ns(self) -> int:
        """Time at which the torques should be read, ns, monotonic clock."""
        newest = self._states.get(self._device.rig)
        if newest is None:
            return 0
        settings = self._settings
        expected_ns = min(self._read_time.expected_ns, settings.step_ns - settings.read_lead_ns)
        return newest.arrived_ns + settings.step_ns - settings.read_lead_ns - expected_ns

    # -- torques

    def _echo_in(self, data: bytes) -> int | None:
        at = self._layout.echo_at
        return None if at is None else int.from_bytes(data[at : at + 2], "big")

    def _command(self, data: bytes, basis: tuple[ServedState, PollTimes], read_sent_ns: int) -> None:
        """Command the torques that were read; `basis`: the newest state that they can answer."""
        now_ns, layout = self._monotonic_ns(), self._layout
        echo = self._echo_in(data)
        if echo is not None:
            if echo == self._echo:
                self._stale_read_sent_ns = read_sent_ns
                self._check_program(now_ns)
                return
            self._echo, self._echo_changed_ns = echo, now_ns
            found = self._written.basis_of_echo(echo, read_sent_ns, self._stale_read_sent_ns)
            if found is None:
                text = f"its echo register contains {echo}, no step number that was written: the program must copy it"
                raise ControllerError(FaultKind.WRONG_ECHO, text, closes=False)
            basis = found
        elif not self._written.any_acknowledged:
            return
        if layout.magnet_at is not None:
            byte, bit = layout.magnet_at
            self._magnet = bool(data[byte] >> bit & 1)
        torque = self._format.torques(data[layout.torques_at : layout.torques_at + self._format.size])
        try:
            self._device.command(self._client, torque, self._magnet, *basis, now_ns)
        except ModbusError:
            if denial := self._device.owner_denial(self._client):
                raise ControllerError(FaultKind.NOT_OWNED, denial, closes=False) from None
            text = "its lease was revoked by an operator; it is acquired again after edge.lease_timeout_ms"
            raise ControllerError(FaultKind.REVOKED, text, closes=False) from None
        self._note_working(now_ns)

    def _check_program(self, now_ns: int) -> None:
        """Report a program that has not copied a step number for the timeout of the watchdog."""
        if self._echo_changed_ns == 0 or self._echo == self._written.newest_echo:
            # Without a new state, the program has nothing to copy.
            self._echo_changed_ns = now_ns
            self._client.fault = ""
        limit_ns = self._device.watchdog.timeout_ns or FAULT_EVENT_PERIOD_NS
        if now_ns - self._echo_changed_ns >= limit_ns:
            self._report(ControllerError(FaultKind.NOT_RUNNING, NOT_RUNNING, closes=False))
        elif 2 * (now_ns - self._echo_changed_ns) >= limit_ns:
            # The watchdog may trip before the next read.
            self._client.fault = NOT_RUNNING

    # -- faults

    def _on_late_response(self) -> None:
        timeout_ms = self._settings.client.timeout_ms
        text = f"response after its timeout of {timeout_ms:g} ms was discarded; a longer client.timeout_ms waits for it"
        self._report(ControllerError(FaultKind.LATE, text, closes=False))

    def _report(self, fault: ControllerError) -> None:
        now_ns, client = self._monotonic_ns(), self._client
        client.fault = fault.text
        self._fault_since_ns = self._fault_since_ns or now_ns
        count = self._fault_limiter.record(fault.kind, now_ns)
        if count:
            self._fault_reported = True
            text = f"controller {client.address} of {self._device.rig}: {fault.text}{repeat_suffix(count)}"
            self._device.report_fault(client, text, str(fault.kind))

    def _note_working(self, now_ns: int) -> None:
        client = self._client
        client.fault = ""
        if self._fault_since_ns:
            silent_s = (now_ns - self._fault_since_ns) / 1e9
            self._fault_since_ns = 0
            if self._fault_reported:
                self._fault_reported = False
                text = f"controller {client.address} of {self._device.rig} works again after {silent_s:.1f} s"
                self._device.report_back(client, text)


def _log_failure(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and task.exception() is not None:
        logger.error("the exchange with a controller ended: internal error", exc_info=task.exception())
