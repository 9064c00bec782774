"""Ring buffer of the latest events of a lab, with sequence numbers for clients that reconnect. Pure."""

import json
from collections import deque
from typing import Any, Final

from google.protobuf.message import DecodeError

from hilrig_schemas import Event
from hilrig_schemas.topics import EVENT

MAX_EVENTS: Final = 200
"""Capacity of the buffer, events."""
MAX_TEXT_CHARS: Final = 500
"""Upper limit of the shown text of an event, characters."""


class EventBuffer:
    """Buffer of the latest events, oldest first, with ascending numbers.

    The numbers continue from `start`. If `start` is taken from a clock, they are larger than those of an earlier
    console process, so that a page that stays open across a restart receives all new events.
    """

    def __init__(self, start: int) -> None:
        self.last = start
        self._events: deque[tuple[int, str]] = deque(maxlen=MAX_EVENTS)

    def add(self, key: str, payload: bytes) -> None:
        """Add an encoded event; a message that is invalid or contradicts its key is ignored."""
        try:
            event = EVENT.decode_from(key, payload)
        except DecodeError:
            return
        self.last += 1
        self._events.append((self.last, json.dumps(_row(self.last, event), ensure_ascii=False)))

    def entries(self) -> tuple[tuple[int, str], ...]:
        """Return the number and the JSON text of each event."""
        return tuple(self._events)


def _row(number: int, event: Event) -> dict[str, Any]:
    return {
        "id": number,
        "wall_ms": event.wall_ns // 1_000_000,
        "rig": event.rig,
        "kind": _name(Event.Kind, event.kind),
        "severity": _name(Event.Severity, event.severity),
        "text": event.text[:MAX_TEXT_CHARS],
        "source": event.source,
    }


def _name(kind: Any, number: int) -> str:
    """Return the name of an enum value, or its number if a newer version sent an unknown value."""
    return str(kind.Name(number)).lower() if number in kind.values() else str(number)
