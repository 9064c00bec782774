"""Which rig is in which session, and what therefore goes into which file: the recorder's core, without clock or disk.

A session begins with its `SESSION_START` event, or when its keeper states it (the event may be lost, or older than
the recorder); it ends with `SESSION_END`, when its keeper states its sessions without it, or when the keeper has
been silent too long. Its file stays open a little longer, until the streams of the rig's other services have
passed the end, by their own stamps. Of the messages nothing is decoded but events.
"""

import re
from collections.abc import Callable
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_recorder.ingest.preroll import RigLog
from hilrig_recorder.ingest.queue import Arrival
from hilrig_recorder.ingest.recording import SECOND_NS, Recording, Shelf
from hilrig_recorder.ingest.sources import CLOCK_STEP_NS, SETTLING_NS, Source, Sources, Stream
from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC, EVENT_CHANNEL, encode_message
from hilrig_runtime.messaging.recording_stream import entries_of
from hilrig_schemas import Event, LogBatch
from hilrig_schemas.topics import is_name, parse_rig_key

BLOCK_NS: Final = 8 * SECOND_NS // 10
"""Messages wait so long at most before they are written: with the batch, the tick and the sync less than a second."""
LINGER_MIN_NS: Final = SECOND_NS // 5
"""A file stays open at least so long after its session's end."""
IDLE_NS: Final = SECOND_NS
"""A service with nothing to send still states its sessions within this time."""
LINGER_MAX_NS: Final = 10 * SECOND_NS
"""A service that has not passed the end by then is not waited for: its log stream's cache reaches no further back."""
KEEPER_SILENCE_NS: Final = 30 * SECOND_NS
"""A session whose keeper is silent so long has ended."""
RETRY_NS: Final = 10 * SECOND_NS
"""A session that could not be recorded is tried again after this."""
_PHASES: Final = 10
_MEMORY_NS: Final = 120 * SECOND_NS
_SESSION_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:-]{0,127}")


