"""Rate limiter of wrong passwords and codes per client address: a burst, then one attempt per interval.

The burst covers browsers that retry an old password, and a class behind one address. An attempt during the wait is
rejected without a check, so parallel connections and response times give no advantage. Pure: time is passed in.
"""

import ipaddress
from collections import OrderedDict
from typing import Final

BURST_ATTEMPTS: Final = 20
"""Wrong attempts of an address before it must wait."""
RETRY_INTERVAL_NS: Final = 5_000_000_000
"""Interval of further attempts, ns."""
MAX_ADDRESSES: Final = 4096
"""Capacity of the table; beyond it, the address with the oldest attempt is evicted."""


class GuessThrottle:
    """Rate limiter with one time per address (generic cell rate algorithm)."""

    def __init__(self) -> None:
        self._blocked_until_ns: OrderedDict[str, int] = OrderedDict()

    def wait_ns(self, address: str, now_ns: int) -> int:
        """Return the time until the next attempt of an address is checked, ns; 0: now."""
        ahead_ns = self._blocked_until_ns.get(_throttle_key(address), 0) - now_ns
        return max(0, ahead_ns - (BURST_ATTEMPTS - 1) * RETRY_INTERVAL_NS)

    def record_failure(self, address: str, now_ns: int) -> None:
        """Record a wrong attempt of an address."""
        key = _throttle_key(address)
        self._blocked_until_ns[key] = max(self._blocked_until_ns.get(key, 0), now_ns) + RETRY_INTERVAL_NS
        self._blocked_until_ns.move_to_end(key)
        if len(self._blocked_until_ns) > MAX_ADDRESSES:
            self._blocked_until_ns.popitem(last=False)


def _throttle_key(address: str) -> str:
    """Return the IPv4 address, or the /64 network of an IPv6 address, because a host may use any address in it."""
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv6Address) and ip.ipv4_mapped is None:
        return str(ipaddress.ip_network((int(ip) >> 64 << 64, 64)))
    return str(ip)
