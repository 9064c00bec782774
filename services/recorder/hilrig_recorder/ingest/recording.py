"""A session that is being recorded: selects the messages of its file and counts losses."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from hilrig_recorder.mcap_format.channels import EVENT_CHANNEL
from hilrig_recorder.mcap_format.ending import Ending
from hilrig_recorder.mcap_format.records import decode_message_head

SECOND_NS: Final = 1_000_000_000
POSTROLL_NS: Final = SECOND_NS // 2
"""Messages published later than this after the end of a session are not written to its file."""


@dataclass(slots=True)
class LossCounters:
    """Counts of losses and timing faults of one file; the names are keys of its metadata record `hilrig.summary`."""

    lost_transport: int = 0
    """Messages lost between a publisher and the ingest queue."""
    lost_recorder: int = 0
    """Messages lost in the recorder: the ingest queue was full, or a write failed."""
    lost_batches: int = 0
    """Batches missing in the recording streams of the rig's services. Their messages are counted above if possible."""
    overruns: int = 0
    """Overrun events of the simulation."""
    missed_steps: int = 0
    """Simulation steps that were skipped, according to these events."""
    clock_steps: int = 0
    """Wall clock steps during the session, on this machine or at a publisher."""


@dataclass(slots=True, eq=False)
class Recording:
    """A session that is being recorded."""

    rig: str
    session: str
    controller: str
    owner: str
    """Source that started the session and will end it, "<service>/<instance>"."""
    start_wall_ns: int
    """Start of the session, wall clock of the owner, ns."""
    opened_ns: int
    """When the recording was opened, monotonic clock, ns."""
    certificate: str = ""
    """Name in the controller's certificate; empty: it has none."""
    student: str = ""
    """Id of the student who owns the rig, several ones with commas; empty: none."""
    file: "RecordingOutput | None" = field(default=None, repr=False)
    """Its open file, set by the store; None: it has failed or is closed."""
    counters: LossCounters = field(default_factory=LossCounters)
    seen: set[tuple[int, int, int]] | None = None
    """(channel id, sequence, publish time) of messages in the previous segment; None: no duplicates are expected."""
    last: dict[int, tuple[int, int]] = field(default_factory=dict)
    """(sequence, publish time) of the last message in the previous segment, by channel id."""
    horizon_ns: dict[int, int] = field(default_factory=dict)
    """Publish time by channel id; `seen` does not cover older messages of the previous segment, so they are skipped."""
    silent_ns: dict[int, int] = field(default_factory=dict)
    """Time by channel id at which its messages stopped, according to the service that missed them, wall clock."""
    gaps: dict[int, int] = field(default_factory=dict)
    """Messages missing after the previous segment by channel id that have no loss record in the file yet."""
    counted_losses: int = 0
    """Losses already counted in `counters`; a gap after the previous segment may contain the same messages."""
    end_wall_ns: int | None = None
    """End of the session, wall clock of the owner, ns; None: the session is open."""
    end_reason: str = ""
    ended_ns: int = 0
    """When the end was received, monotonic clock, ns."""
    missing_announcements: int = 0
    """Consecutive session announcements of the owner that did not contain this session."""

    def count_loss(self, lost: LossCounters) -> None:
        """Add lost messages and batches to the counters of the file."""
        self.counters.lost_transport += lost.lost_transport
        self.counters.lost_recorder += lost.lost_recorder
        self.counters.lost_batches += lost.lost_batches
        self.counted_losses += lost.lost_transport + lost.lost_recorder

    def write(self, records: Sequence[bytes], not_before_ns: int = 0) -> None:
        """Write those messages that belong to this file and arrived at `not_before_ns` (wall clock) or later."""
        if self.seen is not None or self.end_wall_ns is not None or not_before_ns:
            records = [record for record in records if self._accepts(record, not_before_ns)]
        if records and self.file is not None:
            self.file.write(records)

    def _accepts(self, record: bytes, not_before_ns: int) -> bool:
        header = decode_message_head(record)
        if header.log_time < not_before_ns:
            return False
        if self.end_wall_ns is not None and header.publish_time > self.end_wall_ns + POSTROLL_NS:
            return False
        if self.seen is None:
            return True
        channel_id, sequence, publish_ns = header.channel_id, header.sequence, header.publish_time
        if (channel_id, sequence, publish_ns) in self.seen or publish_ns < self.horizon_ns.get(channel_id, 0):
            return False
        # The first new message of a channel with a single publisher shows how many messages are missing between the
        # segments.
        if channel_id != EVENT_CHANNEL and channel_id in self.last:
            last_sequence, last_publish_ns = self.last.pop(channel_id)
            if publish_ns > last_publish_ns:
                gap = sequence - last_sequence - 1
                if gap < 0:
                    # Its publisher was restarted meanwhile: its numbers do not tell how many it had published before.
                    gap = self._estimate_gap(channel_id, last_publish_ns, publish_ns)
                known = min(gap, self.counted_losses)
                self.counted_losses -= known
                if gap > known:
                    self.counters.lost_recorder += gap - known
                    self.gaps[channel_id] = gap - known
        return True

    def count_recorded(self, channel_id: int, numbers: range, incarnation: int) -> int:
        """Return how many messages of a publisher, by its incarnation and their numbers, the previous segment has."""
        return sum(
            channel == channel_id and sequence in numbers and publish_ns >= incarnation
            for channel, sequence, publish_ns in self.seen or ()
        )

    def _estimate_gap(self, channel_id: int, begin_ns: int, restarted_ns: int) -> int:
        """Estimate how many messages a restarted publisher had published, at the rate of the second before the gap."""
        silent_ns = self.silent_ns.get(channel_id, 0)
        # An earlier report is of another outage.
        end_ns = min(silent_ns, restarted_ns) if silent_ns > begin_ns - SECOND_NS else restarted_ns
        per_second = sum(
            channel == channel_id and begin_ns - SECOND_NS < publish_ns <= begin_ns
            for channel, _, publish_ns in self.seen or ()
        )
        return max(0, round(per_second * (end_ns - begin_ns) / SECOND_NS))


class RecordingOutput(Protocol):
    """The open file of a recording; implemented by `storage.segment_file.SegmentFile`."""

    def write(self, records: Sequence[bytes]) -> None:
        """Write encoded messages. It must not raise: write errors are handled."""


class RecordingStore(Protocol):
    """Storage of recordings; implemented by `storage.store.FileStore`."""

    def open(self, recording: Recording) -> bool:
        """Open the file of a recording and set `recording.file`; False: it must not or can't be recorded.

        It may set `recording.seen`, `recording.last` and `recording.horizon_ns`.
        """

    def close(self, recording: Recording, end: Ending, reason: str) -> None:
        """Finish the file of a recording; `reason` is a sentence."""

    def record_loss(self, recording: Recording, source: str, key: str, transport: int, recorder: int) -> None:
        """Record a loss in the file: number of messages lost in transport and in the recorder."""

    def record_source(self, recording: Recording, source: str, incarnation: int) -> None:
        """Record in the file that an instance of a service contributes to the recording."""

    def report_outage(self, recordings: Sequence[Recording], text: str, *, has_ended: bool) -> None:
        """Report to the operator, and in these recordings, that messages stopped or arrive again."""

    def report_rejected(self, message: str) -> None:
        """Report input that is not recorded to the operator."""
