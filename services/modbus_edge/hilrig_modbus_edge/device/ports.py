"""The ports of a device: events and timers that its edge provides, and the owner of its rig."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.command_scheduler import TimerHandle
from hilrig_modbus_edge.device.client import Client
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import Event


class DeviceOutput(Protocol):
    """Everything that a device needs beside its commands and states."""

    def emit(self, event: Event) -> None:
        """Publish an event."""

    def sessions_changed(self) -> None:
        """Report that a session started or ended."""

    def call_at(self, deadline_ns: int, callback: Callable[[], None]) -> TimerHandle:
        """Call `callback` at a time of the monotonic clock, ns."""

    def follow_states(self, arrive: Callable[[TimestampedPayload], None] | None) -> None:
        """Call `arrive` with every received state, on any thread; None: stop calling it."""


class Refusal(NamedTuple):
    """A write that is refused."""

    cause: str
    """Name of the cause: the reasons of one cause differ in times and addresses only."""
    reason: str
    """Human-readable."""
    code: ExcCodes
    holder: str = ""
    """Address of the connection for which it is refused; empty: none."""
    student: str = ""
    """Owner of the rig, if it is refused for the owner; empty: otherwise."""


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
