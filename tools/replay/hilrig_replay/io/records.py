"""Blocks of a run as arrays, and the decoder that makes them from messages."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hilrig_replay.io.columns import (
    COMMAND_DTYPE,
    CONNECTION_DTYPE,
    PART_DTYPE,
    STATE_DTYPE,
    TRAFFIC_DTYPE,
    DecodeFunction,
    RowBuffer,
    Rows,
    StringTable,
    command_decoder,
    concatenate_rows,
    state_decoder,
)
from hilrig_replay.io.timebase import Timebase
from hilrig_replay.io.traffic import traffic_decoder
from hilrig_schemas import Event

EVENT_DTYPE: Final = np.dtype(
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
"""One row per `Event`: time, step of the simulation (0: unknown), names of kind and severity, text, source, and the
complete message."""


@dataclass(frozen=True, slots=True)
class Records:
    """A block of a run; each array has one row per message, in the order of its sender."""

    states: Rows
    """Shape (n,), fields as `columns.STATE_DTYPE`."""
    commands: Rows
    """Shape (n,), fields as `columns.COMMAND_DTYPE`; a repeated command is not recorded again."""
    events: Rows
    """Shape (n,), fields as `EVENT_DTYPE`."""
    traffic: Rows
    """Shape (n,), fields as `columns.TRAFFIC_DTYPE`: one row per Modbus request."""
    parts: Rows
    """Shape (n,), fields as `columns.PART_DTYPE`: poses of the scene's parts, from the states that contain them."""
    connections: Rows
    """Shape (n,), fields as `columns.CONNECTION_DTYPE`: TCP figures of the connections."""

    @property
    def arrays(self) -> tuple[Rows, Rows, Rows, Rows, Rows, Rows]:
        """All arrays, in the order of the fields."""
        return self.states, self.commands, self.events, self.traffic, self.parts, self.connections


class Decoder:
    """Collects the messages of a rig, from a file or from the bus, and returns them as `Records`."""

    def __init__(self, names: StringTable, timebase: Timebase) -> None:
        self._names = names
        self._timebase = timebase
        self._states, self._commands, self._traffic = (
            RowBuffer(STATE_DTYPE),
            RowBuffer(COMMAND_DTYPE),
            RowBuffer(TRAFFIC_DTYPE),
        )
        self._parts, self._connections = RowBuffer(PART_DTYPE), RowBuffer(CONNECTION_DTYPE)
        self._events: list[tuple[Any, ...]] = []
        self.decoders = self._new_decoders()
        """Functions that add one message of a topic, by topic; `drain` replaces them. They raise `DecodeError` if the
        payload is not a valid message."""

    def _new_decoders(self) -> dict[str, DecodeFunction]:
        # No reference to `self`: a reference cycle would keep the buffers until the next garbage collection.
        events = self._events
        return {
            "state": state_decoder(self._states, self._parts, self._names),
            "command": command_decoder(self._commands, self._names),
            "event": lambda payload, *_: events.append(_event_row(payload)),
            "traffic": traffic_decoder(self._traffic, self._connections, self._names),
        }

    def drain(self) -> Records:
        """Return and remove the messages that were added since the last call."""
        events = np.array(self._events, EVENT_DTYPE)
        self._events.clear()
        records = Records(
            self._states.drain(),
            self._commands.drain(),
            events,
            self._traffic.drain(),
            self._parts.drain(),
            self._connections.drain(),
        )
        self._timebase.update(records.states)
        self._timebase.update_commands(records.commands)
        # A protobuf message that is reused for parsing never frees memory: new decoders bound its growth.
        self.decoders = self._new_decoders()
        return records


def _event_row(payload: bytes) -> tuple[Any, ...]:
    event = Event.FromString(payload)
    kind = enum_name(Event.Kind, event.kind)
    severity = enum_name(Event.Severity, event.severity)
    return (event.wall_ns, event.step, kind, severity, event.text, event.source, event)


def enum_name(enum: Any, number: int) -> str:
    """Name of an enum value; its number if it is unknown (added by a later version)."""
    try:
        return str(enum.Name(number))
    except ValueError:
        return str(number)


def concatenate_records(blocks: Sequence[Records]) -> Records:
    """Concatenate blocks in the given order."""
    dtypes = (STATE_DTYPE, COMMAND_DTYPE, EVENT_DTYPE, TRAFFIC_DTYPE, PART_DTYPE, CONNECTION_DTYPE)
    return Records(
        *(concatenate_rows([block.arrays[at] for block in blocks], dtype) for at, dtype in enumerate(dtypes))
    )
