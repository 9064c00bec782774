"""Which rig is in which session, and what therefore goes into which file: the recorder's core, without clock or disk.

Every message of a rig is kept for `preroll_s`, in sessions or not, so that a session's file begins before its start.
A session begins with its `SESSION_START` event, or when its keeper states it (the event may be lost, or older than
the recorder); it ends with `SESSION_END`, when its keeper states its sessions without it, or when the keeper has
been silent too long. Its file stays open a little longer, until the streams of the rig's other services have
passed the end, by their own stamps.

Of the messages nothing is decoded but events.
"""

import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain
from typing import Final, Protocol

from google.protobuf.message import DecodeError

from hilrig_recorder.channels import CHANNEL_OF_TOPIC, encode_message, message_head
from hilrig_recorder.intake import Arrival
from hilrig_runtime.logstream import entries_of
from hilrig_schemas import Event, LogBatch, OpenSession
from hilrig_schemas.topics import EVENT, is_name, parse_rig_key

SECOND_NS: Final = 1_000_000_000
LINGER_MIN_NS: Final = SECOND_NS // 5
"""A file stays open at least so long after its session's end."""
IDLE_NS: Final = SECOND_NS
"""A service with nothing to send still states its sessions within this time."""
LINGER_MAX_NS: Final = 10 * SECOND_NS
"""A service that has not passed the end by then is not waited for: its log stream's cache reaches no further back."""
POSTROLL_NS: Final = SECOND_NS // 2
"""Messages stamped later than this after a session's end are not in its file."""
KEEPER_SILENCE_NS: Final = 30 * SECOND_NS
"""A session whose keeper is silent so long has ended."""
CLOCK_STEP_NS: Final = 50_000_000
"""A wall clock that moves against a monotonic one by more than this has been set."""
RETRY_NS: Final = 10 * SECOND_NS
"""A session that could not be recorded is tried again after this."""
_FORGET_PERIOD_NS: Final = SECOND_NS // 2
_SETTLING_NS: Final = 15 * SECOND_NS
_MEMORY_NS: Final = 120 * SECOND_NS
_SESSION_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:-]{0,127}")
_EVENT_CHANNEL: Final = CHANNEL_OF_TOPIC[EVENT.name]


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

    def add(self, channel_id: int, log_time: int, record: bytes, /) -> None:
        """Take one encoded message. It must not raise: trouble with a file is the file's own."""


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
    add: Callable[[int, int, bytes], None] = field(init=False, repr=False)
    """The sink's `add`."""
    seen: set[tuple[int, int, int]] | None = None
    """Messages (channel, sequence, publish time) that an earlier file of this session holds; None: none is known."""
    last: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Last sequence and publish time of each channel in that earlier file."""
    end_wall_ns: int | None = None
    """Its end, sender's wall clock, ns; None: it goes on."""
    end_reason: str = ""
    ended_ns: int = 0
    """When its end was learnt, monotonic clock, ns."""
    selective: bool = False
    """Whether messages must be looked at before they are added: `wants`."""
    missing_statements: int = 0

    def wants(self, channel_id: int, sequence: int, publish_ns: int) -> bool:
        """Whether a message belongs into this file."""
        if self.end_wall_ns is not None and publish_ns > self.end_wall_ns + POSTROLL_NS:
            return False
        if self.seen is None:
            return True
        if (channel_id, sequence & 0xFFFFFFFF, publish_ns) in self.seen:
            return False
        # The first new message of a channel with one sender tells what was missed between the files.
        if channel_id != _EVENT_CHANNEL and channel_id in self.last:
            last_sequence, last_publish_ns = self.last.pop(channel_id)
            if publish_ns > last_publish_ns and sequence > last_sequence:
                self.tally.lost_recorder += sequence - last_sequence - 1
        return True

    def forget_seen(self) -> None:
        """Stop comparing with the earlier file: what could come twice has come."""
        self.seen = None
        self.selective = self.end_wall_ns is not None


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


