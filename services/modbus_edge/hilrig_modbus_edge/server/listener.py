"""Sockets: one listener a rig, one protocol object a connection, every request answered in order.

pymodbus's own server answers only the first of several requests in one segment and has no limits, so this one takes
the bytes itself. A connection handles a few requests and then lets its neighbours have their turn; one that does not
read its answers is not read from either.
"""

import asyncio
import errno
import logging
import socket
from collections.abc import Callable
from typing import Final

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.device.rate_limiter import Throttle
from hilrig_modbus_edge.protocol.mbap import HEADER, MAX_FRAME, MIN_FRAME, Request, split
from hilrig_modbus_edge.protocol.pdu import answer, exception
from hilrig_modbus_edge.registers.map import UNIT_IDS
from hilrig_modbus_edge.request_log import TrafficRecord
from hilrig_modbus_edge.server.admission import Admission, Limits
from hilrig_modbus_edge.server.event_loop import DirectEventLoop, SocketTransport, accept_connections
from hilrig_modbus_edge.server.tls import TlsGate, TlsPolicy
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.health import Counters
from hilrig_runtime.timing.clock import Clock

BUFFER_BYTES: Final = 2048
"""What a connection reads at once: several of the longest requests, and few enough to be soon done with."""
SLICE: Final = 16
"""Requests of one connection before the others have their turn; the TCP guide's limit of transactions, too."""
BACKLOG: Final = 128
MALFORMED_PERIOD_NS: Final = 1_000_000_000
"""A host that sends no Modbus is told of once in so long."""
_PDU: Final = HEADER.size
"""Where it begins in a frame."""
_TARGET_SILENT: Final = int(ExcCodes.GATEWAY_NO_RESPONSE)

_pack_header, _unpack_header = HEADER.pack, HEADER.unpack_from

logger = logging.getLogger(__name__)


class RigServer:
    """The connections of one rig."""

    def __init__(self, device: Device, limits: Limits, clock: Clock, counters: Counters) -> None:
        self.device = device
        self._idle_ns = limits.idle_ns
        self.counters = counters
        self.traffic = TrafficRecord(device.rig)
        self.connections: set[Connection] = set()
        self.monotonic_ns: Callable[[], int] = clock.monotonic_ns
        self._admission = Admission(device, limits, clock.monotonic_ns, counters)
        self._throttle = Throttle(MALFORMED_PERIOD_NS)
        self._doors: list[asyncio.Task[None]] = []
        self._tls_servers: list[asyncio.Server] = []

    async def listen(self, listening: socket.socket, policy: TlsPolicy | None = None) -> None:
        """Take connections from a socket that listens, with TLS where there is a policy for it; on a `DirectEventLoop`.

        What has connected already is served now.
        """
        loop = asyncio.get_running_loop()
        assert isinstance(loop, DirectEventLoop)
        if policy is None:
            self._doors.append(loop.create_task(accept_connections(loop, listening, self._welcome)))
        else:
            # asyncio's own transports know TLS.
            server = await loop.create_server(
                lambda: TlsGate(self._admission, policy, self.take), sock=listening, backlog=BACKLOG
            )
            self._tls_servers.append(server)

    def _welcome(self, transport: SocketTransport) -> None:
        peer = self._admission.admit(transport)
        if peer is not None:
            self.take(transport, *peer)

    def take(
        self, transport: asyncio.Transport, host: str, port: int, may_write: bool = True, early: bytes = b""
    ) -> None:
        """Serve a controller from now on; `early` are bytes of his that have come already."""
        connection = Connection(self, transport, self.device.connect(host, port, may_write=may_write))
        self.connections.add(connection)
        self.counters.connections += 1
        transport.set_protocol(connection)
        connection.feed(early)

    def count_malformed(self, client: Client, why: str) -> None:
        """Count a connection that is closed for what it sent, and say so, once in a while."""
        self.counters.malformed += 1
        times = self._throttle.count(client.host.address, self.monotonic_ns())
        if times:
            more = f" ({times} times)" if times > 1 else ""
            logger.warning("rig %s: %s sent no Modbus: %s%s", self.device.rig, client.address, why, more)

    def close_idle(self, now_ns: int) -> None:
        """Close the connections that have asked for nothing for too long; ns, monotonic clock."""
        if not self._idle_ns:
            return
        for connection in list(self.connections):
            if now_ns - connection.client.last_request_ns >= self._idle_ns:
                connection.close(f"idle for {self._idle_ns / 1e9:g} s")

    def close(self, reason: str) -> None:
        """Stop listening and close every connection."""
        for door in self._doors:
            door.cancel()
        for server in self._tls_servers:
            server.close()
        for gate in list(self._admission.gates):
            gate.close()
        for connection in list(self.connections):
            connection.close(reason)


