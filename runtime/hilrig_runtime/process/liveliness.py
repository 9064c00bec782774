"""Who of the others was there and is gone: worth a word when it lasts, and another when he is back.

A link that is down for a moment is not, nor is the end of a whole lab, in which one service goes after the other.
Pure: time is passed in.
"""

from typing import Final

PEER_DOWN_GRACE_NS: Final = 2_000_000_000


class PeerDownTracker:
    """See the module."""

    def __init__(self) -> None:
        self._gone_ns: dict[str, int] = {}
        """By who is gone and not told of yet, when he went, ns, monotonic clock."""
        self._told: set[str] = set()

    def mark_down(self, who: str, now_ns: int) -> None:
        """He is not there any more."""
        self._gone_ns.setdefault(who, now_ns)

    def mark_up(self, who: str) -> bool:
        """He is there; whether it was told that he was gone."""
        self._gone_ns.pop(who, None)
        told = who in self._told
        self._told.discard(who)
        return told

    @property
    def due_ns(self) -> int | None:
        """When there is something to tell, if nobody comes back before; None: nobody is gone untold."""
        return min(self._gone_ns.values()) + PEER_DOWN_GRACE_NS if self._gone_ns else None

    def overdue(self, now_ns: int) -> list[str]:
        """Who is gone for long enough to be told, sorted; each once."""
        found = sorted(who for who, since_ns in self._gone_ns.items() if now_ns - since_ns >= PEER_DOWN_GRACE_NS)
        for who in found:
            del self._gone_ns[who]
            self._told.add(who)
        return found
