"""A rig's session: what begins when a controller takes the rig and ends when it has been gone for a while.

A controller that comes back from the same host within the grace time goes on with its session, so that a program
that reconnects, or a chain of one-shot commands, is one recording. Pure: time is passed in.
"""

from dataclasses import dataclass

from hilrig_modbus_edge.device.client import Host
from hilrig_schemas import OpenSession


@dataclass(slots=True)
class Session:
    """One session while it is open."""

    rig: str
    id: str
    number: int
    """Of the rig's sessions since the edge started, from 1."""
    controller: str
    """Address of the controller that began it, "host:port"."""
    host: Host
    """The machine that it came from."""
    start_wall_ns: int
    gone_ns: int | None = None
    """Since when no controller holds the rig, ns, monotonic clock; None: one does."""

    def over(self, now_ns: int, grace_ns: int) -> bool:
        """Whether its controller has been gone for the grace time."""
        return self.gone_ns is not None and now_ns - self.gone_ns >= grace_ns

    def as_message(self) -> OpenSession:
        """As log streams state it."""
        return OpenSession(rig=self.rig, session=self.id, controller=self.controller, start_wall_ns=self.start_wall_ns)
