"""Outages: detects that messages stop arriving. Pure: time is passed in."""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

RETURN_NS: Final = 1_000_000_000
"""Time that messages must arrive again before an outage has ended, ns."""
STEADY_NS: Final = 5_000_000_000
"""The same for an outage that begins within this time after the last one: a source that flaps has one long outage."""
STALL_NS: Final = 500_000_000
"""Time without a tick after which a process is stalled, ns: it was stopped, or its host was overloaded."""


@dataclass(frozen=True, slots=True)
class Outage:
    """The begin or the end of an outage; times of the monotonic clock, ns."""

    since_ns: int
    """Arrival of the last message before it."""
    until_ns: int
    """End of the outage, or the time of its detection."""
    has_ended: bool
    interruptions: int = 1
    """Number of interruptions within it, if messages arrived meanwhile."""

    @property
    def silent_ns(self) -> int:
        """Time without a message, ns."""
        return self.until_ns - self.since_ns


class OutageDetector:
    """Detects the begin and the end of the outages of one source of messages."""

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self._checked_ns: int | None = None
        self._valid_ns = 0
        """Begin of the time in which this process could receive messages."""
        self._since_ns: int | None = None
        """Arrival of the last message before the outage; None: no outage."""
        self._back_ns: int | None = None
        """Arrival of the first message after it, if no other interruption followed."""
        self._interruptions = 0
        self._ended_ns = -STEADY_NS
        self._return_ns = RETURN_NS

    def check(self, last_ns: int, now_ns: int) -> Outage | None:
        """Check the arrival of the last message; call this several times within the timeout.

        Args:
            last_ns: arrival of the last message, ns, monotonic clock; 0: none.
            now_ns: now.

        Returns:
            The outage that began or ended; None: nothing changed.
        """
        if self._checked_ns is None or now_ns - self._checked_ns > self._timeout_ns // 2:
            # This process started, or was stopped itself: the messages of that time are still to be received.
            self._valid_ns = now_ns
        self._checked_ns = now_ns
        is_silent = now_ns - max(last_ns, self._valid_ns) > self._timeout_ns
        if self._since_ns is None:
            if not is_silent:
                return None
            self._since_ns = last_ns or self._valid_ns
            self._back_ns = None
            self._interruptions = 1
            self._return_ns = STEADY_NS if now_ns - self._ended_ns < STEADY_NS else RETURN_NS
            return Outage(self._since_ns, now_ns, has_ended=False)
        if is_silent:
            self._interruptions += self._back_ns is not None
            self._back_ns = None
        elif self._back_ns is None:
            self._back_ns = last_ns if last_ns > self._since_ns else None
        elif now_ns - self._back_ns >= self._return_ns:
            ended = Outage(self._since_ns, self._back_ns, has_ended=True, interruptions=self._interruptions)
            self._since_ns, self._ended_ns = None, now_ns
            return ended
        return None


def describe_outage(what: str, outage: Outage, wall_offset_ns: int) -> str:
    """Return the text of an event: the missing messages, and begin or end of the outage.

    Args:
        what: the missing messages, in the plural.
        outage: the outage.
        wall_offset_ns: wall clock minus monotonic clock.
    """
    if outage.has_ended:
        until = _utc_time(outage.until_ns + wall_offset_ns)
        times = f" with {outage.interruptions} interruptions" if outage.interruptions > 1 else ""
        return f"{what} received again since {until}, after {outage.silent_ns / 1e9:.1f} s{times}"
    return f"no {what} since {_utc_time(outage.since_ns + wall_offset_ns)}"


def _utc_time(wall_ns: int) -> str:
    time = datetime.fromtimestamp(wall_ns // 1_000_000_000, UTC)
    return f"{time:%H:%M:%S}.{wall_ns // 1_000_000 % 1000:03d} UTC"
