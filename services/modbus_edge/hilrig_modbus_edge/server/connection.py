"""One Modbus TCP connection: receives requests, executes them in order, and sends the responses.

pymodbus's own server answers only the first of several requests in one segment and has no limits, so the bytes are
handled here. A connection executes a limited number of requests per turn of the event loop. While a client does not
read its responses, no further requests are read from it.
"""

import asyncio
import socket
from collections.abc import Callable
from typing import Final, Protocol

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.protocol.functions import FunctionCode
from hilrig_modbus_edge.protocol.mbap import HEADER, MAX_FRAME, MIN_FRAME, Request, decode_frames
from hilrig_modbus_edge.registers.map import UNIT_IDS
from hilrig_modbus_edge.request_log import RequestLog
from hilrig_modbus_edge.server.event_loop import SocketTransport
from hilrig_modbus_edge.server.pdu import exception_response, execute
from hilrig_runtime.counters import Counters

MAX_REQUESTS_PER_TURN: Final = 16
"""Requests of one connection per turn of the event loop; also the TCP guide's limit of transactions."""
_PDU: Final = HEADER.size
"""Offset of the PDU in a frame, bytes."""
_WRITES: Final = frozenset(int(function) for function in FunctionCode if function.is_write)
_TARGET_SILENT: Final = int(ExcCodes.GATEWAY_NO_RESPONSE)

_pack_header, _unpack_header = HEADER.pack, HEADER.unpack_from


def _not_stamped(earliest_ns: int, latest_ns: int) -> int:  # noqa: ARG001
    return 0


class ConnectionOwner(Protocol):
    """The server of a connection, as far as the connection uses it."""

    device: Device
    counters: Counters
    request_log: RequestLog
    monotonic_ns: Callable[[], int]
    connections: "set[Connection]"

    def report_malformed(self, client: Client, defect: str) -> None:
        """Count and log a connection that is closed because of its malformed data."""


class Connection(asyncio.Protocol):
    """Protocol object of one client's connection."""

    def __init__(self, server: ConnectionOwner, transport: asyncio.Transport, client: Client) -> None:
        self.client = client
        self.expiry_ns = 0
        """End of the validity of the client's certificate, ns since 1970-01-01 UTC; 0: it has none."""
        self.socket: socket.socket = transport.get_extra_info("socket")
        self._server = server
        self._transport = transport
        self._kernel_received_ns = transport.received_ns if isinstance(transport, SocketTransport) else _not_stamped
        """Returns when the kernel received the newest bytes, within two bounds; 0: unavailable, as with TLS."""
        self._device = server.device
        self._monotonic_ns = server.monotonic_ns
        self._log_request = server.request_log.record
        self._pending = b""
        """Received bytes that are not executed yet: more requests than one turn executes, or an incomplete one."""
        self._arrived_ns = self._received_ns = 0
        """Of the newest requests: arrival at this process, and the kernel's receive timestamp; 0: unavailable."""
        self._draining = False
        """Whether reading is paused until the pending requests are executed, in further turns."""
        self._blocked = False
        self._reason = ""

    # -- called by asyncio

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.BaseProtocol`."""
        if self not in self._server.connections:
            return
        self._server.connections.remove(self)
        self._server.counters.connections -= 1
        cause = f"connection lost: {exc}" if exc else "connection closed by the client"
        self._device.disconnect(self.client, self._reason or cause)

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        now_ns = self._monotonic_ns()
        if not self._pending and MIN_FRAME <= len(data) <= MAX_FRAME:
            # Fast path for the most common case, exactly one request; same result as the general path below.
            transaction, protocol, length, unit = _unpack_header(data)
            if len(data) == 6 + length and not protocol:
                client, pdu = self.client, data[_PDU:]
                received_ns = self._kernel_received_ns(client.last_request_ns, now_ns) if pdu[0] in _WRITES else 0
                client.record_request(now_ns)
                self._transport.write(self._reply(transaction, unit, pdu, now_ns, received_ns))
                return
        if self._transport.is_closing():
            # asyncio's TLS transport still delivers data that was already received.
            return
        self._pending += data
        requests, used, malformed = decode_frames(self._pending, MAX_REQUESTS_PER_TURN)
        if requests:
            received_ns = self._kernel_received_ns(self.client.last_request_ns, now_ns)
            self._arrived_ns, self._received_ns = now_ns, received_ns
            self.client.record_request(now_ns)
        if not self._draining:
            self._execute(requests, used, malformed)

    def pause_writing(self) -> None:
        """See `asyncio.BaseProtocol`."""
        self._blocked = True
        self._transport.pause_reading()

    def resume_writing(self) -> None:
        """See `asyncio.BaseProtocol`."""
        self._blocked = False
        if self._draining:
            self._drain()
        else:
            self._transport.resume_reading()

    # -- called by the server

    def close(self, reason: str) -> None:
        """Close the connection; `reason` is reported."""
        self._reason = reason
        self._transport.abort()

    # -- inside

    def _drain(self) -> None:
        """Execute the next pending requests; resume reading when none is left."""
        if self._draining and not self._blocked and not self._transport.is_closing():
            self._draining = False
            self._execute(*decode_frames(self._pending, MAX_REQUESTS_PER_TURN))
            if not self._draining and not self._blocked:
                self._transport.resume_reading()

    def _execute(self, requests: list[Request], used: int, malformed: str) -> None:
        """Execute the first pending requests; the others, if there are more, in the next turn."""
        self._pending = self._pending[used:]
        if requests:
            arrived_ns, received_ns = self._arrived_ns, self._received_ns
            replies = [self._reply(*request, arrived_ns, received_ns) for request in requests]
            self._transport.write(b"".join(replies))
        if malformed:
            self._close_malformed(malformed)
        elif len(requests) == MAX_REQUESTS_PER_TURN and self._pending:
            self._draining = True
            self._transport.pause_reading()
            asyncio.get_running_loop().call_soon(self._drain)

    def _reply(self, transaction: int, unit: int, pdu: bytes, arrived_ns: int, received_ns: int) -> bytes:
        client = self.client
        if unit in UNIT_IDS:
            reply = execute(self._device, client, pdu, arrived_ns, received_ns)
        else:
            reply = exception_response(pdu[0], _TARGET_SILENT)
        code = reply[1] if reply[0] & 0x80 else 0
        self._log_request(pdu, arrived_ns, self._monotonic_ns(), code, client.address)
        return _pack_header(transaction, 0, len(reply) + 1, unit) + reply

    def _close_malformed(self, defect: str) -> None:
        self._server.report_malformed(self.client, defect)
        self._reason = f"not Modbus TCP: {defect}"
        # Not aborted: the responses to the valid requests before are sent first.
        self._transport.close()
