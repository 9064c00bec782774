"""Writing connections of a rig: each torque register and coil has one at a time, among those of one controller.

The connections of a controller may write different things, for example one the torques and another the magnet. Two
that write the same are two programs that disturb each other. Items are the writable values of the register map, in its
order; a mirror is the same item. Time is passed in.
"""

from dataclasses import dataclass
from typing import Final

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.registers.map import MAP

_ITEMS: Final = [register.name for register in MAP if register.writable and not register.mirrors]
ITEMS: Final = len(_ITEMS)
"""Number of items."""
TORQUES: Final = _ITEMS.index("tau1")
"""Number of the first of the four torque registers."""
EXTENDED: Final = _ITEMS.index("echo")
"""Number of the first register of the extended map."""
MAGNET: Final = _ITEMS.index("magnet")
RESET: Final = _ITEMS.index("reset")


@dataclass(slots=True)
class _Write:
    """The last write of a range of items; shared by them."""

    client: Client
    begin: int
    end: int
    """Item after the last one; 0: one of the items was written otherwise since."""
    written_ns: int


class Writers:
    """The connection that wrote each item last; items are numbered, and written in ranges."""

    def __init__(self) -> None:
        self._writes: list[_Write | None] = [None] * ITEMS

    def rewrite(self, client: Client, begin: int, end: int, now_ns: int) -> bool:
        """Record a write of items that `client` last wrote with one write too; return False if it did not."""
        write = self._writes[begin]
        if write is None or write.client is not client or write.begin != begin or write.end != end:
            return False
        write.written_ns = now_ns
        return True

    def record(self, client: Client, begin: int, end: int, now_ns: int) -> None:
        """Record a write of items; ns, monotonic clock."""
        for replaced in self._writes[begin:end]:
            if replaced is not None:
                replaced.end = 0
        self._writes[begin:end] = [_Write(client, begin, end, now_ns)] * (end - begin)

    def other(self, client: Client, begin: int, end: int, since_ns: int) -> Client | None:
        """Return another open connection that wrote one of the items since a time (ns, monotonic clock); None: none."""
        for write in self._writes[begin:end]:
            if write is not None and write.client is not client and write.written_ns > since_ns:
                return write.client
        return None

    def remove(self, client: Client) -> None:
        """Remove a closed connection."""
        self._writes = [None if write is None or write.client is client else write for write in self._writes]

    def clear(self) -> None:
        """Remove all connections, because the lease was released."""
        self._writes = [None] * ITEMS