@dataclass(slots=True, eq=False)
class _Rig:
    name: str
    recordings: list[Recording] = field(default_factory=list)
    # Encoded messages and nothing about them, in blocks with the time of their end: for a large lab these are a
    # hundred thousand objects, and forgetting them must not cost as much as recording them.
    preroll: deque[tuple[int, list[bytes]]] = field(default_factory=deque)
    newest: list[bytes] = field(default_factory=list)
    # log time, transport, recorder: losses within the pre-roll
    losses: deque[tuple[int, int, int]] = field(default_factory=deque)
    sources: dict[str, "_Source"] = field(default_factory=dict)


@dataclass(slots=True, eq=False)
class _Stream:
    """One sender on one key."""

    key: str
    rig: _Rig
    channel_id: int
    expected: int
    """Next sequence number; 0: any."""


@dataclass(slots=True, eq=False)
class _Source:
    """One run of a service."""

    name: str
    incarnation: int
    first_ns: int
    fresh: bool
    """Whether it began while the recorder listened: then its first message on a key has the number 1."""
    last_ns: int = 0
    last_publish_ns: int = 0
    next_batch: int = 0
    streams: dict[str, _Stream | None] = field(default_factory=dict)
    offset_ns: int | None = None
    """Largest difference seen between its stamps and this process's monotonic clock, ns."""
    steady: set[str] = field(default_factory=set)
    """Rigs of which it sends more than events."""


