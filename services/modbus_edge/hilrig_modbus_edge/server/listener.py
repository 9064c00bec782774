"""Modbus TCP listener: one server per rig, which accepts connections, with or without TLS, and closes them."""

import asyncio
import errno
import logging
import socket
from collections.abc import Callable
from typing import Final

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.request_log import RequestLog
from hilrig_modbus_edge.server.admission import Admission, Limits
from hilrig_modbus_edge.server.connection import Connection
from hilrig_modbus_edge.server.event_loop import (
    DirectEventLoop,
    SocketTransport,
    accept_connections,
    set_receive_timestamps,
)
from hilrig_modbus_edge.server.tcp_figures import tcp_figures
from hilrig_modbus_edge.server.tls import ClientCertificate, TlsHandshake, TlsPolicy
from hilrig_runtime.counters import Counters
from hilrig_runtime.errors import OperationError, listen_failure
from hilrig_runtime.timing.clock import Clock
from hilrig_runtime.timing.rate_limiter import RateLimiter, repeat_suffix

BACKLOG: Final = 128
"""Connections that the system queues until they are accepted."""
MALFORMED_LOG_PERIOD_NS: Final = 1_000_000_000
"""Shortest time between two log messages about malformed data of one host, ns."""

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
        self._admission = Admission(device, limits, clock.monotonic_ns, counters)
        self._rate_limiter: RateLimiter[str] = RateLimiter(MALFORMED_LOG_PERIOD_NS)
        self._acceptors: list[asyncio.Task[None]] = []
        self._tls_servers: list[asyncio.Server] = []

    async def listen(self, listening: socket.socket, policy: TlsPolicy | None = None) -> None:
        """Accept connections from a listening socket, with TLS if a policy is given; runs on a `DirectEventLoop`.

        Connections that are already in the backlog are served at once.
        """
        loop = asyncio.get_running_loop()
        assert isinstance(loop, DirectEventLoop)
        if policy is None:
            self._acceptors.append(loop.create_task(accept_connections(loop, listening, self._on_accept)))
        else:
            # TLS runs on asyncio's own transports.
            server = await loop.create_server(
                lambda: TlsHandshake(self._admission, policy, self.attach), sock=listening, backlog=BACKLOG
            )
            self._tls_servers.append(server)

    def _on_accept(self, transport: SocketTransport) -> None:
        peer = self._admission.admit(transport)
        if peer is not None:
            self.attach(transport, *peer)

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
        connection.expiry_ns = certificate.expiry_ns
        self.connections.add(connection)
        self.counters.connections += 1
        transport.set_protocol(connection)
        if early:
            connection.data_received(early)

    def report_malformed(self, client: Client, defect: str) -> None:
        """Count a connection that is closed because of malformed data, and log it, rate-limited."""
        self.counters.malformed += 1
        count = self._rate_limiter.record(client.host, self.monotonic_ns())
        if count:
            logger.warning(
                "rig %s: closed the connection of %s, which did not send Modbus TCP: %s%s; check protocol and port of "
                "the client",
                self.device.rig,
                client.address,
                defect,
                repeat_suffix(count),
            )

    def log_tcp_figures(self) -> None:
        """Add the TCP figures of each connection to the request log."""
        for connection in self.connections:
            figures = tcp_figures(connection.socket)
            if figures is not None:
                self.request_log.record_connection(connection.client.address, *figures)

    def close_idle(self, now_ns: int) -> None:
        """Close the connections without a request for the idle timeout; ns, monotonic clock."""
        if not self._idle_ns:
            return
        for connection in list(self.connections):
            if now_ns - connection.client.last_request_ns >= self._idle_ns:
                connection.close(f"no request for {self._idle_ns / 1e9:g} s (edge.idle_timeout_s)")

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
        for server in self._tls_servers:
            server.close()
        for handshake in self._admission.pending_handshakes:
            handshake.close()
        for connection in list(self.connections):
            connection.close(reason)


def bind(rig: str, host: str, port: int, setting: str = "edge.first_port") -> socket.socket:
    """Return a listening socket for the clients of a rig; `setting`: key of lab.toml that the port comes from.

    Raises:
        OperationError: the address is unavailable.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listening = socket.create_server(address[:2], family=family, backlog=BACKLOG)
    except OSError as error:
        reason = listen_failure(error)
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            hint = "edge.host in lab.toml must be an address of this host"
        elif error.errno in (errno.EMFILE, errno.ENFILE):
            hint = "allow more open files (ulimit -n, or LimitNOFILE of the service)"
        else:
            hint = (
                f"stop the program that listens there, or choose another port in lab.toml ({setting}, or `port` of the "
                "rig)"
            )
        raise OperationError(f"rig {rig!r} can't listen on {host}:{port}: {reason}; {hint}") from error
    set_receive_timestamps(listening)
    return listening
