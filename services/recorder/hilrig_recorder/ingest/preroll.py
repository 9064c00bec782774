"""Pre-roll buffer: the last seconds of one rig, so that a session's file can begin before the start of the session.

Messages are encoded on arrival and collected until they are flushed as a block, about once a second. A block is written
to every open file and stays in the buffer as pre-roll of the next session. Only the encoded records are stored: in a
large lab these are a hundred thousand, and buffering must cost less than recording.
"""

from collections import deque
from dataclasses import dataclass, field

from hilrig_recorder.ingest.recording import LossCounters, Recording
from hilrig_recorder.ingest.sources import PublisherState


@dataclass(slots=True, eq=False)
class PreRollBuffer:
    """Buffered messages, publishers and open recordings of a rig; times are wall clock, ns, except `due_ns`."""

    name: str
    due_ns: int = 0
    """Time of the next block, monotonic clock, ns."""
    recordings: list[Recording] = field(default_factory=list)
    publishers: dict[str, PublisherState] = field(default_factory=dict)
    """The current instance of each service that publishes messages of this rig, by source."""
    pending: list[bytes] = field(default_factory=list)
    """Encoded messages that are not in a block yet. `SessionTracker.accept` appends to this list object."""
    _blocks: deque[tuple[int, list[bytes]]] = field(default_factory=deque)
    _losses: deque[tuple[int, LossCounters]] = field(default_factory=deque)

    def flush_block(self, wall_ns: int) -> None:
        """Move the pending messages into a block and write it to the open recordings."""
        if not self.pending:
            return
        block = self.pending.copy()
        self.pending.clear()
        self._blocks.append((wall_ns, block))
        # A recording whose write fails removes itself from the list.
        for recording in self.recordings.copy():
            recording.write(block)

    def record_loss(self, wall_ns: int, lost: LossCounters) -> None:
        """Count lost messages or batches, in the open recordings and in those that start within the pre-roll time."""
        self._losses.append((wall_ns, lost))
        for recording in self.recordings:
            recording.count_loss(lost)

    def add(self, recording: Recording, horizon_ns: int) -> None:
        """Add a recording and write the messages that arrived since `horizon_ns`. Call `flush_block` before."""
        for _, lost in self._losses:
            recording.count_loss(lost)
        self.recordings.append(recording)
        recording.write([record for _, block in self._blocks for record in block], horizon_ns)

    def evict(self, horizon_ns: int, wall_ns: int) -> None:
        """Remove blocks and losses older than `horizon_ns`."""
        # Entries stamped in the future are removed too: after a backward clock step they would stay for hours.
        while self._blocks and not horizon_ns <= self._blocks[0][0] <= wall_ns:
            self._blocks.popleft()
        while self._losses and not horizon_ns <= self._losses[0][0] <= wall_ns:
            self._losses.popleft()
