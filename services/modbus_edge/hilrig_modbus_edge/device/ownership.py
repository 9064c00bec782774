"""The owner of a rig, as its device knows it: the student whose machine may write, if the lab has a class."""

from typing import Protocol

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.events import Refusal


class Ownership(Protocol):
    """Who owns a rig. Times are passed in: `now_ns` on the monotonic clock, `wall_ns` on the wall clock."""

    @property
    def student(self) -> str:
        """Id of the owner, several ones with commas; empty: the rig has none."""

    @property
    def claimed_from(self) -> str:
        """Address or certificate to which a claim is bound; empty: no claim."""

    @property
    def takes_codes(self) -> bool:
        """Whether the rig is claimed with a code."""

    @property
    def ends_wall_ns(self) -> int | None:
        """End of the claim, ns; None: no claim."""

    def denial(self, client: Client, *, reserved: bool) -> str:
        """Return why a client may not write because of the owner, human-readable; empty: it may.

        `reserved`: it is the controller that the rig is reserved for.
        """

    def claim(self, client: Client, code: str, *, in_use: bool, now_ns: int, wall_ns: int) -> Refusal | None:
        """Claim the rig for the student with this code; return why that is refused, None: it is done.

        `in_use`: another controller holds the lease.
        """

    def end(self) -> str:
        """End the claim; return the student who had it, empty: there was none."""


class NoOwner:
    """Ownership of a rig without a class: everybody may write. Implements `Ownership`."""

    student = ""
    claimed_from = ""
    takes_codes = False
    ends_wall_ns: int | None = None

    def denial(self, client: Client, *, reserved: bool) -> str:
        """See `Ownership.denial`."""
        del client, reserved
        return ""

    def claim(self, client: Client, code: str, *, in_use: bool, now_ns: int, wall_ns: int) -> Refusal | None:
        """Not called: it takes no codes."""
        raise NotImplementedError

    def end(self) -> str:
        """See `Ownership.end`."""
        return ""
