"""A recording as arrays: `open_run(path)` for the commands, for notebooks, and for whatever reads a run.

Opening reads what the file says of itself; the arrays are read when they are asked for. `blocks` gives a run piece by
piece, so that what goes through it once needs the same memory for a minute and for a day; `between` reads a range.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from hilrig_replay.io.columns import Names, Rows
from hilrig_replay.io.recording_file import DamagedRecordingError, RecordingFile, open_recording
from hilrig_replay.io.records import Decoder, Records, join_records
from hilrig_replay.io.timebase import Timebase
from hilrig_runtime.errors import InputError

ALL: Final = frozenset({"state", "command", "event", "traffic"})
BLOCK_ROWS: Final = 20_000
_USUAL_STEP_NS: Final = 20_000_000
_SLACK_NS: Final = 2_000_000_000
"""A message arrives at the recorder at most so long after it was sent, as a rule; a range is read that much wider."""


@dataclass(frozen=True, slots=True)
class Losses:
    """What a recording says is not in it."""

    transport: int
    """Messages that never reached the recorder, count."""
    recorder: int
    """Messages that reached it and could not be written, count."""
    file: int = 0
    """Messages that were in the file before it was damaged, and could not be recovered, count."""


class Run:
    """One recording; make it with `open_run`. Times of its rows are seconds from its first state (`time_s`)."""

    def __init__(self, file: RecordingFile) -> None:
        self.file = file
        self.path = file.path
        self.metadata: Mapping[str, Mapping[str, str]] = file.metadata
        """As recorded: metadata records by name, then key; all are text."""
        self.names = Names()
        """Texts behind the codes in the arrays."""
        self.timebase = Timebase()
        first = next(iter(self.blocks(frozenset({"state"}), rows=1)), None)
        if first is None:
            raise InputError(
                f"{self.path}: an empty recording: it holds no state of the arm "
                f"({sum(file.counts.values())} other messages)"
            )

    @property
    def start_wall_ns(self) -> int:
        """The first state on the wall clock, ns since 1970-01-01 UTC."""
        return self.timebase.start_wall_ns

    # -- what it says of itself ------------------------------------------------------------------------------------

    @property
    def session(self) -> str:
        """Id of the session; where the file does not say it, its name."""
        return self._said("session", "session") or self.path.stem

    @property
    def rig(self) -> str:
        """Name of the rig."""
        return self._said("session", "rig") or "rig"

    @property
    def lab(self) -> str:
        """Name of the lab; empty: the file does not say it."""
        return self._said("session", "lab")

    @property
    def controller(self) -> str:
        """Address of the controller, "host:port"; empty: recorded by hand."""
        return self._said("session", "controller")

    @property
    def started(self) -> str:
        """When the session began, UTC, as recorded; empty: the file does not say it."""
        return self._said("session", "start")

    @property
    def ended(self) -> str:
        """How the recording ended, and why; empty: the file does not say it."""
        return ": ".join(filter(None, (self._said("summary", "ended"), self._said("summary", "reason"))))

    @cached_property
    def step_ns(self) -> int:
        """Length of a step, ns: as configured, or where the file does not say it, as the states tell."""
        said = self.number("config", "step_ns")
        if said:
            return said
        states = next(iter(self.blocks(frozenset({"state"}), rows=1000))).states
        mine = states[states["incarnation"] == states["incarnation"][0]]
        steps = int(mine["step"][-1]) - int(mine["step"][0])
        if not steps:
            return _USUAL_STEP_NS
        # Each tick is late by some microseconds; a step is a round number.
        duration_ns = int(mine["sampled_ns"][-1]) - int(mine["sampled_ns"][0])
        return max(round(duration_ns / steps / 100_000) * 100_000, 1)

    @property
    def parameters_json(self) -> str:
        """The rig's parameters for `hilrig_sim.arm.model.RigParameters`; empty: the file does not say them."""
        return self._said("config", "parameters_json")

    @property
    def urdf(self) -> str:
        """The arm as URDF; empty: the recording has none."""
        data = self.file.attachments.get(f"{self.rig}.urdf", b"")
        if not data:
            data = next((data for name, data in self.file.attachments.items() if name.endswith(".urdf")), b"")
        return data.decode("utf-8", errors="replace") or self._said("config", "urdf")

    @property
    def losses(self) -> Losses | None:
        """What the recorder counted as lost; None: the file does not say it."""
        transport, recorder = self.number("summary", "lost_transport"), self.number("summary", "lost_recorder")
        if transport is None or recorder is None:
            return None
        held = self.number("summary", "messages") or 0
        missing = max(0, held - sum(self.file.counts.values())) if self.damaged else 0
        return Losses(transport, recorder, missing)

    @property
    def damaged(self) -> bool:
        """Whether it was saved from damage in its middle, so that messages between others may be missing."""
        not_whole = self.number("recovered", "damaged_bytes") or 0
        return not_whole > (self.number("recovered", "torn_bytes") or 0) or bool(self.number("recovered", "orphans"))

    @property
    def recovered(self) -> bool:
        """Whether the file was saved from a tear: its end may be missing."""
        return "recovered" in self.ended or "hilrig.recovered" in self.metadata

    def number(self, record: str, key: str) -> int | None:
        """A whole number out of the metadata record `hilrig.<record>`; None: it does not say one."""
        try:
            return int(self._said(record, key))
        except ValueError:
            return None

    def _said(self, record: str, key: str) -> str:
        return self.metadata.get(f"hilrig.{record}", {}).get(key, "")

    @property
    def duration_s(self) -> float:
        """From the first message to the last as they arrived at the recorder, s."""
        return (self.file.end_ns - self.file.start_ns) / 1e9

    # -- arrays ----------------------------------------------------------------------------------------------------

    @cached_property
    def states(self) -> Rows:
        """Every state, shape (n,), fields as `columns.STATE`."""
        return self._whole("state").states

    @cached_property
    def parts(self) -> Rows:
        """Where the parts are, shape (n,), fields as `columns.PART`."""
        return self._whole("state").parts

    @cached_property
    def commands(self) -> Rows:
        """Every command, shape (n,), fields as `columns.COMMAND`."""
        return self._whole("command").commands

    @cached_property
    def events(self) -> Rows:
        """Every event, shape (n,), fields as `records.EVENT`."""
        return self._whole("event").events

    @cached_property
    def traffic(self) -> Rows:
        """Every Modbus request, shape (n,), fields as `columns.TRAFFIC`."""
        return self._whole("traffic").traffic

    def between(self, from_s: float, until_s: float, topics: frozenset[str] = ALL) -> Records:
        """What was sent in a range of the run's time, `until_s` excluded; only that part of the file is read."""
        low, high = (self.start_wall_ns + round(limit * 1e9) for limit in (from_s, until_s))
        pieces = list(self.blocks(topics, from_ns=low, until_ns=high + _SLACK_NS))

        def cut(rows: Rows) -> Rows:
            return rows[(rows["wall_ns"] >= low) & (rows["wall_ns"] < high)]

        whole = join_records(pieces)
        return Records(*(cut(rows) for rows in whole.arrays))

    def blocks(
        self,
        topics: frozenset[str] = ALL,
        *,
        rows: int = BLOCK_ROWS,
        from_ns: int | None = None,
        until_ns: int | None = None,
    ) -> Iterator[Records]:
        """The run in pieces of about `rows` messages, in the order of the file.

        Messages of different senders are beside each other as they arrived: a state's command can be in the block
        before or after it. `from_ns` and `until_ns` limit the time of arrival at the recorder, wall clock.

        Raises:
            InputError: the file is damaged.
        """
        decoder = Decoder(self.names, self.timebase)
        count = 0
        try:
            for topic, sequence, log_ns, _, payload in self.file.messages(topics, from_ns=from_ns, until_ns=until_ns):
                decoder.add(topic, payload, sequence, log_ns)
                count += 1
                if count >= rows:
                    count = 0
                    yield decoder.take()
        except DecodeError as error:
            raise DamagedRecordingError(self.path, f"a message can't be decoded: {error}") from error
        if count:
            yield decoder.take()

    def _whole(self, topic: str) -> Records:
        return join_records(list(self.blocks(frozenset({topic}))))

    # -- time ------------------------------------------------------------------------------------------------------

    def time_s(self, rows: Rows) -> NDArray[np.float64]:
        """When the rows were sent, shape as `rows`: seconds from the run's first state (`timebase`)."""
        return self.time_ns(rows) / 1e9

    def time_ns(self, rows: Rows) -> NDArray[np.int64]:
        """As `time_s`, in whole ns."""
        return self.timebase.time_ns(rows)


def open_run(path: Path | str) -> Run:
    """Open a recording; its arrays are read when they are asked for.

    Raises:
        InputError: there is no such file, it is no recording, it is empty, torn or damaged, or a newer hilrig wrote it.
    """
    return Run(open_recording(Path(path)))
