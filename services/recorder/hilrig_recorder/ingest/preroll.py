"""The last seconds of one rig, in sessions or not, so that a session's file can begin before its start.

Messages are encoded as they come and wait until they are cut off as a block, about once a second: a block goes into
every file that is open, and stays as pre-roll for the next. Nothing about a message is kept but its record: for a large
lab these are a hundred thousand, and keeping them must not cost as much as recording them.
"""

from collections import deque
from dataclasses import dataclass, field

from hilrig_recorder.ingest.recording import Recording
from hilrig_recorder.ingest.sources import Source


@dataclass(slots=True, eq=False)
class RigLog:
    """What is kept of a rig; times are wall clock, ns, where they are not said to be monotonic."""

    name: str
    due_ns: int = 0
    """When the next block is cut off, monotonic clock."""
    recordings: list[Recording] = field(default_factory=list)
    sources: dict[str, Source] = field(default_factory=dict)
    """The run of each service, by name, that sends of this rig."""
    waiting: list[bytes] = field(default_factory=list)
    """Messages that are in no block yet; always the same list."""
    _blocks: deque[tuple[int, list[bytes]]] = field(default_factory=deque)
    _losses: deque[tuple[int, int, int]] = field(default_factory=deque)

    def cut(self, wall_ns: int) -> None:
        """Make a block of what waits, and give it to the recordings."""
        if not self.waiting:
            return
        block = self.waiting.copy()
        self.waiting.clear()
        self._blocks.append((wall_ns, block))
        # A recording whose disk fails takes itself out.
        for recording in self.recordings.copy():
            recording.take(block)

    def lose(self, wall_ns: int, transport: int, recorder: int) -> None:
        """Count messages that are missing, in every recording and for those that begin soon."""
        self._losses.append((wall_ns, transport, recorder))
        for recording in self.recordings:
            self._state(recording, transport, recorder)

    def begin(self, recording: Recording, horizon_ns: int) -> None:
        """Let a recording begin with what arrived since `horizon_ns`; what waits must have been cut off before."""
        for _, transport, recorder in self._losses:
            self._state(recording, transport, recorder)
        self.recordings.append(recording)
        recording.take([record for _, block in self._blocks for record in block], horizon_ns)

    @staticmethod
    def _state(recording: Recording, transport: int, recorder: int) -> None:
        recording.tally.lost_transport += transport
        recording.tally.lost_recorder += recorder
        recording.stated += transport + recorder

    def forget(self, horizon_ns: int, wall_ns: int) -> None:
        """Drop what is older than `horizon_ns`."""
        # A clock set back would keep what is stamped in its future for ever.
        while self._blocks and not horizon_ns <= self._blocks[0][0] <= wall_ns:
            self._blocks.popleft()
        while self._losses and not horizon_ns <= self._losses[0][0] <= wall_ns:
            self._losses.popleft()
