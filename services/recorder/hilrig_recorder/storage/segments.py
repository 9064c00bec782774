"""The segment files of one session: their names, and the last messages of earlier segments.

The first segment is `<session>.mcap`. When a session needs another file (after a recorder restart, a rotation or a full
disk) it is `<session>.2.mcap`, and its metadata names the previous segment.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC, EVENT_CHANNEL
from hilrig_recorder.mcap_format.file_names import part_path, recording_name, segment_number
from hilrig_recorder.mcap_format.recover import SegmentTail, read_tail
from hilrig_runtime.errors import InputError


@dataclass(frozen=True, slots=True)
class NextSegment:
    """The file in which a session continues."""

    path: Path
    number: int
    """Number of the segment, from 1."""
    previous: Path | None
    """The previous segment; None: this is the first."""


def next_segment(folder: Path, session: str, after: str = "") -> NextSegment:
    """The segment after the last one of a session, finished or not, and after the file with the name `after`.

    Earlier segments may already be deleted or moved.

    Raises:
        OSError: the folder can't be listed.
    """
    try:
        names = [path.name for path in folder.iterdir()]
    except FileNotFoundError:
        # The folder is created later.
        names = []
    number = max(segment_number(name, session) for name in (*names, after))
    previous = folder / recording_name(session, number) if number else None
    return NextSegment(folder / recording_name(session, number + 1), number + 1, previous)


def read_session_tail(folder: Path, session: str, number: int, tail_ns: int) -> SegmentTail:
    """Read the last `tail_ns` of a session, from segment `number` backward; after restarts, segments may be short."""
    tail = _read_tail(folder / recording_name(session, number), tail_ns)
    last_ns = tail.last_ns
    while number > 1 and (not last_ns or abs(last_ns - tail.last_ns) < tail_ns):
        number -= 1
        before = _read_tail(folder / recording_name(session, number), tail_ns)
        last_ns = last_ns or before.last_ns
        reached_ns = before.last_ns or tail.last_ns
        tail = SegmentTail(tail.end, tail.keys | before.keys, {**before.last, **tail.last}, reached_ns)
    return tail


def horizon_by_channel(tail: SegmentTail) -> dict[int, int]:
    """Publish time from which `tail` contains all messages, by channel id.

    A channel is recorded in order. Events have several publishers, whose clocks may differ. For events, and for
    channels without messages in `tail`, the result is the earliest publish time of all channels.
    """
    earliest = min((publish_ns for _, _, publish_ns in tail.keys), default=0)
    horizon_ns = dict.fromkeys(CHANNEL_OF_TOPIC.values(), 0)
    for channel_id, _, publish_ns in tail.keys:
        horizon_ns[channel_id] = min(horizon_ns[channel_id] or publish_ns, publish_ns)
    horizon_ns[EVENT_CHANNEL] = 0
    return {channel_id: publish_ns or earliest for channel_id, publish_ns in horizon_ns.items()}


def _read_tail(path: Path, tail_ns: int) -> SegmentTail:
    # The file may be renamed meanwhile, by the sync worker or by a recovery.
    for candidate in (path, part_path(path), path):
        with contextlib.suppress(InputError):
            return read_tail(candidate, tail_ns)
    return SegmentTail("", set(), {}, 0)
