"""Modbus TCP listener: one server per rig, which accepts connections, with or without TLS, and closes them."""

import asyncio
import logging
import socket
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.request_log import RequestLog
from hilrig_modbus_edge.server.admission import Admission, Limits
from hilrig_modbus_edge.server.connection import WRITES, Connection
from hilrig_modbus_edge.server.event_loop import (
    DirectEventLoop,
    SocketTransport,
    accept_connections,
    set_receive_timestamps,
)
from hilrig_modbus_edge.server.exception_log import LOG_PERIOD_NS, ExceptionLog
from hilrig_modbus_edge.server.tcp_figures import tcp_figures
from hilrig_modbus_edge.server.tls import ClientCertificate, TlsHandshake, TlsPolicy
from hilrig_runtime.addresses import format_address, listen_hint, listen_reason
from hilrig_runtime.counters import Counters
from hilrig_runtime.errors import OperationError
from hilrig_runtime.timing.clock import Clock
from hilrig_runtime.timing.rate_limiter import RepeatReporter, repeat_suffix

BACKLOG: Final = 128
"""Connections that the system queues until they are accepted."""
ALERT_NS: Final = LOG_PERIOD_NS + 2_000_000_000
"""Time for which a log message is also an alert of the rig, ns: until the next one if its cause persists."""

NO_CERTIFICATE: Final = ClientCertificate("", may_write=True, expiry_ns=0)
"""Of a connection without TLS."""

logger = logging.getLogger(__name__)


