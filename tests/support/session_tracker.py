"""Test bench of the session tracker: a store in memory, fake publishers and a manual clock."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from hilrig_recorder.ingest.queue import ReceivedBatch
from hilrig_recorder.ingest.recording import Recording
from hilrig_recorder.ingest.sessions import SessionTracker
from hilrig_recorder.mcap_format.records import decode_message_head
from hilrig_runtime.counters import Counters
from hilrig_schemas import LogBatch
from support.log_streams import LAB, MS, SECOND, FakeSource, Sent

MESSAGE_HEADER_BYTES = 31
"""Size of the header of an MCAP message record: opcode, length, channel, sequence, two times."""
WALL = 1_767_225_600 * SECOND


@dataclass
class FakeFile:
    """The messages and the end of one recording."""

    recording: Recording
    flush: Callable[[], None]
    records: list[bytes] = field(default_factory=list)
    end: str = ""
    reason: str = ""

    def write(self, records: Sequence[bytes]) -> None:
        self.records += records

    @property
    def payloads(self) -> list[bytes]:
        """Payloads of the written and the pending messages."""
        self.flush()
        return [record[MESSAGE_HEADER_BYTES:] for record in self.records]

    @property
    def log_times(self) -> list[int]:
        self.flush()
        return [decode_message_head(record).log_time for record in self.records]


@dataclass
class FakeStore:
    """Stores recordings in memory."""

    flush: Callable[[], None] = lambda: None
    files: list[FakeFile] = field(default_factory=list)
    rejected: list[str] = field(default_factory=list)
    outages: list[tuple[str, list[str]]] = field(default_factory=list)
    losses: list[tuple[str, int, int]] = field(default_factory=list)
    sources: list[tuple[str, int]] = field(default_factory=list)
    accepts: bool = True
    seen: set[tuple[int, int, int]] | None = None
    last: dict[int, tuple[int, int]] = field(default_factory=dict)
    horizon_ns: dict[int, int] = field(default_factory=dict)

    def open(self, recording: Recording) -> bool:
        if not self.accepts:
            return False
        recording.seen, recording.last, recording.horizon_ns = self.seen, dict(self.last), self.horizon_ns
        recording.file = FakeFile(recording, self.flush)
        self.files.append(recording.file)
        return True

    def close(self, recording: Recording, end: str, reason: str) -> None:
        file = self._file(recording)
        file.end, file.reason = end, reason

    def _file(self, recording: Recording) -> FakeFile:
        return next(file for file in self.files if file.recording is recording)

    def record_loss(self, _recording: Recording, _source: str, key: str, transport: int, recorder: int) -> None:
        self.losses.append((key, transport, recorder))

    def record_source(self, _recording: Recording, source: str, incarnation: int) -> None:
        self.sources.append((source, incarnation))

    def report_outage(self, recordings: Sequence[Recording], text: str, *, has_ended: bool) -> None:
        assert has_ended == ("again" in text)
        self.outages.append((text.partition(" since")[0], [recording.rig for recording in recordings]))

    def report_rejected(self, message: str) -> None:
        self.rejected.append(message)


class TrackerBench:
    """A session tracker with a fake store, fake publishers and a manual clock."""

    def __init__(
        self,
        preroll_s: float = 2.0,
        rigs: Sequence[str] | None = None,
        may_serve: Callable[[str, str], bool] = lambda _source, _rig: True,
    ) -> None:
        self.store = FakeStore()
        self.counters = Counters()
        self.tracker = SessionTracker(
            LAB, preroll_s, self.store, lambda rig: rigs is None or rig in rigs, may_serve, self.counters
        )
        self.store.flush = self.tracker.flush
        self.now = 100 * SECOND
        self.offset = WALL
        self.sim, self.edge = FakeSource("sim/1"), FakeSource("edge/1")

    @property
    def wall(self) -> int:
        return self.now + self.offset

    def accept(self, batch: LogBatch) -> None:
        self.tracker.accept(ReceivedBatch(batch, self.wall), self.now)

    def wait(self, duration: int) -> None:
        """Advance the time, and tick as the recorder does."""
        end = self.now + duration
        while self.now < end:
            self.now = min(end, self.now + 100 * MS)
            self.tracker.tick(self.now, self.wall)

    def states(self, count: int, rig: str = "rig1", every: int = 20 * MS) -> list[Sent]:
        sent = []
        for _ in range(count):
            sent.append(self.sim.state(rig, self.wall))
            self.accept(self.sim.batch())
            self.wait(every)
        return sent

    def start(self, session: str = "s1", rig: str = "rig1") -> Sent:
        sent = self.edge.start(rig, session, self.wall)
        self.edge.command(rig, self.wall)
        self.accept(self.edge.batch())
        return sent

    def end(self, session: str = "s1", rig: str = "rig1") -> Sent:
        sent = self.edge.end(rig, session, self.wall)
        self.accept(self.edge.batch())
        return sent

    @property
    def file(self) -> FakeFile:
        [file] = self.store.files
        return file
