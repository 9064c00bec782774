"""A recording as arrays: `open_run(path)`, used by the commands and in notebooks.

Opening a run reads the metadata of the file; the arrays are read on first access. `blocks` iterates over a run in
blocks, so one pass needs the same memory for a minute and for a day; `between` reads a time range.
"""

import contextlib
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows, StringTable
from hilrig_replay.io.joined_recording import open_segments
from hilrig_replay.io.recording_file import DamagedRecordingError, RecordingFile
from hilrig_replay.io.records import Decoder, Records, concatenate_records
from hilrig_replay.io.sequence_order import Repairs, in_sequence
from hilrig_replay.io.timebase import Timebase
from hilrig_runtime.errors import InputError

ALL_TOPICS: Final = frozenset({"state", "command", "event", "traffic"})
BLOCK_ROWS: Final = 20_000
_DEFAULT_STEP_NS: Final = 20_000_000
_MAX_RECORDING_DELAY_NS: Final = 2_000_000_000
"""Assumed maximum time from sending a message to its arrival at the recorder; a time range is extended by it."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Number of lost messages as stated in a recording."""

    transport: int
    """Messages that did not arrive at the recorder."""
    recorder: int
    """Messages that arrived and could not be written."""
    file: int = 0
    """Messages that were written, but are not in the file: it was damaged, truncated or edited."""


