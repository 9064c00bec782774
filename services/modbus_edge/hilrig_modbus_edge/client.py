"""A connected controller as a device sees it: who it is, what it may do, and what it was last shown."""

from dataclasses import dataclass
from typing import NamedTuple


class Served(NamedTuple):
    """A state that a controller was shown: what its next write is based on."""

    incarnation: int
    """Of the simulation that sent the state."""
    step: int
    arrived_ns: int
    """When the state came to the edge, ns, monotonic clock."""
    served_ns: int
    """When it was read, ns."""
    injected_ns: int
    """Delay added on purpose on its way, ns."""


@dataclass(slots=True, eq=False)
class Host:
    """The machine that connections come from: one may read and another write."""

    address: str
    connections: int = 0
    served: Served | None = None
    """What any of its connections was last shown."""


@dataclass(slots=True, eq=False)
class Client:
    """One connection."""

    address: str
    """ "host:port"."""
    host: Host
    may_write: bool = True
    last_request_ns: int = 0
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
