"""A connected Modbus client as a device sees it: identity, permission, and the states that it was served."""

from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from hilrig_modbus_edge.registers.image import NO_STATE_REF, StateRef

ServedState = tuple[StateRef, int]
"""State that a client was served, and the time (ns, monotonic clock). A plain tuple, because each read creates one."""

NO_STATE: Final[ServedState] = (NO_STATE_REF, 0)
"""No state was served."""


class PollTimes(NamedTuple):
    """How the torques of a controller that is a server were read."""

    positions_acknowledged_ns: int
    """Time at which the controller acknowledged the write of the positions of the basis, ns, monotonic clock."""
    read_sent_ns: int
    """Time at which the request was sent that read the torques, ns, monotonic clock."""
    stale_read_sent_ns: int
    """Time at which the newest request was sent that still read the echo before this one, ns, monotonic clock; 0: none
    since the positions of the basis were sent."""
    basis_is_bound: bool
    """Whether the basis is only the newest state that the torques can answer."""


@dataclass(slots=True, eq=False)
class ConnectedController:
    """A controller with all its connections: one connection may read and another write."""

    name: str
    clients: "set[Client]" = field(default_factory=set)
    """Its open connections."""
    served: ServedState | None = None
    """The state that any of its connections was last served in this session; None: none was."""
    served_before: ServedState | None = None
    """The one served before."""

    @property
    def last_request_ns(self) -> int:
        """Time of the last request of its writing connections, ns, monotonic clock."""
        return max((client.last_request_ns for client in self.clients if client.writes), default=0)

    def clear_served(self) -> None:
        """Clear the state that any of its connections was served; each connection keeps its own."""
        self.served = self.served_before = None
        for client in self.clients:
            client.other_basis = None


@dataclass(slots=True, eq=False)
class Client:
    """One connection."""

    host: str
    address: str
    """ "host:port"."""
    certificate: str = ""
    """Name in its certificate; empty: it has none."""
    may_write: bool = True
    """Whether the role in its certificate allows writes."""
    controller: ConnectedController = field(init=False)
    """The controller that it belongs to, by `controller_of`."""
    last_request_ns: int = 0
    """Time of its last request, ns, monotonic clock."""
    writes: bool = False
    """Whether it has written since its controller acquired the lease."""
    lease_cooldown_until_ns: int = 0
    """It cannot acquire the lease before this time, because its lease was revoked; ns, monotonic clock."""
    served: ServedState | None = None
    """The state that it was last served since the previous session ended; None: none was."""
    served_before: ServedState | None = None
    """The one served before."""
    basis: ServedState | None = None
    """`served` when its newest bytes arrived: they cannot be based on a newer one."""
    other_basis: ServedState | None = None
    """`ConnectedController.served` when its newest bytes arrived: the basis of a client that was itself served none."""
    polled: PollTimes | None = None
    """How its newest torques were read, if it is a controller whose client the edge is; else None."""
    fault: str = ""
    """Reason why that controller does not command the rig now; empty: it does."""
    skipped_states: int = 0
    """Number of states that were not written to that controller, because a newer one was there."""

    @property
    def label(self) -> str:
        """Address, and the name in its certificate if it has one: for texts."""
        return f"{self.address} (CN={self.certificate})" if self.certificate else self.address

    def record_request(self, now_ns: int) -> None:
        """Record that a request arrived."""
        self.last_request_ns = now_ns
        self.basis = self.served
        self.other_basis = self.controller.served

    def record_served(self, served: ServedState) -> None:
        """Record the state that it was served."""
        controller = self.controller
        self.served_before, controller.served_before = self.served, controller.served
        self.served = controller.served = served

    def basis_before(self, received_ns: int) -> ServedState:
        """Return the basis of a write that the kernel received at `received_ns`, before the newest state was served."""
        for served in (self.served_before, self.other_basis, self.controller.served_before):
            if served is not None and served[1] <= received_ns:
                return served
        return NO_STATE

    def was_served(self, basis: ServedState) -> bool:
        """Return whether the basis of its newest write is not one that another connection was served."""
        return basis is self.basis or basis is self.served_before or basis is NO_STATE

    def clear_served(self) -> None:
        """Clear the state that it was served: no later write is based on it."""
        self.served = self.served_before = self.basis = None


def controller_of(connection: Client, lease: Literal["controller", "connection"]) -> str:
    """Return the name of the controller of a connection: its certificate's, else its host.

    With `lease` "connection" (edge.lease), each connection without a certificate is a controller of its own.
    """
    if connection.certificate:
        return f"CN={connection.certificate}"
    return connection.host if lease == "controller" else connection.address
