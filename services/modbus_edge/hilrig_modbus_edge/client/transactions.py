"""One connection to a controller: pymodbus's asynchronous client, with checked responses and described failures.

pymodbus encodes requests, decodes responses, and matches them by transaction identifier, one request at a time. It
skips some failures silently, and waits for its timeout on others: a wrong identifier, length or unit, a lost
connection, a late response. They are detected here, and fail the request at once with a `ControllerError`.
"""

import asyncio
import logging
import ssl
import struct
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU
from pymodbus.transaction import TransactionManager

from hilrig_modbus_edge.client.faults import ControllerError, FaultKind, closed_text, connection_fault, exception_fault
from hilrig_modbus_edge.protocol.functions import FunctionCode
from hilrig_modbus_edge.protocol.mbap import Request, decode_frames, encode_frame
from hilrig_runtime.config.controller import ClientConfig, RegisterBlock, Table
from hilrig_runtime.timing.clock import Clock

_READ: Final[dict[Table, FunctionCode]] = {
    "coil": FunctionCode.READ_COILS,
    "discrete": FunctionCode.READ_DISCRETE_INPUTS,
    "input": FunctionCode.READ_INPUT_REGISTERS,
    "holding": FunctionCode.READ_HOLDING_REGISTERS,
}
NEXT_ADDRESS_S: Final = 0.25
"""Time after which the next address of a host is tried, too (RFC 8305), s."""
_HEAD: Final = struct.Struct(">BHH")
LogRequest = Callable[[bytes, int, int, int], None]
"""Records a request: the first five bytes of its PDU, the times of sending and of the response (ns, monotonic clock),
and the exception code or 0."""
MAX_REMEMBERED_REQUESTS: Final = 16
"""Number of failed requests whose late responses are recognized."""


class _Expected(NamedTuple):
    """The response that a request in flight must have."""

    function: int
    body: bytes
    """Beginning of the PDU after the function code."""
    size: int
    """Length of the PDU, bytes."""


class _Transactions(TransactionManager):
    """pymodbus's transactions, which fail a request as soon as the failure is known."""

    connect_error: BaseException | None = None
    lost: ControllerError | None = None
    """Reason why the connection is unusable; None: it is not."""
    expected: _Expected | None = None
    """None: no request is in flight."""

    def __init__(self, *arguments: Any, unit: int, on_late: Callable[[], None]) -> None:
        super().__init__(*arguments)
        self._unit = unit
        self._on_late = on_late
        self._responses = 0
        self._failed: deque[int] = deque(maxlen=MAX_REMEMBERED_REQUESTS)
        # A host may have several addresses, of which some do not answer. The function is asyncio's.
        call_create: Any = self.call_create
        create = partial(call_create, happy_eyeballs_delay=NEXT_ADDRESS_S)

        async def create_connection() -> Any:
            try:
                return await create()
            except OSError as error:
                # pymodbus reports only that the connection failed.
                self.connect_error = error
                raise

        self.call_create = create_connection

    def forget(self) -> None:
        """Note that the request in flight has timed out: its response may still arrive."""
        self._failed.append(self.request_transaction_id)

    def callback_disconnected(self, exc: Exception | None) -> None:
        """See `TransactionManager`: the connection was lost."""
        super().callback_disconnected(exc)
        self._fail(ControllerError(FaultKind.CLOSED, closed_text(exc, self._responses)))

    def callback_data(self, data: bytes, addr: tuple[str, int] | None = None) -> int:  # noqa: ARG002
        """See `TransactionManager`: bytes were received; pass on the valid response only."""
        frames = decode_frames(data, len(data))
        for frame in frames.requests:
            fault = self._check(frame)
            if fault is not None:
                self._fail(fault)
                break
        if frames.malformed:
            self._fail(ControllerError(FaultKind.MALFORMED, f"malformed response: {frames.malformed}"))
        return frames.used

    def _check(self, frame: Request) -> ControllerError | None:
        expected = self.expected
        if expected is None or frame.transaction != self.request_transaction_id:
            if frame.transaction in self._failed:
                self._failed.remove(frame.transaction)
                self._on_late()
                return None
            awaited = "none is awaited" if expected is None else f"expected {self.request_transaction_id}"
            text = f"response with transaction identifier {frame.transaction}, {awaited}"
            return ControllerError(FaultKind.WRONG_TRANSACTION, text)
        if frame.unit != self._unit:
            text = f"malformed response: unit identifier {frame.unit}, expected {self._unit}"
            return ControllerError(FaultKind.MALFORMED, text)
        pdu = frame.pdu
        is_exception = len(pdu) == 2 and pdu[0] == expected.function | 0x80
        if not is_exception and pdu[0] != expected.function:
            text = f"malformed response: function code {pdu[0]}, expected {expected.function}"
            return ControllerError(FaultKind.MALFORMED, text)
        if not is_exception and len(pdu) != expected.size:
            text = f"malformed response: {len(pdu)} bytes to function {expected.function}, expected {expected.size}"
            return ControllerError(FaultKind.MALFORMED, text)
        if not is_exception and not pdu.startswith(expected.body, 1):
            text = (
                f"malformed response: function {expected.function} answered with {pdu[1:5].hex(' ')}, "
                f"expected {expected.body.hex(' ')}"
            )
            return ControllerError(FaultKind.MALFORMED, text)
        self.expected = None
        self._responses += 1
        super().callback_data(encode_frame(frame.transaction, frame.unit, pdu))
        return None

    def _fail(self, fault: ControllerError) -> None:
        if self.lost is None:
            self.lost = fault
        if self.expected is not None:
            self.expected = None
            if not self.response_future.done():
                self.response_future.set_exception(fault)


