"""Tracks peers that are unreachable for longer than a grace time, and their return.

A link that is down for a moment is not reported, nor is the shutdown of a whole lab, in which the services stop one
after the other. Pure: time is passed in.
"""

from typing import Final

PEER_DOWN_GRACE_NS: Final = 2_000_000_000
"""Time that a peer must be down before it is reported, ns."""
MAX_PEERS: Final = 256
"""Maximum number of peers that are tracked while they are down; a peer may invent others."""


class PeerDownTracker:
    """Decides which peers to report as lost, and which of these came back."""

    def __init__(self) -> None:
        self._down_since_ns: dict[str, int] = {}
        """Peers that are down and not reported yet: when each went down, ns, monotonic clock."""
        self._reported: set[str] = set()

    def mark_down(self, peer: str, now_ns: int) -> None:
        """Record that a peer is down."""
        if len(self._down_since_ns) + len(self._reported) < MAX_PEERS:
            self._down_since_ns.setdefault(peer, now_ns)

    def mark_up(self, peer: str) -> bool:
        """Record that a peer is up; return whether it was reported as lost."""
        self._down_since_ns.pop(peer, None)
        was_reported = peer in self._reported
        self._reported.discard(peer)
        return was_reported

    @property
    def due_ns(self) -> int | None:
        """Time of the next report, ns, monotonic clock; None: no report is pending."""
        return min(self._down_since_ns.values()) + PEER_DOWN_GRACE_NS if self._down_since_ns else None

    def overdue(self, now_ns: int) -> list[str]:
        """Return the peers that are down for longer than the grace time, sorted; each is returned once."""
        down = self._down_since_ns.items()
        found = sorted(peer for peer, since_ns in down if now_ns - since_ns >= PEER_DOWN_GRACE_NS)
        for peer in found:
            del self._down_since_ns[peer]
            self._reported.add(peer)
        return found
