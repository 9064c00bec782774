"""A connected controller as a device sees it: who it is, what it may do, and what it was last shown."""

from dataclasses import dataclass, field
from typing import Final

Basis = tuple[int, int, int, int]
"""Which state a write is based on: the incarnation of the simulation that sent it, its step, when it came to the edge
(ns, monotonic clock), and the delay added on purpose on its way (ns). Who are shown one state share one such tuple."""

Served = tuple[Basis, int]
"""A state that a controller was shown, and when (ns, monotonic clock). A plain tuple, for each read makes one."""

NO_BASIS: Final[Served] = ((0, 0, 0, 0), 0)
"""Nothing was shown."""


def address_of(host: str, port: int) -> str:
    """ "host:port"; an IPv6 host stands in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


@dataclass(slots=True, eq=False)
class Host:
    """The machine that connections come from: one may read and another write."""

    address: str
    clients: "set[Client]" = field(default_factory=set)
    """Its connections."""
    served: Served | None = None
    """The state that any of its connections was last served."""

    def forget_served(self) -> None:
        """Drop the states that its connections were served: no later write is based on them."""
        self.served = None
        for client in self.clients:
            client.served = client.basis = None


@dataclass(slots=True, eq=False)
class Client:
    """One connection."""

    address: str
    """ "host:port"."""
    host: Host
    may_write: bool = True
    last_request_ns: int = 0
    barred_until_ns: int = 0
    """Until when it may not take the lease again, because it was taken from it; ns."""
    served: Served | None = None
    basis: Served | None = None
    """What it had been shown when its newest bytes came: they can't have been written knowing more."""

    def heard(self, now_ns: int) -> None:
        """Bytes came from it."""
        self.last_request_ns = now_ns
        self.basis = self.served or self.host.served

    def shown(self, served: Served) -> None:
        """It was shown a state."""
        self.served = served
        self.host.served = served
