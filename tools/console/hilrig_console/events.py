"""The last events of a lab, numbered, so that whoever has seen some gets the rest. Pure."""

import json
from collections import deque
from typing import Any, Final

from google.protobuf.message import DecodeError

from hilrig_schemas import Event
from hilrig_schemas.topics import EVENT

MAX_EVENTS: Final = 200
MAX_TEXT_CHARS: Final = 500
"""Characters of an event's text that are shown."""


class EventBuffer:
    """What happened, the oldest first.

    Numbers go on from `start`; taken from a clock, they are larger than those of an earlier run, so that a page that
    lived longer than the console does not miss what is new.
    """

    def __init__(self, start: int) -> None:
        self.last = start
        self._events: deque[tuple[int, str]] = deque(maxlen=MAX_EVENTS)

    def hear(self, payload: bytes) -> None:
        """Take an encoded event; what is none is left out."""
        try:
            event = EVENT.decode(payload)
        except DecodeError:
            return
        self.last += 1
        self._events.append((self.last, json.dumps(_row(self.last, event), ensure_ascii=False)))

    def all(self) -> tuple[tuple[int, str], ...]:
        """Each with its number, as JSON."""
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
    """A newer version may send what this one has no name for."""
    return str(kind.Name(number)).lower() if number in kind.values() else str(number)
