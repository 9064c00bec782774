"""A session that is being recorded: what belongs into its file, and what is known of its completeness."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from hilrig_recorder.mcap_format.channels import EVENT_CHANNEL, message_head

SECOND_NS: Final = 1_000_000_000
POSTROLL_NS: Final = SECOND_NS // 2
"""Messages stamped later than this after a session's end are not in its file."""


@dataclass(slots=True)
class Tally:
    """What is known of a recording's completeness."""

    lost_transport: int = 0
    """Messages missing from what a sender sent and the queue did not drop."""
    lost_recorder: int = 0
    """Messages dropped here: the queue was full, or the disk did not take them."""
    lost_batches: int = 0
    """Batches missing from the streams of the rig's services; their messages are counted above where they can be."""
    overruns: int = 0
    """Overrun events of the simulation."""
    missed_steps: int = 0
    """Steps given up, as those events say."""
    clock_steps: int = 0
    """Wall clocks that were set meanwhile, here or at a sender."""


class Sink(Protocol):
    """Where a recording's messages go."""

    def write(self, records: Sequence[bytes], /) -> None:
        """Take encoded messages, and write them. It must not raise: trouble with a file is the file's own."""


@dataclass(slots=True, eq=False)
class Recording:
    """A session that is being recorded."""

    rig: str
    session: str
    controller: str
    keeper: str
    """Source that began it and will end it, "<service>/<instance>"."""
    start_wall_ns: int
    """Its beginning, sender's wall clock, ns."""
    opened_ns: int
    """When it was opened here, monotonic clock, ns."""
    tally: Tally = field(default_factory=Tally)
    sink: Sink = field(init=False, repr=False)
    """Its file; another one after a rotation."""
    seen: set[tuple[int, int, int]] | None = None
    """Messages (channel, sequence, publish time) that an earlier file of this session holds; None: none is known."""
    last: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Last sequence and publish time of each channel in that earlier file."""
    horizon_ns: dict[int, int] = field(default_factory=dict)
    """Publish time of each channel before which `seen` does not say what that earlier file holds."""
    stated: int = 0
    """Messages that its tally has as lost already; a gap to that earlier file may be the same ones."""
    end_wall_ns: int | None = None
    """Its end, sender's wall clock, ns; None: it goes on."""
    end_reason: str = ""
    ended_ns: int = 0
    """When its end was learnt, monotonic clock, ns."""
    missing_statements: int = 0
    """How often in a row its keeper stated its sessions without it."""

    def take(self, records: Sequence[bytes], not_before_ns: int = 0) -> None:
        """Write what belongs into this file, of what arrived at `not_before_ns` (wall clock) or later."""
        if self.seen is not None or self.end_wall_ns is not None or not_before_ns:
            records = [record for record in records if self._wants(record, not_before_ns)]
        if records:
            self.sink.write(records)

    def _wants(self, record: bytes, not_before_ns: int) -> bool:
        head = message_head(record)
        if head.log_time < not_before_ns:
            return False
        if self.end_wall_ns is not None and head.publish_time > self.end_wall_ns + POSTROLL_NS:
            return False
        if self.seen is None:
            return True
        channel_id, sequence, publish_ns = head.channel_id, head.sequence, head.publish_time
        if (channel_id, sequence, publish_ns) in self.seen or publish_ns < self.horizon_ns.get(channel_id, 0):
            return False
        # The first new message of a channel with one sender tells what was missed between the files.
        if channel_id != EVENT_CHANNEL and channel_id in self.last:
            last_sequence, last_publish_ns = self.last.pop(channel_id)
            if publish_ns > last_publish_ns and sequence > last_sequence:
                gap = sequence - last_sequence - 1
                known = min(gap, self.stated)
                self.stated -= known
                self.tally.lost_recorder += gap - known
        return True


class Shelf(Protocol):
    """Where recordings are put; implemented by the recorder's files, and by a list in a test."""

    def open(self, recording: Recording) -> Sink | None:
        """Begin a recording's file; None: it must not or cannot be recorded. It may set `recording.seen` and
        `recording.last`."""

    def close(self, recording: Recording, end: str, reason: str) -> None:
        """End a recording's file; `end` is one word for programs, `reason` a sentence for people."""

    def lost(self, recording: Recording, source: str, key: str, transport: int, recorder: int) -> None:
        """Note where messages are missing."""

    def source(self, recording: Recording, source: str, incarnation: int) -> None:
        """Note that a run of a service contributes to a recording."""

    def refuse(self, what: str) -> None:
        """Tell the operator about something that was not understood."""
