"""The log of a service's events: changes of state of many rigs become few lines. Pure: time is passed in."""

import logging
from typing import Final

from hilrig_runtime.errors import list_names
from hilrig_schemas import Event

OUTAGE_KINDS: Final = (Event.STATE_LOST, Event.STATE_BACK, Event.COMMAND_LOST, Event.COMMAND_BACK)
NOT_LOGGED: Final = (Event.LIMIT_HIT, Event.PART_PICKED, Event.PART_DROPPED, Event.CONFIGURATION, Event.RECORDING)
"""Events of the motion, and those whose cause is logged where it is found."""
DELAY_NS: Final = 250_000_000
"""Time in which the events of a kind are collected for one log message, ns."""
PERIOD_NS: Final = 1_000_000_000
"""Shortest time between two log messages about events of one kind, ns."""
OUTAGE_PERIOD_NS: Final = 5_000_000_000
"""The same for outages."""

logger = logging.getLogger(__name__)


class EventLog:
    """Logs events: at most one message a period for each kind, with the first text and the names of all rigs."""

    def __init__(self) -> None:
        self._pending: dict[Event.Kind, list[Event]] = {}
        self._due_ns: dict[Event.Kind, int] = {}

    def record(self, event: Event, now_ns: int) -> None:
        """Collect an event; ns, monotonic clock."""
        if event.kind not in NOT_LOGGED:
            if event.kind not in self._pending:
                self._due_ns[event.kind] = max(self._due_ns.get(event.kind, 0), now_ns + DELAY_NS)
            self._pending.setdefault(event.kind, []).append(event)

    def flush_if_due(self, now_ns: int) -> None:
        """Log the collected events, if that is due; ns, monotonic clock."""
        for kind in [kind for kind in self._pending if now_ns >= self._due_ns[kind]]:
            self._due_ns[kind] = now_ns + (OUTAGE_PERIOD_NS if kind in OUTAGE_KINDS else PERIOD_NS)
            self._flush(kind)

    def flush(self) -> None:
        """Log all collected events, because the service ends."""
        for kind in list(self._pending):
            self._flush(kind)

    def _flush(self, kind: Event.Kind) -> None:
        events = self._pending.pop(kind)
        first = events[0]
        rigs = sorted({event.rig for event in events if event.rig})
        # A text that names its rig, client or session is that of one rig.
        differ = len({event.text for event in events}) > 1 and len(rigs) > 1
        place = first.rig if differ else list_names(rigs)
        also = f" (also {list_names([rig for rig in rigs if rig != first.rig])})" if differ else ""
        others = len({(event.rig, event.text) for event in events}) - len({event.rig for event in events})
        more = f" (and {others} more of this kind: hilrig events)" if others else ""
        level = logging.INFO if first.severity == Event.INFO else logging.WARNING
        logger.log(level, "%s%s%s%s", f"{place}: " if place else "", first.text, also, more)
