"""Session of a rig: starts when a client acquires the lease, ends a grace time after the lease was released.

A controller that reconnects within the grace time continues its session. So a program that reconnects,
or a sequence of one-shot commands, is one recording. Time is passed in.
"""

from dataclasses import dataclass

from hilrig_modbus_edge.device.client import ConnectedController
from hilrig_schemas import OpenSession


@dataclass(slots=True)
class Session:
    """One open session."""

    rig: str
    id: str
    number: int
    """Number among the rig's sessions since the edge started, from 1."""
    address: str
    """Address of the client that started it, "host:port"."""
    certificate: str
    """Name in the certificate of that client; empty: it has none."""
    controller: ConnectedController
    """The controller of that client."""
    start_wall_ns: int
    student: str = ""
    """Id of the student who owns the rig, several ones with commas; empty: none."""
    released_ns: int | None = None
    """Time at which the lease was released, ns, monotonic clock; None: the lease is held."""

    def expired(self, now_ns: int, grace_ns: int) -> bool:
        """Return whether nobody has held the lease for the grace time."""
        return self.released_ns is not None and now_ns - self.released_ns >= grace_ns

    def as_message(self) -> OpenSession:
        """Return the session as it is announced to the recorder."""
        return OpenSession(
            rig=self.rig,
            session=self.id,
            controller=self.address,
            certificate=self.certificate,
            start_wall_ns=self.start_wall_ns,
            student=self.student,
        )


@dataclass(slots=True)
class SessionState:
    """The session state of a rig, shared by everything that names the session in its messages."""

    current: Session | None = None
    """The open session; None: none is open."""

    @property
    def id(self) -> str:
        """Id of the open session; empty: none."""
        return "" if self.current is None else self.current.id