class RigServer:
    """Server of one rig: its listening sockets and its connections."""

    def __init__(self, device: Device, limits: Limits, clock: Clock, counters: Counters) -> None:
        self.device = device
        self._idle_ns = limits.idle_ns
        self.counters = counters
        self.request_log = RequestLog(device.rig)
        self.connections: set[Connection] = set()
        self.monotonic_ns: Callable[[], int] = clock.monotonic_ns
        self._admission = Admission(device, limits, clock.monotonic_ns, counters, self._make_room)
        self._malformed: RepeatReporter[tuple[str, str], str] = RepeatReporter(LOG_PERIOD_NS, self._warn)
        self._not_owned: RepeatReporter[tuple[str, str], str] = RepeatReporter(LOG_PERIOD_NS, self._warn)
        self.exceptions = ExceptionLog(self._warn)
        self._alert = ("", 0)
        """The last log message, and its time, ns."""
        self._acceptors: list[asyncio.Task[None]] = []

    async def listen(self, listening: socket.socket, policy: TlsPolicy | None = None) -> None:
        """Accept connections from a listening socket, with TLS if a policy is given; runs on a `DirectEventLoop`.

        Connections that are already in the backlog are served at once.
        """
        loop = asyncio.get_running_loop()
        assert isinstance(loop, DirectEventLoop)

        async def accept(connected: socket.socket, peer: Any) -> None:
            transport = SocketTransport(loop, connected, peer)
            admitted = self._admission.admit(transport)
            if admitted is not None:
                self.attach(transport, *admitted)

        async def accept_tls(connected: socket.socket, peer: Any) -> None:
            del peer
            # TLS runs on asyncio's own transports.
            assert policy is not None
            await loop.connect_accepted_socket(lambda: TlsHandshake(self._admission, policy, self.attach), connected)

        on_accept = accept if policy is None else accept_tls
        self._acceptors.append(loop.create_task(accept_connections(loop, listening, on_accept)))

    def attach(
        self,
        transport: asyncio.Transport,
        host: str,
        port: int,
        certificate: ClientCertificate = NO_CERTIFICATE,
        early: bytes = b"",
    ) -> None:
        """Serve an admitted client; `early`: data that it has already sent."""
        client = self.device.connect(host, port, may_write=certificate.may_write, certificate=certificate.name)
        connection = Connection(self, transport, client)
        connection.peer, connection.expiry_ns = (host, port), certificate.expiry_ns
        self.connections.add(connection)
        self.counters.connections += 1
        transport.set_protocol(connection)
        if early:
            connection.data_received(early)

    def report_malformed(self, client: Client, protocol: str, text: str) -> None:
        """See `ConnectionOwner.report_malformed`; the log is rate-limited."""
        self.counters.malformed += 1
        self._malformed.record((client.host, protocol), f"{client.address} {text}", self.monotonic_ns())

    def record_exception(self, client: Client, transaction: int, unit: int, request: bytes, code: int) -> None:
        """See `ConnectionOwner.record_exception`."""
        if code == ExcCodes.DEVICE_BUSY or (code == ExcCodes.ILLEGAL_FUNCTION and request[0] in WRITES):
            self.counters.refused += 1
            if denial := self.device.owner_denial(client):
                text = f"{client.label}: write denied: {denial}"
                self._not_owned.record((client.host, denial), text, self.monotonic_ns())
        self.exceptions.record(client, transaction, unit, request, code, self.monotonic_ns())

    def alert(self) -> str:
        """Return the last log message about a client if it is recent, else an empty text."""
        text, reported_ns = self._alert
        return text if self.monotonic_ns() - reported_ns < ALERT_NS else ""

    def _warn(self, text: str, count: int) -> None:
        text = f"{text}{repeat_suffix(count)}"
        self._alert = (text, self.monotonic_ns())
        logger.warning("rig %s: %s", self.device.rig, text)

    def log_tcp_figures(self) -> None:
        """Add the TCP figures of each connection to the request log."""
        for connection in self.connections:
            figures = tcp_figures(connection.socket)
            if figures is not None:
                self.request_log.record_connection(connection.client.address, *figures)

    def check(self, now_ns: int) -> None:
        """Do everything that is due, twice a second: reports, connections without a request; ns, monotonic clock."""
        self._malformed.check(now_ns)
        self._not_owned.check(now_ns)
        self.exceptions.check(now_ns)
        self._admission.check(now_ns)
        for connection in list(self.connections):
            connection.report_stall(now_ns)
            if self._idle_ns and connection.is_silent and self._idle_since(connection, now_ns):
                connection.close(f"no valid request within {self._idle_ns / 1e9:g} s (edge.idle_timeout_s)")

    def _idle_since(self, connection: Connection, now_ns: int) -> int:
        """Return for how long a connection has sent no request, if that is longer than the idle timeout, else 0; ns."""
        idle_ns = now_ns - connection.client.last_request_ns
        return idle_ns if idle_ns >= self._idle_ns else 0

    def _make_room(self, host: str, close_now: bool) -> bool:
        """Return whether a connection gives way to a new one, and close it.

        Anybody can open connections and send nothing. So the oldest one without a valid request gives way, of the host
        with most of them. Without one, the longest idle one gives way, if that is the idle timeout.

        Args:
            host: only connections of this host; empty: of all hosts.
            close_now: close it; otherwise it is only considered.
        """
        connections = [connection for connection in self.connections if host in ("", connection.client.host)]
        silent = [connection for connection in connections if connection.is_silent]
        crowd = Counter(connection.client.host for connection in silent)
        first = min(
            silent or connections,
            key=lambda connection: (-crowd[connection.client.host], connection.client.last_request_ns),
            default=None,
        )
        if first is None:
            return False
        idle_ns = self._idle_since(first, self.monotonic_ns())
        if not silent and not (self._idle_ns and idle_ns):
            return False
        if close_now:
            reason = f"no request for {idle_ns / 1e9:.0f} s, and its place is needed"
            if silent:
                reason = "no request before its place was needed; send the first one when connected"
                self._admission.refuse(*first.peer, reason)
            first.make_room(reason)
        return True

    def close_certificate(self, name: str, reason: str) -> int:
        """Close the connections of the clients with this name in their certificate; return their number."""
        found = [connection for connection in self.connections if connection.client.certificate == name]
        for connection in found:
            connection.close(reason)
        return len(found)

    def close_expired(self, wall_ns: int) -> None:
        """Close the connections whose certificate has expired; `wall_ns`: wall clock."""
        for connection in list(self.connections):
            if 0 < connection.expiry_ns <= wall_ns:
                connection.close("its certificate has expired; renew it with hilrig certs")

    def close(self, reason: str) -> None:
        """Stop listening and close every connection."""
        for acceptor in self._acceptors:
            acceptor.cancel()
        for handshake in self._admission.pending_handshakes:
            handshake.close()
        for connection in list(self.connections):
            connection.close(reason)


def bind(rig: str, host: str, port: int, setting: str = "edge.first_port, or `port` of the rig") -> socket.socket:
    """Return a listening socket for the clients of a rig; `setting`: key of lab.toml that the port comes from.

    Raises:
        OperationError: the address is unavailable.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        # All addresses of IPv6 include those of IPv4.
        dual = address[0] == "::" and socket.has_dualstack_ipv6()
        listening = socket.create_server(address[:2], family=family, backlog=BACKLOG, dualstack_ipv6=dual)
    except OSError as error:
        hint = listen_hint(error, port, "edge.host, or `host` of the rig,", setting)
        where = format_address(host, port)
        raise OperationError(f"rig {rig!r} can't listen on {where}: {listen_reason(error)}; {hint}") from error
    set_receive_timestamps(listening)
    return listening
