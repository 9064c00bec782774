"""How often an address may try passwords: some at once, as browsers do with an old one, then one now and then.

A guess that comes too early is not looked at, so that neither many connections nor the time of an answer help whoever
guesses. Pure: time is passed in.
"""

import ipaddress
from collections import OrderedDict
from typing import Final

AT_ONCE: Final = 20
"""Wrong passwords after which an address has to wait."""
PERIOD_NS: Final = 5_000_000_000
"""One more may be tried after so long."""
ADDRESSES: Final = 4096
"""That are remembered; beyond, the one that guessed longest ago is forgotten."""


class Patience:
    """What is left of it for each address."""

    def __init__(self) -> None:
        self._worn_until_ns: OrderedDict[str, int] = OrderedDict()

    def wait_ns(self, address: str, now_ns: int) -> int:
        """How long an address has to wait until its next password is looked at; 0: not at all."""
        worn_ns = self._worn_until_ns.get(_place(address), 0) - now_ns
        return max(0, worn_ns - (AT_ONCE - 1) * PERIOD_NS)

    def wrong(self, address: str, now_ns: int) -> None:
        """An address gave a wrong password."""
        place = _place(address)
        self._worn_until_ns[place] = max(self._worn_until_ns.get(place, 0), now_ns) + PERIOD_NS
        self._worn_until_ns.move_to_end(place)
        if len(self._worn_until_ns) > ADDRESSES:
            self._worn_until_ns.popitem(last=False)


def _place(address: str) -> str:
    """An address; of IPv6 its network, for a host has as many in that as it likes."""
    try:
        known = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(known, ipaddress.IPv6Address) and known.ipv4_mapped is None:
        return str(ipaddress.ip_network((int(known) >> 64 << 64, 64)))
    return str(known)
