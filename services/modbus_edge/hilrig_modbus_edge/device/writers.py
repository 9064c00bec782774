"""Writing connections of a rig: each torque register and coil has one at a time, among those of one controller.

The connections of a controller may write different things, for example one the torques and another the magnet. Two
that write the same are two programs that disturb each other. Items are the writable values of the register map, in its
order; a mirror is the same item. Time is passed in.
"""

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


class Writers:
    """The connection that wrote each item last; items are numbered, and written in ranges."""

    def __init__(self) -> None:
        self._clients: list[Client | None] = [None] * ITEMS
        self._written_ns = [0] * ITEMS

    def rewrite(self, client: Client, begin: int, end: int, now_ns: int) -> bool:
        """Record a write of items that `client` wrote last; return False if another one, or none, wrote one of them."""
        count = end - begin
        if self._clients[begin:end].count(client) != count:
            return False
        self._written_ns[begin:end] = [now_ns] * count
        return True

    def record(self, client: Client, begin: int, end: int, now_ns: int) -> None:
        """Record a write of items; ns, monotonic clock."""
        self._clients[begin:end] = [client] * (end - begin)
        self._written_ns[begin:end] = [now_ns] * (end - begin)

    def other(self, client: Client, begin: int, end: int, since_ns: int) -> Client | None:
        """Return another open connection that wrote one of the items since a time (ns, monotonic clock); None: none."""
        for item in range(begin, end):
            writer = self._clients[item]
            if writer is not None and writer is not client and self._written_ns[item] > since_ns:
                return writer
        return None

    def remove(self, client: Client) -> None:
        """Remove a closed connection."""
        self._clients = [None if writer is client else writer for writer in self._clients]

    def clear(self) -> None:
        """Remove all connections, because the lease was released."""
        self._clients = [None] * ITEMS