class Connection(asyncio.BufferedProtocol):
    """One controller's connection."""

    def __init__(self, server: RigServer, transport: asyncio.Transport, client: Client) -> None:
        self.client = client
        self._server = server
        self._transport = transport
        self._device = server.device
        self._monotonic_ns = server.monotonic_ns
        self._note = server.traffic.note
        self._counters = server.counters
        self._buffer = bytearray(BUFFER_BYTES)
        self._view = memoryview(self._buffer)
        self._filled = 0
        self._waiting: list[Request] = []
        self._arrived_ns = 0
        self._malformed = ""
        self._blocked = False
        self._reason = ""

    # -- called by asyncio

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.BaseProtocol`."""
        if self not in self._server.connections:
            return
        self._server.connections.remove(self)
        self._server.counters.connections -= 1
        broken = f"the connection broke: {exc}" if exc else "it closed the connection"
        self._device.disconnect(self.client, self._reason or broken)

    def get_buffer(self, sizehint: int) -> memoryview:  # noqa: ARG002
        """See `asyncio.BufferedProtocol`."""
        return self._view[self._filled :] if self._filled else self._view

    def buffer_updated(self, nbytes: int) -> None:
        """See `asyncio.BufferedProtocol`."""
        now_ns = self._monotonic_ns()
        if MIN_FRAME <= nbytes <= MAX_FRAME and not self._filled and not self._waiting:
            # By far the most common: exactly one request. It takes the short way; what it means is the same.
            transaction, protocol, length, unit = _unpack_header(self._buffer)
            if nbytes == 6 + length and not protocol:
                self.client.heard(now_ns)
                pdu = self._view[_PDU:nbytes].tobytes()
                self._transport.write(self._reply(transaction, unit, pdu, now_ns))
                return
        if self._transport.is_closing():
            # asyncio's TLS goes on reading what had come already.
            return
        filled = self._filled + nbytes
        requests, used, malformed = split(self._buffer[:filled])
        self._filled = filled - used
        if self._filled:
            self._buffer[: self._filled] = self._buffer[used:filled]
        if requests:
            self.client.heard(now_ns)
        if len(requests) <= SLICE and not self._waiting:
            self._answer(requests, now_ns)
            if malformed:
                self._close_malformed(malformed)
            return
        going_on = bool(self._waiting)
        self._waiting += requests
        self._arrived_ns = now_ns
        self._malformed = malformed
        self._transport.pause_reading()
        if not going_on:
            self._go_on()

    def pause_writing(self) -> None:
        """See `asyncio.BaseProtocol`."""
        self._blocked = True
        self._transport.pause_reading()

    def resume_writing(self) -> None:
        """See `asyncio.BaseProtocol`."""
        self._blocked = False
        self._go_on()

    # -- called by the server

    def feed(self, data: bytes) -> None:
        """Take bytes that came before this connection was there."""
        while data and not self._transport.is_closing():
            room = self.get_buffer(-1)
            count = min(len(room), len(data))
            room[:count] = data[:count]
            self.buffer_updated(count)
            data = data[count:]

    def close(self, reason: str) -> None:
        """Close the connection and say why."""
        self._reason = reason
        self._transport.abort()

    # -- inside

    def _go_on(self) -> None:
        if self._blocked or self._transport.is_closing():
            return
        if not self._waiting:
            self._transport.resume_reading()
            return
        turn, self._waiting = self._waiting[:SLICE], self._waiting[SLICE:]
        self._answer(turn, self._arrived_ns)
        if not self._waiting and self._malformed:
            self._close_malformed(self._malformed)
        else:
            asyncio.get_running_loop().call_soon(self._go_on)

    def _answer(self, requests: list[Request], arrived_ns: int) -> None:
        if requests:
            self._transport.write(b"".join([self._reply(*request, arrived_ns) for request in requests]))

    def _reply(self, transaction: int, unit: int, pdu: bytes, arrived_ns: int) -> bytes:
        client = self.client
        reply = answer(self._device, client, pdu, arrived_ns) if unit in UNIT_IDS else exception(pdu[0], _TARGET_SILENT)
        code = reply[1] if reply[0] & 0x80 else 0
        self._note(pdu, arrived_ns, self._monotonic_ns(), code, client.address)
        self._counters.requests += 1
        return _pack_header(transaction, 0, len(reply) + 1, unit) + reply

    def _close_malformed(self, why: str) -> None:
        self._server.count_malformed(self.client, why)
        self._reason = f"it sent no Modbus: {why}"
        # Not aborted: the answers to what was good before go out.
        self._transport.close()


def bind(rig: str, host: str, port: int, setting: str = "edge.first_port") -> socket.socket:
    """A socket that listens for a rig's controllers; `setting` of lab.toml is where its port comes from.

    Raises:
        OperationError: the address can't be had; it names the rig, the address, and what to do.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=BACKLOG)
    except OSError as error:
        # The library adds the address to the system's words.
        reason = (error.strerror or str(error)).partition(" (while")[0]
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            mend = "edge.host in lab.toml must be an address of this host"
        elif error.errno in (errno.EMFILE, errno.ENFILE):
            mend = "allow more open files (ulimit -n, or LimitNOFILE of the service)"
        else:
            mend = f"stop what listens there, or choose another port in lab.toml ({setting}, or the rig's own)"
        raise OperationError(f"rig {rig!r} can't listen on {host}:{port}: {reason}; {mend}") from error


assert BUFFER_BYTES > MAX_FRAME