class ControllerConnection:
    """A connection to a controller; a lost one is not connected again."""

    def __init__(
        self,
        host: str,
        port: int,
        unit: int,
        settings: ClientConfig,
        context: ssl.SSLContext | None,
        clock: Clock,
        *,
        on_late: Callable[[], None] = lambda: None,
        log: LogRequest = lambda *_: None,
    ) -> None:
        # Failures are reported as events at a limited rate; pymodbus would log a line for each.
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)
        self._address = host, port
        self._unit = unit
        self._settings = settings
        self._monotonic_ns = clock.monotonic_ns
        self._log = log
        self._client = client = AsyncModbusTcpClient(host, port=port, reconnect_delay=0, retries=0)
        client.comm_params.sslctx = context
        self._timed_out = False
        """Whether the last request timed out."""
        self._transactions = client.ctx = _Transactions(
            client.comm_params, client.ctx.framer, 0, False, None, None, None, unit=unit, on_late=on_late
        )

    @property
    def peer(self) -> str:
        """Address of the controller's host, numeric; empty: not connected."""
        transport: Any = self._transactions.transport
        peer = None if transport is None else transport.get_extra_info("peername")
        return "" if peer is None else str(peer[0])

    async def connect(self) -> None:
        """Establish the connection.

        Raises:
            ControllerError: it failed.
        """
        transactions = self._transactions
        transactions.comm_params.timeout_connect = self._settings.connect_timeout_ms / 1e3
        connected = await self._client.connect()
        _raise_cancellation()
        if not connected:
            raise connection_fault(transactions.connect_error or TimeoutError(), *self._address)
        transactions.comm_params.timeout_connect = self._settings.timeout_ms / 1e3

    def close(self) -> None:
        """Close the connection at once."""
        transport: Any = self._transactions.transport
        if transport is not None:
            transport.abort()
        self._client.close()

    async def read_bit(self, block: RegisterBlock, name: str) -> bool:
        """Read a coil, a discrete input, or a bit of a register; `name` for messages.

        Raises:
            ControllerError: the request failed.
        """
        if block.bit is not None:
            words = await self.read_registers(block, name)
            return bool(words[1 - block.bit // 8] >> block.bit % 8 & 1)
        client = self._client
        read = client.read_coils if block.table == "coil" else client.read_discrete_inputs
        expected = _Expected(_READ[block.table], b"\x01", 3)
        response = await self._execute(
            lambda: read(block.address, count=1, device_id=self._unit), expected, f"reading {name} from", block
        )
        return bool(response.bits[0])

    async def read_registers(self, block: RegisterBlock, name: str) -> bytes:
        """Read registers, as they are encoded in a response, big-endian; `name` for messages.

        Raises:
            ControllerError: the request failed.
        """
        client = self._client
        read = client.read_input_registers if block.table == "input" else client.read_holding_registers
        size = 2 * block.count
        response = await self._execute(
            lambda: read(block.address, count=block.count, device_id=self._unit),
            _Expected(_READ[block.table], bytes((size,)), 2 + size),
            f"reading {name} from",
            block,
        )
        return _bytes_of(response.registers)

    async def write_registers(self, block: RegisterBlock, words: bytes, name: str) -> None:
        """Write holding registers with function 16; `name` for messages.

        Raises:
            ControllerError: the request failed.
        """
        values = _values_of(words)
        await self._execute(
            lambda: self._client.write_registers(block.address, values, device_id=self._unit),
            _Expected(FunctionCode.WRITE_MULTIPLE_REGISTERS, struct.pack(">HH", block.address, block.count), 5),
            f"writing {name} to",
            block,
        )

    async def write_and_read(self, written: RegisterBlock, words: bytes, read: RegisterBlock, name: str) -> bytes:
        """Write holding registers, then read others, with function 23; `name` for messages.

        Raises:
            ControllerError: the request failed.
        """
        values, size = _values_of(words), 2 * read.count
        response = await self._execute(
            lambda: self._client.readwrite_registers(
                read_address=read.address,
                read_count=read.count,
                write_address=written.address,
                values=values,
                device_id=self._unit,
            ),
            _Expected(FunctionCode.READ_WRITE_MULTIPLE_REGISTERS, bytes((size,)), 2 + size),
            f"writing {written} and reading {name} from",
            read,
        )
        return _bytes_of(response.registers)

    async def _execute(
        self, request: Callable[[], Awaitable[ModbusPDU]], expected: _Expected, action: str, block: RegisterBlock
    ) -> ModbusPDU:
        transactions = self._transactions
        if transactions.lost is not None:
            raise transactions.lost
        transactions.expected = expected
        sent_ns = self._monotonic_ns()
        try:
            response = await request()
        except ModbusException:
            if transactions.lost is not None:
                raise transactions.lost from None
            raise self._timeout(f"{action} {block}", expected.function) from None
        finally:
            transactions.expected = None
            _raise_cancellation()
        self._timed_out = False
        head = _HEAD.pack(expected.function, block.address, block.count)
        self._log(head, sent_ns, self._monotonic_ns(), response.exception_code if response.isError() else 0)
        if response.isError():
            raise exception_fault(response.exception_code, expected.function, action, block)
        return response

    def _timeout(self, action: str, function: int) -> ControllerError:
        transactions = self._transactions
        transactions.forget()
        received = len(transactions.recv_buffer)
        where = f"to function {function}, {action}, within {self._settings.timeout_ms:g} ms"
        if received:
            return ControllerError(FaultKind.INCOMPLETE, f"incomplete response of {received} bytes {where}")
        repeated, self._timed_out = self._timed_out, True
        text = f"no response {where}: check the controller's load, cable and unit identifier"
        # The first one may be a lost packet, or a controller that was busy for a moment.
        return ControllerError(FaultKind.TIMEOUT, text, closes=repeated)


def _raise_cancellation() -> None:
    """Cancel the current task if that was requested: before Python 3.12, `wait_for` drops it if a response arrives."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


def _bytes_of(registers: Sequence[int]) -> bytes:
    return struct.pack(f">{len(registers)}H", *registers)


def _values_of(words: bytes) -> list[int]:
    return list(struct.unpack(f">{len(words) // 2}H", words))
