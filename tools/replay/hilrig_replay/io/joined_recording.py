"""The segments of one session as one recording: metadata merged, losses added, and each message once."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, TypeAlias

from hilrig_recorder.mcap_format.records import Message
from hilrig_replay.io.extent import StateRange
from hilrig_replay.io.recording_file import RecordingFile, open_recording
from hilrig_schemas.topics import RECORDED

OVERLAP_NS: Final = 60_000_000_000
"""Messages of this time before the end of a segment are compared with those of the next ones."""
_NUMBERED: Final = ("hilrig.config", "hilrig.source", "hilrig.loss")
"""Kinds of metadata records of which a file has several, with a number from 2."""
_COUNTS: Final = (
    "lost_transport",
    "lost_recorder",
    "lost_batches",
    "overruns",
    "missed_steps",
    "clock_steps",
    "messages",
)
_RECOVERED: Final = ("messages", "chunks", "damaged_chunks", "damaged_bytes", "torn_bytes", "orphans")

_Key: TypeAlias = tuple[int, int, int]
_Metadata: TypeAlias = dict[str, dict[str, str]]


@dataclass(frozen=True)
class JoinedRecording(RecordingFile):
    """Segments of a session, read as one recording; create it with `open_segments`."""

    segments: tuple[RecordingFile, ...] = ()
    channel_ids: tuple[dict[int, int], ...] = ()
    """Id of each channel in `topics` by its id in the segment."""
    repeated: tuple[frozenset[_Key], ...] = ()
    """Channel id, sequence and time of the messages of each segment that earlier ones contain."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files that it is read from."""
        return tuple(segment.path for segment in self.segments)

    def messages(
        self, topics: frozenset[str], *, from_ns: int | None = None, until_ns: int | None = None
    ) -> Iterator[Message]:
        """The messages of some topics, segment by segment; arguments and errors as `RecordingFile.messages`."""
        for segment, ids, repeated in zip(self.segments, self.channel_ids, self.repeated, strict=True):
            found = _renumbered(segment.messages(topics, from_ns=from_ns, until_ns=until_ns), ids)
            yield from (message for message in found if _key(message) not in repeated) if repeated else found

    @cached_property
    def states(self) -> StateRange | None:
        """The first and the last state; None: there are no states, or no index of them."""
        found = [one.states for one in self.segments if one.states is not None]
        return StateRange(found[0].first, found[-1].last) if found else None


def open_segments(paths: Sequence[Path]) -> RecordingFile:
    """Open the files of one run, in their order.

    Raises:
        InputError: as `open_recording`, for each file.
    """
    segments = tuple(map(open_recording, paths))
    if len(segments) == 1:
        return segments[0]
    topics = dict(segments[0].topics)
    channel_ids = []
    for segment in segments:
        known = {topic: channel for channel, topic in topics.items()}
        for topic in segment.topics.values():
            if topic not in known:
                known[topic] = max(topics, default=0) + 1
                topics[known[topic]] = topic
        channel_ids.append({channel: known[topic] for channel, topic in segment.topics.items()})
    repeated = tuple(_repeated(segments, channel_ids))
    counts = {topic: sum(segment.counts[topic] for segment in segments) for topic in RECORDED}
    for keys in repeated:
        for channel, _, _ in keys:
            counts[topics[channel]] -= 1
    # Each segment has those of its simulation; the same one is kept once.
    attachments = {(item.name, item.data): item for segment in segments for item in segment.attachment_records}
    return JoinedRecording(
        path=segments[0].path,
        metadata=_merged([segment.metadata for segment in segments], sum(map(len, repeated))),
        attachment_records=tuple(attachments.values()),
        counts=counts,
        start_ns=min(segment.start_ns for segment in segments),
        end_ns=max(segment.end_ns for segment in segments),
        topics=topics,
        _chunks=segments[0]._chunks[:0],
        segments=segments,
        channel_ids=tuple(channel_ids),
        repeated=repeated,
    )


def _repeated(segments: Sequence[RecordingFile], channel_ids: Sequence[dict[int, int]]) -> Iterator[frozenset[_Key]]:
    """Keys of the messages at the beginning of each segment that the last minute of the earlier ones contains."""
    topics = frozenset(RECORDED)
    tails: list[tuple[int, set[_Key]]] = []
    for segment, ids in zip(segments, channel_ids, strict=True):
        newest_ns = max((end_ns for end_ns, _ in tails), default=0)
        known = {key for end_ns, keys in tails if end_ns >= newest_ns - OVERLAP_NS for key in keys}
        head = segment.messages(topics, until_ns=segment.start_ns + OVERLAP_NS) if known else iter(())
        yield frozenset(known & set(map(_key, _renumbered(head, ids))))
        tail = segment.messages(topics, from_ns=segment.end_ns - OVERLAP_NS)
        tails.append((segment.end_ns, set(map(_key, _renumbered(tail, ids)))))


def _renumbered(messages: Iterator[Message], ids: Mapping[int, int]) -> Iterator[Message]:
    if all(channel == own for channel, own in ids.items()):
        return messages
    return (message._replace(channel_id=ids[message.channel_id]) for message in messages)


def _key(message: Message) -> _Key:
    return message.channel_id, message.sequence, message.publish_time


def _merged(records: Sequence[_Metadata], repeated: int) -> _Metadata:
    """The metadata of all segments: each different configuration, source and loss once, and the sums of the counts."""
    merged: _Metadata = {}
    found: dict[str, set[tuple[tuple[str, str], ...]]] = {kind: set() for kind in _NUMBERED}
    for name, values in ((name, values) for one in records for name, values in one.items()):
        kind = ".".join(name.split(".")[:2])
        if kind not in found:
            # The session is that of the first segment, everything else that of the last one.
            merged[name] = merged[name] if name == "hilrig.session" and name in merged else dict(values)
        elif (content := tuple(values.items())) not in found[kind]:
            found[kind].add(content)
            merged[kind if len(found[kind]) == 1 else f"{kind}.{len(found[kind])}"] = dict(values)
    if "hilrig.session" in merged:
        last = records[-1].get("hilrig.session", {})
        merged["hilrig.session"]["last_part"] = last.get("last_part", last.get("part", "1"))
    if summaries := [one["hilrig.summary"] for one in records if "hilrig.summary" in one]:
        counts = {key: sum(int(one.get(key, 0)) for one in summaries) for key in _COUNTS}
        counts["messages"] = max(0, counts["messages"] - repeated)
        merged["hilrig.summary"] |= {key: str(count) for key, count in counts.items()}
    if recovered := [one["hilrig.recovered"] for one in records if "hilrig.recovered" in one]:
        total = {key: sum(int(one.get(key, 0)) for one in recovered) for key in _RECOVERED}
        # The end of the run is missing only if that of its last segment is; gaps between segments are counted as lost.
        at_end = int(records[-1].get("hilrig.recovered", {}).get("torn_bytes", 0))
        total["damaged_bytes"] += at_end - total["torn_bytes"]
        total["torn_bytes"] = at_end
        merged["hilrig.recovered"] |= {key: str(count) for key, count in total.items()}
    return merged
