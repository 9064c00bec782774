"""The watchdog: torque goes to zero when the controller stops writing.

Writes feed it, reads do not: a controller whose control task has died can go on polling. It starts to watch with the
first write, trips once, latches, and the next write re-arms it. Pure: time is passed in.
"""

from enum import IntEnum


class WatchdogState(IntEnum):
    """As the extended map shows it."""

    OFF = 0
    WAITING = 1
    WATCHING = 2
    TRIPPED = 3


class Watchdog:
    """Watches the writes of one rig; `timeout_ns` 0 turns it off."""

    def __init__(self, timeout_ns: int) -> None:
        self.timeout_ns = timeout_ns
        self.tripped = False
        self.fed_ns: int | None = None
        """Last write while it watches, ns; None: it does not watch."""

    @property
    def state(self) -> WatchdogState:
        """What it is doing."""
        if self.tripped:
            return WatchdogState.TRIPPED
        if not self.timeout_ns:
            return WatchdogState.OFF
        return WatchdogState.WAITING if self.fed_ns is None else WatchdogState.WATCHING

    @property
    def deadline_ns(self) -> int | None:
        """When it will trip if nothing is written, ns; None: it won't."""
        return self.fed_ns + self.timeout_ns if self.fed_ns is not None and self.timeout_ns else None

    def feed(self, now_ns: int) -> bool:
        """A write was accepted; True: it re-armed a watchdog that had tripped."""
        self.fed_ns = now_ns
        rearmed, self.tripped = self.tripped, False
        return rearmed

    def rest(self) -> None:
        """Stop watching until the next write: there is nothing to stop."""
        self.fed_ns = None

    def check(self, now_ns: int) -> int:
        """Trip if it is time: how long nothing was written, ns, at the very trip; else 0."""
        deadline_ns = self.deadline_ns
        if deadline_ns is None or self.fed_ns is None or now_ns < deadline_ns:
            return 0
        silent_ns = now_ns - self.fed_ns
        self.fed_ns = None
        self.tripped = True
        return silent_ns
