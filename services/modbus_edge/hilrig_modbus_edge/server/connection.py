"""One Modbus TCP connection: receives requests, executes them in order, and sends the responses.

pymodbus's own server answers only the first of several requests in one segment and has no limits, so the bytes are
handled here. A connection executes a limited number of requests per turn of the event loop. While a client does not
read its responses, no further requests are read from it.
"""

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Protocol

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.protocol.functions import FunctionCode
from hilrig_modbus_edge.protocol.mbap import HEADER, MAX_FRAME, MIN_FRAME, Request, decode_frames
from hilrig_modbus_edge.protocol.recognition import Foreign, first_bytes, foreign_protocol
from hilrig_modbus_edge.registers.map import UNIT_IDS
from hilrig_modbus_edge.request_log import RequestLog
from hilrig_modbus_edge.server.event_loop import SocketTransport
from hilrig_modbus_edge.server.pdu import exception_response, execute
from hilrig_runtime.counters import Counters

MAX_REQUESTS_PER_TURN: Final = 16
"""Requests of one connection per turn of the event loop; also the TCP guide's limit of transactions."""
STALL_NS: Final = 1_000_000_000
"""Time without the remainder of an incomplete request after which it is reported, ns."""
_PDU: Final = HEADER.size
"""Offset of the PDU in a frame, bytes."""
WRITES: Final = frozenset(int(function) for function in FunctionCode if function.is_write)
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

    def record_exception(self, client: Client, transaction: int, unit: int, request: bytes, code: int) -> None:
        """Count and log an exception response, see `ExceptionLog.record`."""

    def report_malformed(self, client: Client, protocol: str, text: str) -> None:
        """Count and log data of a client that is not Modbus TCP.

        Args:
            client: connection that sent it.
            protocol: name of its protocol; empty: unknown.
            text: description of the data, and the fix.
        """


class Connection(asyncio.Protocol):
    """Protocol object of one client's connection."""

    def __init__(self, server: ConnectionOwner, transport: asyncio.Transport, client: Client) -> None:
        self.client = client
        self.peer = ("", 0)
        """Host and port."""
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
        self._incomplete = b""
        """An incomplete request after the requests of its turn: a frame of Modbus RTU may begin like a request."""
        self._incomplete_since_ns = 0
        """Time at which the incomplete request was found, ns, monotonic clock; 0: none, or it was reported."""
        self._connected_ns = client.last_request_ns
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
        if self._incomplete_since_ns and not self._reason:
            self._report_incomplete("closed the connection")
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
                received_ns = self._kernel_received_ns(client.last_request_ns, now_ns) if pdu[0] in WRITES else 0
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

    @property
    def is_silent(self) -> bool:
        """Whether it has sent no valid request since it was opened."""
        return self.client.last_request_ns == self._connected_ns

    def report_stall(self, now_ns: int) -> None:
        """Report an incomplete request whose remainder has not arrived for a second, once; ns, monotonic clock."""
        if self._incomplete_since_ns and now_ns - self._incomplete_since_ns >= STALL_NS:
            self._incomplete_since_ns = 0
            self._report_incomplete("sends nothing more")

    def close(self, reason: str) -> None:
        """Close the connection; `reason` is reported."""
        self._reason = reason
        self._transport.abort()

    def make_room(self, reason: str) -> None:
        """Close the connection, and remove it at once from those that count against a limit."""
        self.close(reason)
        self.connection_lost(None)

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
        data, self._pending = self._pending, self._pending[used:]
        self._incomplete_since_ns = 0
        if requests:
            arrived_ns, received_ns = self._arrived_ns, self._received_ns
            replies = [self._reply(*request, arrived_ns, received_ns) for request in requests]
            self._transport.write(b"".join(replies))
        if malformed:
            self._close_malformed(data, used, malformed)
        elif len(requests) == MAX_REQUESTS_PER_TURN and self._pending:
            self._draining = True
            self._transport.pause_reading()
            asyncio.get_running_loop().call_soon(self._drain)
        elif self._pending:
            self._incomplete, self._incomplete_since_ns = data, self._monotonic_ns()
            self._acknowledge()

    def _reply(self, transaction: int, unit: int, pdu: bytes, arrived_ns: int, received_ns: int) -> bytes:
        client = self.client
        if unit in UNIT_IDS:
            reply = execute(self._device, client, pdu, arrived_ns, received_ns)
        else:
            reply = exception_response(pdu[0], _TARGET_SILENT)
        code = 0
        if reply[0] & 0x80:
            code = reply[1]
            self._server.record_exception(client, transaction, unit, pdu, code)
        self._log_request(pdu, arrived_ns, self._monotonic_ns(), code, client.address)
        return _pack_header(transaction, 0, len(reply) + 1, unit) + reply

    def _acknowledge(self) -> None:
        """Acknowledge a part of a request at once.

        With Nagle's algorithm a client sends the rest of a request when its first part is acknowledged, and a delayed
        acknowledgment takes 40 ms.
        """
        if hasattr(socket, "TCP_QUICKACK"):
            # The peer may have disconnected.
            with suppress(OSError):
                self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def _report_incomplete(self, event: str) -> None:
        found = Foreign(f"{len(self._pending)} bytes of a longer request", "send each request completely")
        used = len(self._incomplete) - len(self._pending)
        self._server.report_malformed(self.client, *_describe(self._incomplete, used, found, event))

    def _close_malformed(self, data: bytes, used: int, defect: str) -> None:
        found = Foreign(f"data that is not Modbus TCP: {defect}", "check protocol and port of the client")
        protocol, text = _describe(data, used, found, "is disconnected")
        self._server.report_malformed(self.client, protocol, text)
        self._reason = f"it {text}"
        # Not aborted: the responses to the valid requests before are sent first.
        self._transport.close()


def _describe(data: bytes, used: int, otherwise: Foreign, event: str) -> tuple[str, str]:
    """Return the name of a foreign protocol, empty: none is recognized, and a description of the data with the fix.

    Args:
        data: received data.
        used: number of its bytes that are valid requests.
        otherwise: description if no protocol is recognized.
        event: what happened then.
    """
    rest = data[used:]
    for part in (rest, data):
        if (found := foreign_protocol(part)) is not None:
            return found.name, f"sent {found.name} and {event}: {found.fix} ({first_bytes(part)})"
    return "", f"sent {otherwise.name} and {event}: {otherwise.fix} ({first_bytes(rest)})"
