"""How often an address may try passwords: some at once, as browsers do with an old one, then one now and then.

A guess that comes too early is not looked at, so that neither many connections nor the time of an answer help whoever
guesses. Pure: time is passed in.
"""

import ipaddress
from collections import OrderedDict
from typing import Final

BURST_ATTEMPTS: Final = 20
"""Wrong passwords after which an address has to wait."""
RETRY_INTERVAL_NS: Final = 5_000_000_000
"""One more may be tried after so long."""
MAX_ADDRESSES: Final = 4096
"""That are remembered; beyond, the one that guessed longest ago is forgotten."""


class LoginThrottle:
    """What is left of it for each address."""

    def __init__(self) -> None:
        self._blocked_until_ns: OrderedDict[str, int] = OrderedDict()

    def wait_ns(self, address: str, now_ns: int) -> int:
        """How long an address has to wait until its next password is looked at; 0: not at all."""
        worn_ns = self._blocked_until_ns.get(_throttle_key(address), 0) - now_ns
        return max(0, worn_ns - (BURST_ATTEMPTS - 1) * RETRY_INTERVAL_NS)

    def record_failure(self, address: str, now_ns: int) -> None:
        """An address gave a wrong password."""
        place = _throttle_key(address)
        self._blocked_until_ns[place] = max(self._blocked_until_ns.get(place, 0), now_ns) + RETRY_INTERVAL_NS
        self._blocked_until_ns.move_to_end(place)
        if len(self._blocked_until_ns) > MAX_ADDRESSES:
            self._blocked_until_ns.popitem(last=False)


def _throttle_key(address: str) -> str:
    """An address; of IPv6 its network, for a host has as many in that as it likes."""
    try:
        known = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(known, ipaddress.IPv6Address) and known.ipv4_mapped is None:
        return str(ipaddress.ip_network((int(known) >> 64 << 64, 64)))
    return str(known)
