"""Pieces of a run as arrays, and what makes them out of messages."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hilrig_replay.io.columns import (
    COMMAND,
    PART,
    STATE,
    TRAFFIC,
    Decode,
    Names,
    Rows,
    Table,
    command_decoder,
    joined,
    state_decoder,
)
from hilrig_replay.io.timebase import Timebase
from hilrig_replay.io.traffic import traffic_decoder
from hilrig_schemas import Event

EVENT: Final = np.dtype(
    [
        ("wall_ns", "<i8"),
        ("step", "<u8"),
        ("kind", "O"),
        ("severity", "O"),
        ("text", "O"),
        ("source", "O"),
        ("message", "O"),
    ]
)
"""One row an `Event`: when, simulation's step (0: not known), kind and severity by name, text, the message whole."""


@dataclass(frozen=True, slots=True)
class Records:
    """A piece of a run; each array has one row a message, in its sender's order."""

    states: Rows
    """Shape (n,), fields as `columns.STATE`."""
    commands: Rows
    """Shape (n,), fields as `columns.COMMAND`; a repeated command is not recorded again."""
    events: Rows
    """Shape (n,), fields as `EVENT`."""
    traffic: Rows
    """Shape (n,), fields as `columns.TRAFFIC`: one row a Modbus request."""
    parts: Rows
    """Shape (n,), fields as `columns.PART`: where the scene's parts are; only rows in which the sim stated them."""

    @property
    def arrays(self) -> tuple[Rows, Rows, Rows, Rows, Rows]:
        """All of them, in the order above."""
        return self.states, self.commands, self.events, self.traffic, self.parts


class Decoder:
    """Collects messages of a rig, from a file or from the bus, and gives them away as records."""

    def __init__(self, names: Names, timebase: Timebase) -> None:
        self._names = names
        self._timebase = timebase
        self._states, self._commands, self._traffic = Table(STATE), Table(COMMAND), Table(TRAFFIC)
        self._parts = Table(PART)
        self._events: list[tuple[Any, ...]] = []
        self._decoders = self._fresh()

    def _fresh(self) -> dict[str, Decode]:
        # Not by way of `self`: a decoder that held itself would keep its tables until the next collection.
        events = self._events
        return {
            "state": state_decoder(self._states, self._parts, self._names),
            "command": command_decoder(self._commands, self._names),
            "event": lambda payload, *_: events.append(_event_row(payload)),
            "traffic": traffic_decoder(self._traffic, self._names),
        }

    def add(self, topic: str, payload: bytes, sequence: int, log_ns: int) -> None:
        """Take in one message of a topic.

        Raises:
            google.protobuf.message.DecodeError: the bytes are no such message.
        """
        self._decoders[topic](payload, sequence, log_ns)

    def take(self) -> Records:
        """What was taken in since the last time."""
        events = np.array(self._events, EVENT)
        self._events.clear()
        records = Records(self._states.take(), self._commands.take(), events, self._traffic.take(), self._parts.take())
        self._timebase.note(records.states)
        # A message that is parsed into again and again gives nothing back: its memory grows with what it was given.
        self._decoders = self._fresh()
        return records


def _event_row(payload: bytes) -> tuple[Any, ...]:
    event = Event.FromString(payload)
    kind = name_of(Event.Kind, event.kind)
    severity = name_of(Event.Severity, event.severity)
    return (event.wall_ns, event.step, kind, severity, event.text, event.source, event)


def name_of(enum: Any, number: int) -> str:
    """Name of an enum's value; its number, where a later version added it."""
    try:
        return str(enum.Name(number))
    except ValueError:
        return str(number)


def join_records(pieces: Sequence[Records]) -> Records:
    """One piece out of several, in their order."""
    dtypes = (STATE, COMMAND, EVENT, TRAFFIC, PART)
    return Records(*(joined([piece.arrays[at] for piece in pieces], dtype) for at, dtype in enumerate(dtypes)))
