"""Admission control: decides for each new connection whether it is served, and reports the refused ones."""

import asyncio
import socket
from collections.abc import Callable
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_address
from typing import Final, Protocol

from hilrig_modbus_edge.device.device import Device
from hilrig_runtime.addresses import format_address, plain_host
from hilrig_runtime.counters import Counters
from hilrig_runtime.pending_connections import PendingConnections
from hilrig_runtime.timing.rate_limiter import RepeatReporter

REFUSED_EVENT_PERIOD_NS: Final = 1_000_000_000
"""Shortest time between two events about refused connections of one host and reason, ns."""

_TCP_OPTIONS: Final = (
    # Keepalive: the first probe after 5 s without data, then one every 2 s, three in all.
    ("TCP_KEEPIDLE", 5),
    ("TCP_KEEPALIVE", 5),
    ("TCP_KEEPINTVL", 2),
    ("TCP_KEEPCNT", 3),
    # Limits the retransmission of unacknowledged data, ms: the peer lost its power, or does not read its responses.
    ("TCP_USER_TIMEOUT", 11_000),
)
"""Options that a system does not have are skipped: on macOS, TCP_KEEPALIVE is the name of TCP_KEEPIDLE."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits and allow-list for the connections of a rig."""

    connections: int
    connections_per_host: int
    idle_ns: int
    """Time without a request after which a connection may be closed for another one, ns; 0: never."""
    allow: tuple[IPv4Network | IPv6Network, ...]
    """Networks that may connect; empty: all."""


class PendingHandshake(Protocol):
    """A connection whose TLS handshake is not complete."""

    peer: tuple[str, int]
    """Host and port."""

    def close(self) -> None:
        """Abort the handshake and close the connection."""


class Admission:
    """Admission control of one rig."""

    def __init__(
        self,
        device: Device,
        limits: Limits,
        monotonic_ns: Callable[[], int],
        counters: Counters,
        make_room: Callable[[str, bool], bool],
    ) -> None:
        self.pending_handshakes: PendingConnections[PendingHandshake] = PendingConnections(
            limits.connections, limits.connections_per_host
        )
        """They are limited like connections, but do not count as such: they take no place of a controller."""
        self._device = device
        self._limits = limits
        self._monotonic_ns = monotonic_ns
        self._counters = counters
        self._make_room = make_room
        """Returns whether a host, or, if that is empty, any, has an idle connection; with the flag it is closed."""
        self._refused: RepeatReporter[tuple[str, str], tuple[str, str]] = RepeatReporter(
            REFUSED_EVENT_PERIOD_NS, self._report_refused
        )

    def admit(self, transport: asyncio.Transport, *, before_handshake: bool = False) -> tuple[str, int] | None:
        """Return host and port of an admitted connection; else close the connection and return None.

        With TLS it is called again after the handshake, because others may have been admitted since, and because a
        client that may not connect must not take the place of an idle connection.
        """
        peer = transport.get_extra_info("peername")
        # A peer that has already disconnected has no name.
        if peer:
            host, port = plain_host(peer[0]), peer[1]
            reason = self.rejection_reason(host, close_now=not before_handshake)
            if not reason:
                set_socket_options(transport.get_extra_info("socket"))
                return host, port
            self.refuse(host, port, reason)
        transport.abort()
        return None

    def rejection_reason(self, host: str, *, close_now: bool) -> str:
        """Return why a host may not connect now, human-readable; empty: it may.

        If a limit is reached, an idle connection makes room for it: it is closed now, or only considered.
        """
        limits, device = self._limits, self._device
        if limits.allow and not any(ip_address(host.partition("%")[0]) in network for network in limits.allow):
            return "its address is not in the allow-list; add it to `allow` of the rig in lab.toml"
        if device.connections_of(host) >= limits.connections_per_host and not self._make_room(host, close_now):
            return (
                f"the host has its maximum of {limits.connections_per_host} connections; close unused ones, or raise "
                "edge.max_connections_per_host"
            )
        if len(device.clients) >= limits.connections and not self._make_room("", close_now):
            return (
                f"the rig has its maximum of {limits.connections} connections; close unused ones, or raise "
                "edge.max_connections"
            )
        return ""

    def begin_handshake(self, handshake: PendingHandshake) -> None:
        """Track an incomplete handshake; close an older one if there are too many."""
        oldest = self.pending_handshakes.add(handshake, handshake.peer[0])
        if oldest is not None:
            oldest.close()
            self.refuse(*oldest.peer, "TLS handshake not completed before too many others were started")

    def refuse(self, host: str, port: int, reason: str) -> None:
        """Count a refused connection and report it, rate-limited."""
        self._counters.refused += 1
        self._refused.record((host, reason), (format_address(host, port), reason), self._monotonic_ns())

    def check(self, now_ns: int) -> None:
        """Report the refused connections that were not reported yet, if that is due; ns, monotonic clock."""
        self._refused.check(now_ns)

    def _report_refused(self, refused: tuple[str, str], count: int) -> None:
        self._device.report_refused_connection(*refused, count)


def set_socket_options(connected: socket.socket) -> None:
    """Send each response without delay, and let the system detect a silently lost peer within about 10 s."""
    try:
        # asyncio sets this on its own sockets; it does not recognize a socket of `socket.create_server`.
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _TCP_OPTIONS:
            if hasattr(socket, name):
                connected.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    except OSError:
        # Some systems reject options after the peer has disconnected: the first read will report it.
        return