@contextlib.contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Turn the errors of messages that can't be decoded into damage of the recording.

    Raises:
        InputError: the block raised such an error.
    """
    try:
        yield
    except (DecodeError, struct.error, OverflowError) as error:
        raise DamagedRecordingError(path, f"a message can't be decoded: {error}") from error


class Run:
    """A loaded recording; create it with `open_run`. `time_s` gives the time of a row in s from the first state."""

    def __init__(self, file: RecordingFile) -> None:
        self.file = file
        self.path = file.path
        self.metadata: Mapping[str, Mapping[str, str]] = file.metadata
        """Recorded metadata texts by record name, then by key."""
        self.names = StringTable()
        """Texts of the codes in the arrays."""
        self.timebase = Timebase()
        first = next(iter(self.blocks(frozenset({"state"}), rows=1)), None)
        if first is None:
            raise InputError(
                f"{self.path}: empty recording: it contains no state of the arm "
                f"({sum(file.counts.values())} other messages)"
            )

    @property
    def start_wall_ns(self) -> int:
        """Wall-clock time of the first state, ns since 1970-01-01 UTC."""
        return self.timebase.start_wall_ns

    # -- metadata --------------------------------------------------------------------------------------------------

    @property
    def session(self) -> str:
        """Id of the session; the file name without suffix if the id is not recorded."""
        return self._metadata_text("session", "session") or self.path.stem

    @property
    def rig(self) -> str:
        """Name of the rig."""
        return self._metadata_text("session", "rig") or "rig"

    @property
    def lab(self) -> str:
        """Name of the lab; empty: not recorded."""
        return self._metadata_text("session", "lab")

    @property
    def controller(self) -> str:
        """Address of the controller, "host:port"; empty: a manual recording."""
        return self._metadata_text("session", "controller")

    @property
    def certificate(self) -> str:
        """Name in the controller's certificate; empty: it had none."""
        return self._metadata_text("session", "certificate")

    @property
    def students(self) -> tuple[str, ...]:
        """Ids of the students who owned the rig, normally one; empty: the lab had no roster."""
        return tuple(filter(None, self._metadata_text("session", "student").split(",")))

    @property
    def started(self) -> str:
        """Start time of the session, UTC, as recorded; empty: not recorded."""
        return self._metadata_text("session", "start")

    @property
    def ended(self) -> str:
        """How the recording ended, and why; empty: not recorded."""
        return ": ".join(
            filter(None, (self._metadata_text("summary", "ended"), self._metadata_text("summary", "reason")))
        )

    @cached_property
    def step_ns(self) -> int:
        """Duration of a simulation step, ns: as configured, or estimated from the states if not recorded."""
        configured = self.number("config", "step_ns")
        if configured:
            return configured
        states = next(iter(self.blocks(frozenset({"state"}), rows=1000))).states
        incarnations = states["incarnation"]
        first_run = states[incarnations == incarnations[0]]
        steps = int(first_run["step"][-1]) - int(first_run["step"][0])
        if not steps:
            return _DEFAULT_STEP_NS
        # Ticks are late by some microseconds; the configured duration is a round number.
        duration_ns = int(first_run["sampled_ns"][-1]) - int(first_run["sampled_ns"][0])
        return max(round(duration_ns / steps / 100_000) * 100_000, 1)

    @property
    def parameters_json(self) -> str:
        """Parameters of the rig for `hilrig_sim.arm.model.RigParameters`; empty: not recorded."""
        return self._metadata_text("config", "parameters_json")

    @property
    def urdf(self) -> str:
        """The arm as URDF; empty: not recorded."""
        data = self.file.attachments.get(f"{self.rig}.urdf", b"")
        if not data:
            data = next((data for name, data in self.file.attachments.items() if name.endswith(".urdf")), b"")
        return data.decode("utf-8", errors="replace") or self._metadata_text("config", "urdf")

    @property
    def losses(self) -> Losses | None:
        """Lost messages as counted by the recorder; None: not recorded."""
        transport, recorder = self.number("summary", "lost_transport"), self.number("summary", "lost_recorder")
        if transport is None or recorder is None:
            return None
        written = self.number("summary", "messages") or 0
        missing = max(0, written - sum(self.file.counts.values()))
        return Losses(transport, recorder, missing)

    @property
    def damaged(self) -> bool:
        """Whether the file was recovered from damage before its end, so that messages in between may be missing."""
        damaged_bytes = self.number("recovered", "damaged_bytes") or 0
        truncated_bytes = self.number("recovered", "torn_bytes") or 0
        return damaged_bytes > truncated_bytes or bool(self.number("recovered", "orphans"))

    @property
    def truncated(self) -> bool:
        """Whether the file was recovered without its last bytes."""
        ended = self._metadata_text("summary", "ended")
        return self.recovered and (ended == "recovered" or bool(self.number("recovered", "torn_bytes")))

    @property
    def recovered(self) -> bool:
        """Whether the file was recovered after a truncation: its end may be missing."""
        return "recovered" in self.ended or "hilrig.recovered" in self.metadata

    def number(self, record: str, key: str) -> int | None:
        """Integer value of the metadata record `hilrig.<record>`; None: not recorded."""
        try:
            return int(self._metadata_text(record, key))
        except ValueError:
            return None

    def _metadata_text(self, record: str, key: str) -> str:
        return self.metadata.get(f"hilrig.{record}", {}).get(key, "")

    @property
    def duration_s(self) -> float:
        """Time from the first state to the last, s; with an unchanged simulation by its monotonic clock."""
        return self.file.extent.duration_s

    # -- arrays ----------------------------------------------------------------------------------------------------

    @cached_property
    def states(self) -> Rows:
        """All states, shape (n,), fields as `columns.STATE_DTYPE`."""
        return self._read_all("state").states

    @cached_property
    def parts(self) -> Rows:
        """Poses of the parts, shape (n,), fields as `columns.PART_DTYPE`."""
        return self._read_all("state").parts

    @cached_property
    def commands(self) -> Rows:
        """All commands, shape (n,), fields as `columns.COMMAND_DTYPE`."""
        return self._read_all("command").commands

    @cached_property
    def events(self) -> Rows:
        """All events, shape (n,), fields as `records.EVENT_DTYPE`."""
        return self._read_all("event").events

    @cached_property
    def traffic(self) -> Rows:
        """All Modbus requests, shape (n,), fields as `columns.TRAFFIC_DTYPE`."""
        return self._read_all("traffic").traffic

    def frame(self, table: str, library: str = "pandas") -> Any:
        """One table of the run as a data frame: `state`, `command`, `event` or `traffic`, SI units as in the schemas.

        A joint vector becomes four columns, a code its text, and `time_s` is the time from the first state.

        Args:
            table: name of the table.
            library: `pandas` or `polars`.

        Raises:
            InputError: unknown name.
            OperationError: the library is not installed.
        """
        from hilrig_replay.io.frames import tables

        if table not in tables.TABLES:
            raise InputError(f"table: expected one of {', '.join(tables.TABLES)}, got {table!r}")
        rows = tables.TABLES[table](self._read_all(table))
        return tables.frame(tables.table(self, rows), library)

    @cached_property
    def has_clock_steps(self) -> bool:
        """Whether a wall clock was set during the run; a file without a complete summary is read to find out."""
        stated = self.number("summary", "clock_steps")
        if stated is None:
            for _ in self.blocks(frozenset({"state", "command"})):
                continue
            return self.timebase.has_clock_steps
        return stated > 0

    def between(self, from_s: float, until_s: float, topics: frozenset[str] = ALL_TOPICS) -> Records:
        """Messages that were sent in a time range, `until_s` excluded; only that part of the file is read."""
        low, high = (self.start_wall_ns + round(limit * 1e9) for limit in (from_s, until_s))
        if self.has_clock_steps:
            # Arrivals are times of a clock that was set: the range is selected by the times on the axis.
            return Records(
                *(
                    rows[(self.time_s(rows) >= from_s) & (self.time_s(rows) < until_s)]
                    for rows in concatenate_records(list(self.blocks(ALL_TOPICS))).arrays
                )
            )
        blocks = list(self.blocks(topics, from_ns=low, until_ns=high + _MAX_RECORDING_DELAY_NS))

        def select(rows: Rows) -> Rows:
            return rows[(rows["wall_ns"] >= low) & (rows["wall_ns"] < high)]

        return Records(*(select(rows) for rows in concatenate_records(blocks).arrays))

    def blocks(
        self,
        topics: frozenset[str] = ALL_TOPICS,
        *,
        rows: int = BLOCK_ROWS,
        from_ns: int | None = None,
        until_ns: int | None = None,
        repairs: Repairs | None = None,
    ) -> Iterator[Records]:
        """Iterate over the run in blocks of about `rows` messages; each sender's in the order in which it sent them.

        Messages of different senders are in their order of arrival, so the command of a state can be in the block
        before or after it.

        Args:
            topics: names of the topics to read.
            rows: messages per block.
            from_ns: start of the range of arrival times at the recorder, wall clock; None: the beginning.
            until_ns: end of the range, excluded; None: the end.
            repairs: counts the messages that are not in this order in the file.

        Raises:
            InputError: the file is damaged.
        """
        return in_sequence(self._in_file_order(topics, rows, from_ns, until_ns), repairs or Repairs())

    def _in_file_order(
        self, topics: frozenset[str], rows: int, from_ns: int | None, until_ns: int | None
    ) -> Iterator[Records]:
        decoder = Decoder(self.names, self.timebase)
        topic_of, decode = self.file.topics, decoder.decoders
        count = 0
        with decoding(self.path):
            for channel_id, sequence, log_ns, _, payload in self.file.messages(
                topics, from_ns=from_ns, until_ns=until_ns
            ):
                decode[topic_of[channel_id]](payload, sequence, log_ns)
                count += 1
                if count >= rows:
                    count = 0
                    yield self._checked(decoder.drain())
                    decode = decoder.decoders
        if count:
            yield self._checked(decoder.drain())

    def _checked(self, records: Records) -> Records:
        """Refuse numbers that no simulation sends, before anything is computed from them."""
        for rows, names in (
            (records.states, ("position", "velocity", "effort")),
            (records.commands, ("effort",)),
            (records.parts, ("x", "y", "z", "yaw")),
        ):
            for name in names:
                finite = np.isfinite(rows[name])
                if not finite.all():
                    wrong = rows[name][~finite][0]
                    raise InputError(f"{self.path}: unusable content: {name} is {wrong}; expected finite numbers")
        return records

    def _read_all(self, topic: str) -> Records:
        return concatenate_records(list(self.blocks(frozenset({topic}))))

    # -- time ------------------------------------------------------------------------------------------------------

    def time_s(self, rows: Rows) -> NDArray[np.float64]:
        """Times at which the rows were sent, s from the first state of the run (see `timebase`), shape as `rows`."""
        return self.time_ns(rows) / 1e9

    def time_ns(self, rows: Rows) -> NDArray[np.int64]:
        """Same as `time_s`, in integer ns."""
        return self.timebase.time_ns(rows)


def open_run(files: Path | str | Sequence[Path]) -> Run:
    """Open a recording, or the segments of a session as one run; the arrays are read on first access.

    Raises:
        InputError: a file is missing, not a recording, empty, truncated, damaged, or of a newer version.
    """
    return Run(open_segments([Path(files)] if isinstance(files, Path | str) else files))
