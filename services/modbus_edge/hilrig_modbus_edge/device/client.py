"""A connected Modbus client as a device sees it: address, permission, and the state that it was last served."""

from dataclasses import dataclass, field
from typing import Final

from hilrig_modbus_edge.registers.image import NO_STATE_REF, StateRef

ServedState = tuple[StateRef, int]
"""State that a client was served, and the time (ns, monotonic clock). A plain tuple, because each read creates one."""

NO_STATE: Final[ServedState] = (NO_STATE_REF, 0)
"""No state was served."""


def address_of(host: str, port: int) -> str:
    """Return "host:port"; an IPv6 host is put in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


@dataclass(slots=True, eq=False)
class Host:
    """A computer that connections come from: one connection may read and another write."""

    address: str
    clients: "set[Client]" = field(default_factory=set)
    """Its open connections."""
    served: ServedState | None = None
    """The state that any of its connections was last served."""

    def clear_served(self) -> None:
        """Clear the states that its connections were served: no later write is based on them."""
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
    """Time of its last request, ns, monotonic clock."""
    lease_cooldown_until_ns: int = 0
    """It cannot acquire the lease before this time, because its lease was revoked; ns, monotonic clock."""
    served: ServedState | None = None
    """The state that it was last served."""
    basis: ServedState | None = None
    """The state that it had been served when its newest bytes arrived: they cannot be based on a newer one."""

    def record_request(self, now_ns: int) -> None:
        """Record that a request arrived."""
        self.last_request_ns = now_ns
        self.basis = self.served or self.host.served

    def record_served(self, served: ServedState) -> None:
        """Record the state that it was served."""
        self.served = served
        self.host.served = served
