"""Who may connect to a rig, and how many: asked of each connection before it is served, and said where it is not."""

import asyncio
import socket
from collections.abc import Callable
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_address
from typing import Final, Protocol

from hilrig_modbus_edge.device.client import address_of
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.device.rate_limiter import Throttle
from hilrig_runtime.counters import Counters

REFUSAL_PERIOD_NS: Final = 1_000_000_000
"""A host that is refused for one reason is told of once in so long."""

_OPTIONS: Final = (
    # Without a word in between it is asked whether it is there after 5 s, then every 2 s, three times.
    ("TCP_KEEPIDLE", 5),
    ("TCP_KEEPALIVE", 5),
    ("TCP_KEEPINTVL", 2),
    ("TCP_KEEPCNT", 3),
    # What it does not take is not sent for minutes: a peer that lost its power, or never reads its answers.
    ("TCP_USER_TIMEOUT", 11_000),
)
"""The names that a system does not have it does not need: macOS says TCP_KEEPALIVE for TCP_KEEPIDLE."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Who may connect, and how many."""

    connections: int = 32
    connections_per_host: int = 16
    idle_ns: int = 60_000_000_000
    """A connection without a request for so long is closed, ns; 0: never."""
    allow: tuple[IPv4Network | IPv6Network, ...] = ()
    """Networks that may connect; none: all."""


class Gate(Protocol):
    """A connection that was admitted and is not served yet."""

    host: str

    def close(self) -> None:
        """Give up."""


class Admission:
    """See the module."""

    def __init__(self, device: Device, limits: Limits, monotonic_ns: Callable[[], int], counters: Counters) -> None:
        self.gates: set[Gate] = set()
        """Who is shaking hands counts, or one host could keep all others out with it."""
        self._device = device
        self._limits = limits
        self._monotonic_ns = monotonic_ns
        self._counters = counters
        self._throttle = Throttle(REFUSAL_PERIOD_NS)

    def admit(self, transport: asyncio.Transport) -> tuple[str, int] | None:
        """Who connected, if he may; else None, and the connection is closed."""
        peer = transport.get_extra_info("peername")
        # A peer that is gone already has no name.
        if peer:
            host, port = peer[:2]
            reason = self.why_refused(host)
            if not reason:
                tune(transport.get_extra_info("socket"))
                return host, port
            self.refuse(host, port, reason)
        transport.abort()
        return None

    def why_refused(self, host: str) -> str:
        """Why a host may not connect now, for people; empty: it may."""
        limits, device, gates = self._limits, self._device, self.gates
        if limits.allow and not any(ip_address(host.partition("%")[0]) in network for network in limits.allow):
            return "its address is not in the rig's networks (allow in lab.toml)"
        if len(device.clients) + len(gates) >= limits.connections:
            return f"the rig has {limits.connections} connections already (edge.max_connections)"
        if device.connections_of(host) + sum(gate.host == host for gate in gates) >= limits.connections_per_host:
            return f"its host has {limits.connections_per_host} connections already (edge.max_connections_per_host)"
        return ""

    def refuse(self, host: str, port: int, reason: str) -> None:
        """Say that a connection was refused, once in a while."""
        self._counters.refused += 1
        times = self._throttle.count((host, reason), self._monotonic_ns())
        if times:
            self._device.connection_refused(address_of(host, port), reason, times)


def tune(connected: socket.socket) -> None:
    """Send each answer at once, and let the system find out within some 10 s that a peer is gone without a word."""
    try:
        # asyncio sets this on sockets that it made itself; it does not recognise one from `socket.create_server`.
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _OPTIONS:
            if hasattr(socket, name):
                connected.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    except OSError:
        # Some systems take no options for a peer that is gone already: the first read will say so.
        return