class SessionBook:
    """Follows the log streams; time is passed in: arrival on the wall clock, and `now_ns` of the monotonic clock.

    What is sent of rigs that are not `mine` is passed over: another recorder has them.
    """

    def __init__(self, lab: str, preroll_s: float, shelf: Shelf, mine: Callable[[str], bool] = lambda _: True) -> None:
        self._lab = lab
        self._is_mine = mine
        self._preroll_ns = round(preroll_s * SECOND_NS)
        self._shelf = shelf
        self._rigs: dict[str, RigLog] = {}
        self._sources = Sources()
        self._recordings: dict[str, Recording] = {}
        self._over: dict[str, int] = {}
        self._wall_ns = 0
        self._clock_offset_ns: int | None = None
        self._clock_step_ns = -SETTLING_NS
        self._refused: set[str] = set()
        self.lost_transport = 0
        self.lost_recorder = 0

    @property
    def recordings(self) -> list[Recording]:
        """The recordings that are open."""
        return list(self._recordings.values())

    def has_heard_of(self, rig: str) -> bool:
        """Whether anything of a rig has been sent."""
        return rig in self._rigs

    # -- what comes in ----------------------------------------------------------------------------------------------

    def accept(self, arrival: Arrival, now_ns: int) -> None:
        """Take one batch."""
        batch = arrival.batch
        log_time = self._wall_ns = arrival.wall_ns
        source = self._source(arrival, now_ns)
        streams = source.streams
        for key, sequence, publish_ns, payload in entries_of(batch):
            stream = streams.get(key) or self._stream(source, key, now_ns)
            if stream is None:
                continue
            if sequence != stream.expected:
                missing = stream.missing(sequence)
                if missing < 0:
                    continue
                if missing:
                    self._lose(source, stream, missing, 0)
            stream.expected = sequence + 1
            channel_id = stream.channel_id
            stream.append(encode_message(channel_id, sequence, log_time, publish_ns, payload))
            if channel_id == EVENT_CHANNEL:
                self._event(source, payload, publish_ns, now_ns)
        for key, drop in arrival.dropped.items():
            stream = streams.get(key) or self._stream(source, key, now_ns)
            if stream is not None:
                missing = drop.last_sequence + 1 - stream.expected if stream.expected else drop.count
                stream.expected = drop.last_sequence + 1
                self._lose(source, stream, max(0, missing - drop.count), drop.count)
        if batch.sessions or batch.complete_sessions:
            self._statement(source, batch, now_ns)

    def _source(self, arrival: Arrival, now_ns: int) -> Source:
        source = self._sources.of(arrival, now_ns)
        missing, clock_stepped = source.heard(arrival, now_ns)
        if missing:
            for recording in self._of_source(source):
                recording.tally.lost_batches += missing
        if clock_stepped:
            self._count_clock_step(now_ns)
        return source

    def _stream(self, source: Source, key: str, now_ns: int) -> Stream | None:
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
        if not self._is_mine(parsed.rig):
            return None
        rig = self._rig(parsed.rig, now_ns)
        stream = Stream(key, rig.name, channel_id, 1 if source.fresh else 0, rig.waiting.append)
        source.streams[key] = stream
        if channel_id != EVENT_CHANNEL:
            source.steady.add(rig.name)
        if rig.sources.get(source.name) is not source:
            rig.sources[source.name] = source
            for recording in rig.recordings:
                self._shelf.source(recording, source.name, source.incarnation)
        return stream

    def _rig(self, name: str, now_ns: int) -> RigLog:
        rig = self._rigs.get(name)
        if rig is None:
            # In turns, so that the blocks of a large lab are not all written at once. The first is written soon: what
            # comes first was fetched, after a restart, and may not be there to be fetched again after the next.
            phase_ns = BLOCK_NS * (len(self._rigs) % _PHASES) // _PHASES
            rig = self._rigs[name] = RigLog(name, now_ns + phase_ns - BLOCK_NS)
        return rig

    def _lose(self, source: Source, stream: Stream, transport: int, recorder: int) -> None:
        self.lost_transport += transport
        self.lost_recorder += recorder
        rig = self._rigs[stream.rig]
        rig.lose(self._wall_ns, transport, recorder)
        for recording in rig.recordings:
            self._shelf.lost(recording, source.name, stream.key, transport, recorder)

    def _refuse(self, what: str) -> None:
        # Each thing once, and not without end.
        if what not in self._refused and len(self._refused) < 1000:
            self._refused.add(what)
            self._shelf.refuse(what)

    def _count_clock_step(self, now_ns: int) -> None:
        # One setting is seen at each sender on the machine, and here.
        if now_ns - self._clock_step_ns > SECOND_NS:
            for recording in self._recordings.values():
                recording.tally.clock_steps += 1
        self._clock_step_ns = now_ns

    # -- sessions ---------------------------------------------------------------------------------------------------

    def _event(self, source: Source, payload: bytes, publish_ns: int, now_ns: int) -> None:
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

    def _statement(self, source: Source, batch: LogBatch, now_ns: int) -> None:
        listed = {session.session: session for session in batch.sessions}
        for session in listed.values():
            self._begin(source.name, session.rig, session.session, session.controller, session.start_wall_ns, now_ns)
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

    def _begin(
        self, keeper: str, rig_name: str, session: str, controller: str, start_wall_ns: int, now_ns: int
    ) -> None:
        if session in self._recordings or session in self._over or not self._is_mine(rig_name):
            return
        if not _SESSION_ID.fullmatch(session) or not is_name(rig_name):
            self._refuse(f"{keeper}: {session!r} of {rig_name!r} is no name for a recording")
            return
        rig = self._rig(rig_name, now_ns)
        recording = Recording(rig_name, session, controller, keeper, start_wall_ns, now_ns)
        sink = self._shelf.open(recording)
        if sink is None:
            self._over[session] = now_ns + RETRY_NS
            return
        recording.sink = sink
        self._recordings[session] = recording
        for source in rig.sources.values():
            self._shelf.source(recording, source.name, source.incarnation)
        rig.cut(self._wall_ns)
        rig.begin(recording, self._wall_ns - self._preroll_ns)

    def _end(self, recording: Recording, reason: str, end_wall_ns: int, now_ns: int) -> None:
        if recording.end_wall_ns is None:
            recording.end_wall_ns = end_wall_ns
            recording.end_reason = reason
            recording.ended_ns = now_ns

    def _of_source(self, source: Source) -> list[Recording]:
        return [
            recording
            for recording in self._recordings.values()
            if self._rigs[recording.rig].sources.get(source.name) is source
        ]

    # -- time -------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int, wall_ns: int) -> None:
        """Do what time brings, some times a second: cut off blocks, close what has ended, watch the clock."""
        offset_ns = wall_ns - now_ns
        if self._clock_offset_ns is not None and abs(offset_ns - self._clock_offset_ns) > CLOCK_STEP_NS:
            self._count_clock_step(now_ns)
        self._clock_offset_ns = offset_ns
        for rig in self._rigs.values():
            if now_ns >= rig.due_ns:
                rig.due_ns = max(rig.due_ns + BLOCK_NS, now_ns)
                rig.cut(wall_ns)
                rig.forget(wall_ns - self._preroll_ns, wall_ns)
        heard = self._sources.last_heard()
        for recording in self.recordings:
            if recording.seen is not None and now_ns - recording.opened_ns > SETTLING_NS:
                # What could come twice has come.
                recording.seen = None
            if recording.end_wall_ns is None:
                self._watch_keeper(recording, heard.get(recording.keeper, 0), now_ns)
            elif self._is_complete(recording, now_ns):
                self._close(recording, "ended", recording.end_reason)
        for session, until_ns in list(self._over.items()):
            if now_ns > until_ns:
                del self._over[session]
        for source in self._sources.forget(now_ns):
            for rig in self._rigs.values():
                if rig.sources.get(source.name) is source:
                    del rig.sources[source.name]

    def _watch_keeper(self, recording: Recording, heard_ns: int, now_ns: int) -> None:
        if now_ns - max(heard_ns, recording.opened_ns) > KEEPER_SILENCE_NS:
            reason = f"{recording.keeper} was not heard for {KEEPER_SILENCE_NS // SECOND_NS} s"
            # Not over for good: when the keeper comes back and states it, it goes on in a next file.
            self._rigs[recording.rig].cut(self._wall_ns)
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

    def flush(self) -> None:
        """Write what waits."""
        for rig in self._rigs.values():
            rig.cut(self._wall_ns)

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
        self._rigs[recording.rig].cut(self._wall_ns)
        self.drop(recording)
        self._over[recording.session] = recording.ended_ns + _MEMORY_NS
        self._shelf.close(recording, end, reason)