class SessionBook:
    """Follows the log streams; time is passed in: arrival on the wall clock, and `now_ns` of the monotonic clock."""

    def __init__(self, lab: str, preroll_s: float, shelf: Shelf) -> None:
        self._lab = lab
        self._preroll_ns = round(preroll_s * SECOND_NS)
        self._shelf = shelf
        self._rigs: dict[str, _Rig] = {}
        self._sources: dict[tuple[str, int], _Source] = {}
        self._recordings: dict[str, Recording] = {}
        self._over: dict[str, int] = {}
        self._wall_ns = 0
        self._forget_due_ns = 0
        self._clock_offset_ns: int | None = None
        self._clock_step_ns = -_SETTLING_NS
        self._refused: set[str] = set()
        self.lost_transport = 0
        self.lost_recorder = 0
        self.messages = 0

    @property
    def recordings(self) -> list[Recording]:
        """The recordings that are open."""
        return list(self._recordings.values())

    # -- what comes in ----------------------------------------------------------------------------------------------

    def accept(self, arrival: Arrival, now_ns: int) -> None:
        """Take one batch."""
        batch = arrival.batch
        log_time = self._wall_ns = arrival.wall_ns
        source = self._source(arrival, now_ns)
        streams = source.streams
        for key, sequence, publish_ns, payload in entries_of(batch):
            stream = streams.get(key) or self._stream(source, key)
            if stream is None:
                continue
            if sequence != stream.expected and not self._gap(source, stream, sequence, log_time):
                continue
            stream.expected = sequence + 1
            channel_id = stream.channel_id
            record = encode_message(channel_id, sequence, log_time, publish_ns, payload)
            rig = stream.rig
            rig.newest.append(record)
            for recording in rig.recordings:
                if not recording.selective or recording.wants(channel_id, sequence, publish_ns):
                    recording.add(channel_id, log_time, record)
            if channel_id == _EVENT_CHANNEL:
                self._event(source, payload, publish_ns, now_ns)
        self.messages += len(batch.keys)
        for key, drop in arrival.dropped.items():
            stream = streams.get(key) or self._stream(source, key)
            if stream is not None:
                missing = drop.last_sequence + 1 - stream.expected if stream.expected else drop.count
                stream.expected = drop.last_sequence + 1
                self._lose(source, stream, max(0, missing - drop.count), drop.count, log_time)
        if batch.sessions or batch.complete_sessions:
            self._statement(source, batch, now_ns)

    def _source(self, arrival: Arrival, now_ns: int) -> _Source:
        batch = arrival.batch
        identity = (batch.source, batch.incarnation)
        source = self._sources.get(identity)
        if source is None:
            fresh = any(name == batch.source for name, _ in self._sources)
            source = self._sources[identity] = _Source(*identity, first_ns=now_ns, fresh=fresh)
        if source.next_batch and batch.sequence > source.next_batch:
            missing = batch.sequence - source.next_batch - (arrival.batches - 1)
            if missing > 0:
                for recording in self._of_source(source):
                    recording.tally.lost_batches += missing
        source.next_batch = max(source.next_batch, batch.sequence + 1)
        source.last_ns = now_ns
        if batch.keys:
            self._watch_clock(source, batch.publish_wall_ns[-1], now_ns)
        return source

    def _stream(self, source: _Source, key: str) -> _Stream | None:
        if key in source.streams:
            return None
        source.streams[key] = None
        try:
            parsed = parse_rig_key(key)
        except ValueError as error:
            self._refuse(f"{source.name}: {error}")
            return None
        channel_id = CHANNEL_OF_TOPIC.get(parsed.topic.name)
        if channel_id is None or parsed.lab != self._lab or not is_name(parsed.rig):
            self._refuse(f"{source.name}: {key} is nothing that lab {self._lab} records")
            return None
        rig = self._rigs.setdefault(parsed.rig, _Rig(parsed.rig))
        stream = source.streams[key] = _Stream(key, rig, channel_id, 1 if source.fresh else 0)
        if channel_id != _EVENT_CHANNEL:
            source.steady.add(rig.name)
        if rig.sources.get(source.name) is not source:
            rig.sources[source.name] = source
            for recording in rig.recordings:
                self._shelf.source(recording, source.name, source.incarnation)
        return stream

    def _gap(self, source: _Source, stream: _Stream, sequence: int, log_time: int) -> bool:
        """Handle a sequence number that was not expected; whether the message is new."""
        if stream.expected and sequence < stream.expected:
            return False
        if stream.expected:
            self._lose(source, stream, sequence - stream.expected, 0, log_time)
        return True

    def _lose(self, source: _Source, stream: _Stream, transport: int, recorder: int, log_time: int) -> None:
        self.lost_transport += transport
        self.lost_recorder += recorder
        rig = stream.rig
        rig.losses.append((log_time, transport, recorder))
        for recording in rig.recordings:
            recording.tally.lost_transport += transport
            recording.tally.lost_recorder += recorder
            self._shelf.lost(recording, source.name, stream.key, transport, recorder)

    def _refuse(self, what: str) -> None:
        # Each thing once, and not without end.
        if what not in self._refused and len(self._refused) < 1000:
            self._refused.add(what)
            self._shelf.refuse(what)

    # -- clocks -----------------------------------------------------------------------------------------------------

    def _watch_clock(self, source: _Source, publish_ns: int, now_ns: int) -> None:
        # A delay lowers the difference, an outage by much; only a clock set forward lifts it, and only one set
        # backward makes stamps fall.
        offset_ns = publish_ns - now_ns
        if source.offset_ns is None:
            source.offset_ns = offset_ns
        elif publish_ns < source.last_publish_ns - CLOCK_STEP_NS:
            source.offset_ns = offset_ns
            self._count_clock_step(now_ns)
        elif offset_ns > source.offset_ns:
            if offset_ns > source.offset_ns + CLOCK_STEP_NS and now_ns - source.first_ns > _SETTLING_NS:
                self._count_clock_step(now_ns)
            source.offset_ns = offset_ns
        source.last_publish_ns = publish_ns

    def _count_clock_step(self, now_ns: int) -> None:
        # One setting is seen at each sender on the machine, and here.
        if now_ns - self._clock_step_ns > SECOND_NS:
            for recording in self._recordings.values():
                recording.tally.clock_steps += 1
        self._clock_step_ns = now_ns

    # -- sessions ---------------------------------------------------------------------------------------------------

    def _event(self, source: _Source, payload: bytes, publish_ns: int, now_ns: int) -> None:
        try:
            event = Event.FromString(payload)
        except DecodeError:
            self._refuse(f"{source.name}: an event that can't be decoded")
            return
        if event.kind == Event.SESSION_START:
            self._begin(source.name, event.rig, event.session, event.session_data.controller, event.wall_ns, now_ns)
        elif event.kind == Event.SESSION_END:
            self._over[event.session] = now_ns + _MEMORY_NS
            recording = self._recordings.get(event.session)
            if recording is not None:
                self._end(recording, event.session_data.reason or "ended", publish_ns, now_ns)
        elif event.kind == Event.OVERRUN:
            # An overrun without a rig is one of the whole simulation.
            for recording in self._of_source(source):
                if event.rig in ("", recording.rig):
                    recording.tally.overruns += 1
                    recording.tally.missed_steps += event.overrun_data.missed_steps

    def _statement(self, source: _Source, batch: LogBatch, now_ns: int) -> None:
        listed = {session.session: session for session in batch.sessions}
        for session in listed.values():
            self._state(source, session, now_ns)
        if not batch.complete_sessions:
            return
        for recording in self._recordings.values():
            if recording.keeper != source.name or recording.end_wall_ns is not None:
                continue
            if recording.session in listed:
                recording.missing_statements = 0
                continue
            # A statement may be older than the event that was sent with it.
            recording.missing_statements += 1
            if recording.missing_statements >= 2:
                self._end(recording, f"{source.name} does not keep it any more", source.last_publish_ns, now_ns)

    def _state(self, source: _Source, session: OpenSession, now_ns: int) -> None:
        if session.session not in self._recordings:
            self._begin(source.name, session.rig, session.session, session.controller, session.start_wall_ns, now_ns)

    def _begin(
        self, keeper: str, rig_name: str, session: str, controller: str, start_wall_ns: int, now_ns: int
    ) -> None:
        if session in self._recordings or session in self._over:
            return
        if not _SESSION_ID.fullmatch(session) or not is_name(rig_name):
            self._refuse(f"{keeper}: {session!r} of {rig_name!r} is no name for a recording")
            return
        rig = self._rigs.setdefault(rig_name, _Rig(rig_name))
        recording = Recording(rig_name, session, controller, keeper, start_wall_ns, now_ns)
        sink = self._shelf.open(recording)
        if sink is None:
            self._over[session] = now_ns + RETRY_NS
            return
        recording.add = sink.add
        recording.selective = recording.seen is not None
        for source in rig.sources.values():
            self._shelf.source(recording, source.name, source.incarnation)
        for _, transport, recorder in rig.losses:
            recording.tally.lost_transport += transport
            recording.tally.lost_recorder += recorder
        horizon_ns = self._wall_ns - self._preroll_ns
        for record in chain.from_iterable((*(block for _, block in rig.preroll), rig.newest)):
            head = message_head(record)
            if head.log_time >= horizon_ns and recording.wants(head.channel_id, head.sequence, head.publish_time):
                recording.add(head.channel_id, head.log_time, record)
        self._recordings[session] = recording
        rig.recordings.append(recording)

    def _end(self, recording: Recording, reason: str, end_wall_ns: int, now_ns: int) -> None:
        if recording.end_wall_ns is None:
            recording.end_wall_ns = end_wall_ns
            recording.end_reason = reason
            recording.ended_ns = now_ns
            recording.selective = True

    def _of_source(self, source: _Source) -> list[Recording]:
        return [
            recording
            for recording in self._recordings.values()
            if self._rigs[recording.rig].sources.get(source.name) is source
        ]

    # -- time -------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int, wall_ns: int) -> None:
        """Do what time brings, some times a second: forget old pre-roll, close what has ended, watch the clock."""
        offset_ns = wall_ns - now_ns
        if self._clock_offset_ns is not None and abs(offset_ns - self._clock_offset_ns) > CLOCK_STEP_NS:
            self._count_clock_step(now_ns)
        self._clock_offset_ns = offset_ns
        if now_ns >= self._forget_due_ns:
            self._forget_due_ns = now_ns + _FORGET_PERIOD_NS
            self._forget_preroll(wall_ns)
        heard: dict[str, int] = {}
        for source in self._sources.values():
            heard[source.name] = max(heard.get(source.name, 0), source.last_ns)
        for recording in self.recordings:
            if recording.seen is not None and now_ns - recording.opened_ns > _SETTLING_NS:
                recording.forget_seen()
            if recording.end_wall_ns is None:
                self._watch_keeper(recording, heard.get(recording.keeper, 0), now_ns)
            elif self._is_complete(recording, now_ns):
                self._close(recording, "ended", recording.end_reason)
        for session, until_ns in list(self._over.items()):
            if now_ns > until_ns:
                del self._over[session]
        self._forget_sources(now_ns)

    def _forget_preroll(self, wall_ns: int) -> None:
        horizon = wall_ns - self._preroll_ns
        for rig in self._rigs.values():
            if rig.newest:
                rig.preroll.append((wall_ns, rig.newest))
                rig.newest = []
            # A clock set back would keep what is stamped in its future for ever.
            while rig.preroll and not horizon <= rig.preroll[0][0] <= wall_ns:
                rig.preroll.popleft()
            while rig.losses and not horizon <= rig.losses[0][0] <= wall_ns:
                rig.losses.popleft()

    def _watch_keeper(self, recording: Recording, heard_ns: int, now_ns: int) -> None:
        if now_ns - max(heard_ns, recording.opened_ns) > KEEPER_SILENCE_NS:
            reason = f"{recording.keeper} was not heard for {KEEPER_SILENCE_NS // SECOND_NS} s"
            # Not over for good: when the keeper comes back and states it, it goes on in a next file.
            self.drop(recording)
            self._shelf.close(recording, "keeper lost", reason)

    def _is_complete(self, recording: Recording, now_ns: int) -> bool:
        lingered_ns = now_ns - recording.ended_ns
        if lingered_ns >= LINGER_MAX_NS:
            return True
        end_wall_ns = recording.end_wall_ns or 0
        # A stream is in order: it has passed the end when its stamps have, or, where nothing is left to be sent,
        # when a batch of it has come well after the end.
        return lingered_ns >= LINGER_MIN_NS and all(
            source.last_publish_ns >= end_wall_ns or source.last_ns >= recording.ended_ns + IDLE_NS
            for source in self._rigs[recording.rig].sources.values()
            if recording.rig in source.steady
        )

    def _forget_sources(self, now_ns: int) -> None:
        for identity, source in list(self._sources.items()):
            if now_ns - source.last_ns > _MEMORY_NS:
                del self._sources[identity]
                for rig in self._rigs.values():
                    if rig.sources.get(source.name) is source:
                        del rig.sources[source.name]

    def stop(self) -> None:
        """Close every recording: the recorder ends."""
        for recording in self.recordings:
            if recording.end_wall_ns is None:
                self._close(recording, "recorder stopped", "the recorder was stopped while the session went on")
            else:
                self._close(recording, "ended", recording.end_reason)

    def drop(self, recording: Recording) -> None:
        """Take out a recording whose file could not go on, without closing it; its session may be opened again."""
        self._recordings.pop(recording.session, None)
        rig = self._rigs.get(recording.rig)
        if rig is not None and recording in rig.recordings:
            rig.recordings.remove(recording)

    def _close(self, recording: Recording, end: str, reason: str) -> None:
        self.drop(recording)
        self._over[recording.session] = recording.ended_ns + _MEMORY_NS
        self._shelf.close(recording, end, reason)
