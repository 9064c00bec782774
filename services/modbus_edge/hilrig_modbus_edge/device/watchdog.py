"""Watchdog of a rig: sets the torque to zero when the client stops writing.

Writes feed the watchdog; reads do not, because a client whose control task has crashed may continue to poll. The first
write arms it. It trips once and latches; the next write re-arms it. Time is passed in.
"""

from enum import IntEnum


class WatchdogState(IntEnum):
    """State of a watchdog, with its value in the extended register map."""

    OFF = 0
    WAITING = 1
    WATCHING = 2
    TRIPPED = 3


class Watchdog:
    """Monitors the writes to one rig; `timeout_ns` 0 turns it off."""

    def __init__(self, timeout_ns: int) -> None:
        self.timeout_ns = timeout_ns
        self.tripped = False
        self.fed_ns: int | None = None
        """Time of the last write while it is armed, ns; None: it is not armed."""

    @property
    def state(self) -> WatchdogState:
        """Current state."""
        if self.tripped:
            return WatchdogState.TRIPPED
        if not self.timeout_ns:
            return WatchdogState.OFF
        return WatchdogState.WAITING if self.fed_ns is None else WatchdogState.WATCHING

    @property
    def deadline_ns(self) -> int | None:
        """Time at which it trips without a further write, ns; None: it is not armed."""
        return self.fed_ns + self.timeout_ns if self.fed_ns is not None and self.timeout_ns else None

    def feed(self, now_ns: int) -> bool:
        """Record an accepted write; return True if this re-armed a tripped watchdog."""
        self.fed_ns = now_ns
        rearmed, self.tripped = self.tripped, False
        return rearmed

    def disarm(self) -> None:
        """Disarm it until the next write, because there is no torque to stop."""
        self.fed_ns = None

    def check(self, now_ns: int) -> int:
        """Trip if the deadline has passed; return the time since the last write (ns) when it trips, else 0."""
        deadline_ns = self.deadline_ns
        if deadline_ns is None or self.fed_ns is None or now_ns < deadline_ns:
            return 0
        silent_ns = now_ns - self.fed_ns
        self.fed_ns = None
        self.tripped = True
        return silent_ns
