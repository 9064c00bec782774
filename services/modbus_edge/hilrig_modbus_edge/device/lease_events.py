"""Who takes a rig, who leaves it and who may not have it, told so that it can be read.

A controller may come with a new connection for every request, dozens of times a second. Of each host the first of a
second is told, the others are counted; who stays for a second is told in any case. Pure: time is passed in.
"""

from typing import Final

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.events import Journal, times
from hilrig_modbus_edge.device.rate_limiter import Throttle
from hilrig_modbus_edge.device.settings import MS
from hilrig_schemas import Event

PERIOD_NS: Final = 1_000 * MS
"""A host is told of once in so long."""


class Handover:
    """See the module."""

    def __init__(self, rig: str, journal: Journal) -> None:
        self._rig = rig
        self._journal = journal
        self._taken = Throttle(PERIOD_NS)
        self._refused = Throttle(PERIOD_NS)
        self._untold: tuple[str, int] | None = None
        """Address of who holds the rig and since when (ns), where that was not told."""

    def taken(self, client: Client, now_ns: int) -> None:
        """A controller took the rig; ns, monotonic clock."""
        count = self._taken.count(client.host.address, now_ns)
        self._untold = None if count else (client.address, now_ns)
        if count:
            self._tell_taken(client.address, count)

    def left(self, client: Client, reason: str, *, of_itself: bool) -> None:
        """Who held the rig holds it no more; `of_itself`: it ended its connection."""
        if self._untold is not None:
            self._untold = None
            if of_itself:
                return
            self._tell_taken(client.address)
        text = f"{client.address} holds {self._rig} no more: {reason}"
        self._journal.tell_of_controller(Event.LEASE_LOST, Event.INFO, text, client.address, reason=reason)

    def refused(self, client: Client, reason: str, holder: str, now_ns: int) -> None:
        """A controller's write was refused; `holder` is who holds the rig, empty: nobody; ns, monotonic clock."""
        count = self._refused.count((client.host.address, bool(holder)), now_ns)
        if count:
            text = f"{client.address} may not write to {self._rig}: {reason}{times(count)}"
            self._journal.tell_of_controller(
                Event.LEASE_REFUSED, Event.WARNING, text, client.address, reason=reason, holder=holder
            )

    def check(self, now_ns: int) -> None:
        """Tell of who was not told of and has stayed; ns, monotonic clock."""
        if self._untold is not None and now_ns - self._untold[1] >= PERIOD_NS:
            address, self._untold = self._untold[0], None
            self._tell_taken(address)

    def _tell_taken(self, address: str, count: int = 1) -> None:
        text = f"{address} holds {self._rig}{times(count)}"
        self._journal.tell_of_controller(Event.LEASE_GRANTED, Event.INFO, text, address)
