"""Tracks the sessions of all rigs and decides which messages are written to which file. Without clock, bus and disk.

A session starts with its `SESSION_START` event, or when its owner announces it (the event may be lost, or older than
the recorder). It ends with its `SESSION_END` event, when its owner announces its sessions without it, or when the owner
is silent for too long. After the end its file stays open for a drain time, until the recording streams of all services
of the rig have passed the end, according to their own time stamps. Only events are decoded, no other messages.
"""

import re
from collections.abc import Callable
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_recorder.ingest.preroll import PreRollBuffer
from hilrig_recorder.ingest.queue import ReceivedBatch
from hilrig_recorder.ingest.recording import SECOND_NS, LossCounters, Recording, RecordingStore
from hilrig_recorder.ingest.sources import (
    MAX_GAP,
    PUBLISHER_TIMEOUT_NS,
    SETTLE_TIME_NS,
    WALL_CLOCK_STEP_THRESHOLD_NS,
    KeyStream,
    PublisherState,
    PublisherTracker,
)
from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC, EVENT_CHANNEL
from hilrig_recorder.mcap_format.ending import Ending
from hilrig_recorder.mcap_format.records import encode_message
from hilrig_runtime.bus.acl import RULES
from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.recording_stream import entries_of
from hilrig_runtime.process.outage import OutageDetector, describe_outage
from hilrig_schemas import Event, LogBatch, OpenSession
from hilrig_schemas.topics import COMMAND, EVENT, SERVICES, STATE, is_name, parse_rig_key

BLOCK_PERIOD_NS: Final = 8 * SECOND_NS // 10
"""Maximum time until a received message is written. With batching, tick and sync, messages are safe within 1 s."""
DRAIN_MIN_NS: Final = SECOND_NS // 5
"""Minimum time that a file stays open after the end of its session."""
IDLE_ANNOUNCEMENT_NS: Final = SECOND_NS
"""A service without messages to publish announces its sessions within this period."""
DRAIN_MAX_NS: Final = 10 * SECOND_NS
"""Maximum time that a file stays open after the end of its session; the caches of recording streams are not longer."""
OWNER_TIMEOUT_NS: Final = 30 * SECOND_NS
"""A session ends when its owner is silent for this time."""
STREAM_TIMEOUT_NS: Final = 8 * SECOND_NS // 10
"""Time without a batch of a service after which its messages are missing; an idle edge sends two a second."""
RETRY_PERIOD_NS: Final = 10 * SECOND_NS
"""Time until a session that could not be recorded is tried again."""
MAX_REJECTIONS: Final = 100
"""Maximum number of different rejected inputs that are reported."""
MAX_RIGS: Final = 4096
"""Maximum number of rigs with buffered messages."""
MAX_KEYS: Final = 4 * MAX_RIGS
"""Maximum number of keys of one publisher."""
MAX_RECORDINGS_PER_RIG: Final = 16
"""Maximum number of open files of one rig: its sessions, and those that ended in the last `DRAIN_MAX_NS`."""
MAX_ENDED_SESSIONS: Final = 4096
"""Maximum number of ended sessions that are remembered."""
_SILENT_CHANNELS: Final = {
    Event.STATE_LOST: CHANNEL_OF_TOPIC[STATE.name],
    Event.COMMAND_LOST: CHANNEL_OF_TOPIC[COMMAND.name],
}
"""Event of a service that misses messages → their channel id."""
_BLOCK_PHASES: Final = 10
_ENDED_SESSION_MEMORY_NS: Final = 120 * SECOND_NS
_SESSION_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:-]{0,127}")


class SessionTracker:
    """Processes received batches. Times are passed in: arrival on the wall clock, `now_ns` on the monotonic clock.

    Args:
        lab: name of the lab.
        preroll_s: length of the pre-roll, s.
        store: storage of the recordings.
        is_assigned: whether this recorder records a rig; messages of other rigs are ignored.
        may_serve: whether a service may publish for a rig; its other messages are dropped.
        counters: count dropped messages.
    """

    def __init__(
        self,
        lab: str,
        preroll_s: float,
        store: RecordingStore,
        is_assigned: Callable[[str], bool] = lambda _: True,
        may_serve: Callable[[str, str], bool] = lambda _source, _rig: True,
        counters: Counters | None = None,
    ) -> None:
        self._lab = lab
        self._is_assigned = is_assigned
        self._may_serve = may_serve
        self._counters = counters or Counters()
        self._preroll_ns = round(preroll_s * SECOND_NS)
        self._store = store
        self._rigs: dict[str, PreRollBuffer] = {}
        self._publishers = PublisherTracker()
        self._recordings: dict[str, Recording] = {}
        self._blocked_until: dict[str, int] = {}
        """Sessions that are not opened before this time, monotonic clock, ns: ended, or opening failed."""
        self._wall_ns = 0
        self._clock_offset_ns: int | None = None
        self._clock_step_ns = -SETTLE_TIME_NS
        self._rejected: set[str] = set()
        self.lost_transport = 0
        self.lost_recorder = 0
        self.lost_batches: dict[str, int] = {}
        """Lost batches of each publisher that are not logged yet: the recorder logs and removes them."""
        self._outages: dict[str, OutageDetector] = {}

    @property
    def recordings(self) -> list[Recording]:
        """The open recordings."""
        return list(self._recordings.values())

    def last_received(self) -> dict[str, int]:
        """Arrival of the last batch of each publisher, monotonic clock, ns."""
        return self._publishers.last_received()

    def has_received(self, rig: str) -> bool:
        """Whether any message of a rig was received."""
        return rig in self._rigs

    # -- messages ---------------------------------------------------------------------------------------------------

    def accept(self, received: ReceivedBatch, now_ns: int) -> None:
        """Process one batch, and the batches of events that wait for it."""
        self._wall_ns = received.wall_ns
        publisher = self._publishers.publisher_of(received, now_ns)
        if received.batch.events:
            publisher.held.append(received)
        else:
            self._update_publisher(publisher, received, now_ns)
            self._accept_messages(publisher, received.batch, now_ns)
            self._accept_dropped(publisher, received, now_ns)
            if received.batch.sessions or received.batch.complete_sessions:
                self._handle_announcement(publisher, received.batch, now_ns)
        while (events := publisher.next_events()) is not None:
            self._accept_messages(publisher, events, now_ns)

    def _accept_messages(self, publisher: PublisherState, batch: LogBatch, now_ns: int) -> None:
        streams, log_time = publisher.streams, self._wall_ns
        for key, sequence, publish_ns, payload in entries_of(batch):
            stream = streams.get(key) or self._add_stream(publisher, key, now_ns)
            if stream is None:
                continue
            channel_id = stream.channel_id
            if sequence != stream.expected:
                missing = stream.missing_before(sequence)
                if missing < 0:
                    continue
                if missing > MAX_GAP:
                    self._counters.reject(key, f"sequence number {sequence} after {stream.expected - 1}")
                    continue
                if missing:
                    numbers = range(stream.expected, sequence)
                    recorded = (
                        recording.count_recorded(channel_id, numbers, publisher.incarnation)
                        for recording in self._rigs[stream.rig].recordings
                    )
                    self._record_loss(publisher, stream, missing - max(recorded, default=0), 0)
            event = None
            if channel_id == EVENT_CHANNEL:
                try:
                    event = EVENT.decode_from(key, payload)
                except DecodeError as error:
                    self._reject(f"{publisher.name}: event on {key}: {error}")
                    continue
            stream.expected = sequence + 1
            record = encode_message(channel_id, sequence, log_time, publish_ns, payload)
            if event is not None and publisher.is_before_first(batch):
                self._accept_earlier_event(publisher, stream, event.session, record)
                continue
            stream.pending.append(record)
            if event is not None:
                publisher.passed_ns = max(publisher.passed_ns, publish_ns)
                self._handle_event(publisher, event, publish_ns, now_ns)

    def _accept_earlier_event(self, publisher: PublisherState, stream: KeyStream, session: str, record: bytes) -> None:
        """Record an event that precedes everything else that was received of its publisher, if its session continues.

        A restarted recorder may receive events of hours ago.
        """
        if session in self._recordings:
            stream.pending.append(record)
        elif session:
            publisher.earlier_events.setdefault(session, []).append(record)

    def _accept_dropped(self, publisher: PublisherState, received: ReceivedBatch, now_ns: int) -> None:
        for key, dropped in received.dropped.items():
            stream = publisher.streams.get(key) or self._add_stream(publisher, key, now_ns)
            if stream is not None:
                missing = dropped.last_sequence + 1 - stream.expected if stream.expected else dropped.count
                missing = min(missing, MAX_GAP)
                stream.expected = dropped.last_sequence + 1
                self._record_loss(publisher, stream, max(0, missing - dropped.count), dropped.count)

    def _update_publisher(self, publisher: PublisherState, received: ReceivedBatch, now_ns: int) -> None:
        missing, clock_stepped = publisher.update(received, now_ns)
        if missing:
            self.lost_batches[publisher.name] = self.lost_batches.get(publisher.name, 0) + missing
            for rig in self._rigs.values():
                if rig.publishers.get(publisher.name) is publisher:
                    rig.record_loss(self._wall_ns, LossCounters(lost_batches=missing))
        if clock_stepped:
            self._count_clock_step(now_ns)

    def _add_stream(self, publisher: PublisherState, key: str, now_ns: int) -> KeyStream | None:
        if key in publisher.streams or len(publisher.streams) >= MAX_KEYS:
            return None
        publisher.streams[key] = None
        try:
            parsed = parse_rig_key(key)
        except ValueError as error:
            self._reject(f"{publisher.name}: {error}")
            return None
        channel_id = CHANNEL_OF_TOPIC.get(parsed.topic.name)
        if channel_id is None or parsed.lab != self._lab or not is_name(parsed.rig):
            self._reject(f"{publisher.name}: key {key} is not a recorded topic of lab {self._lab}")
            return None
        service = publisher.name.partition("/")[0]
        if service not in RULES[parsed.topic.name].publishers or parsed.rig in set(SERVICES) - {service}:
            self._reject(f"{publisher.name}: key {key} is of another service")
            return None
        if not self._may_serve(publisher.name, parsed.rig) and parsed.rig not in SERVICES:
            self._reject(f"{publisher.name}: its certificate excludes rig {parsed.rig!r}")
            return None
        if not self._is_assigned(parsed.rig):
            return None
        rig = self._rig(parsed.rig, now_ns)
        if rig is None:
            self._reject(f"{publisher.name}: more than {MAX_RIGS} rigs")
            return None
        stream = KeyStream(key, rig.name, channel_id, 1 if publisher.restarted else 0, rig.pending)
        publisher.streams[key] = stream
        if channel_id != EVENT_CHANNEL:
            publisher.continuous_rigs.add(rig.name)
        if rig.publishers.get(publisher.name) is not publisher:
            rig.publishers[publisher.name] = publisher
            for recording in rig.recordings:
                self._store.record_source(recording, publisher.name, publisher.incarnation)
        return stream

    def _rig(self, name: str, now_ns: int) -> PreRollBuffer | None:
        """The buffer of a rig; None: there are too many rigs."""
        rig = self._rigs.get(name)
        if rig is None and len(self._rigs) < MAX_RIGS:
            # The block times of the rigs are staggered, so that a large lab does not write all blocks at once. The
            # first block is written soon: after a restart it contains cached messages, which may not stay available.
            phase_ns = BLOCK_PERIOD_NS * (len(self._rigs) % _BLOCK_PHASES) // _BLOCK_PHASES
            rig = self._rigs[name] = PreRollBuffer(name, now_ns + phase_ns - BLOCK_PERIOD_NS)
        return rig

    def _block(self, session: str, until_ns: int) -> None:
        self._blocked_until[session] = until_ns
        if len(self._blocked_until) > MAX_ENDED_SESSIONS:
            del self._blocked_until[next(iter(self._blocked_until))]

    def _record_loss(self, publisher: PublisherState, stream: KeyStream, transport: int, recorder: int) -> None:
        if not transport + recorder:
            return
        self.lost_transport += transport
        self.lost_recorder += recorder
        rig = self._rigs[stream.rig]
        rig.record_loss(self._wall_ns, LossCounters(transport, recorder))
        for recording in rig.recordings:
            self._store.record_loss(recording, publisher.name, stream.key, transport, recorder)

    def _record_gaps(self, recording: Recording) -> None:
        """Add a record of the messages missing after the previous segment: a killed recorder writes no summary."""
        while recording.gaps:
            channel_id, count = recording.gaps.popitem()
            for publisher in self._rigs[recording.rig].publishers.values():
                for stream in publisher.streams.values():
                    if stream is not None and (stream.rig, stream.channel_id) == (recording.rig, channel_id):
                        self._store.record_loss(recording, publisher.name, stream.key, 0, count)

    def _reject(self, message: str) -> None:
        self._counters.reject("recording stream", message)
        # Each message is reported once.
        if message not in self._rejected and len(self._rejected) < MAX_REJECTIONS:
            self._rejected.add(message)
            self._store.report_rejected(message)

    def _count_clock_step(self, now_ns: int) -> None:
        # One clock step is detected here and at each publisher of the same machine.
        if now_ns - self._clock_step_ns > SECOND_NS:
            for recording in self._recordings.values():
                recording.counters.clock_steps += 1
        self._clock_step_ns = now_ns

    # -- sessions ---------------------------------------------------------------------------------------------------

    def _handle_event(self, publisher: PublisherState, event: Event, publish_ns: int, now_ns: int) -> None:
        if event.kind == Event.SESSION_START:
            data = event.session_data
            session = OpenSession(
                rig=event.rig,
                session=event.session,
                controller=data.controller,
                certificate=data.certificate,
                student=data.student,
                start_wall_ns=event.wall_ns,
            )
            self._open(publisher.name, session, now_ns)
        elif event.kind == Event.SESSION_END:
            recording = self._recordings.get(event.session)
            if recording is not None and recording.owner != publisher.name:
                self._counters.reject(f"event of {publisher.name}", f"end of a session of {recording.owner}")
                return
            self._block(event.session, now_ns + _ENDED_SESSION_MEMORY_NS)
            if recording is not None:
                self._end(recording, event.session_data.reason or "ended", publish_ns, now_ns)
        elif event.kind == Event.OVERRUN:
            # An overrun event without a rig concerns all rigs of the simulation.
            for recording in self._recordings_of(publisher):
                if event.rig in ("", recording.rig):
                    recording.counters.overruns += 1
                    recording.counters.missed_steps += event.overrun_data.missed_steps
        elif event.kind in _SILENT_CHANNELS:
            for recording in self._recordings.values():
                if recording.rig == event.rig:
                    silent_ns = event.wall_ns - event.watchdog_data.silent_ns
                    recording.silent_ns[_SILENT_CHANNELS[event.kind]] = silent_ns

    def _handle_announcement(self, publisher: PublisherState, batch: LogBatch, now_ns: int) -> None:
        listed = {session.session: session for session in batch.sessions}
        for session in listed.values():
            self._open(publisher.name, session, now_ns)
        if not batch.complete_sessions:
            return
        for recording in self._recordings.values():
            if recording.owner != publisher.name or recording.end_wall_ns is not None:
                continue
            if recording.session in listed:
                recording.missing_announcements = 0
                continue
            # One announcement may be older than the event in the same batch.
            recording.missing_announcements += 1
            if recording.missing_announcements >= 2:
                reason = f"{publisher.name} no longer announces the session"
                self._end(recording, reason, publisher.last_publish_ns, now_ns)

    def _open(self, owner: str, opened: OpenSession, now_ns: int) -> None:
        rig_name, session = opened.rig, opened.session
        if session in self._recordings or session in self._blocked_until or not self._is_assigned(rig_name):
            return
        if not _SESSION_ID.fullmatch(session) or not is_name(rig_name):
            self._reject(f"{owner}: session {session!r} of rig {rig_name!r} has an invalid name")
            return
        if not self._may_serve(owner, rig_name):
            self._counters.reject(f"session of {owner}", f"its certificate excludes rig {rig_name!r}")
            return
        rig = self._rig(rig_name, now_ns)
        if rig is None or len(rig.recordings) >= MAX_RECORDINGS_PER_RIG:
            self._reject(f"{owner}: more sessions than {MAX_RECORDINGS_PER_RIG} of a rig, or too many rigs")
            return
        recording = Recording(
            rig_name,
            session,
            opened.controller,
            owner,
            opened.start_wall_ns,
            now_ns,
            certificate=opened.certificate,
            student=opened.student,
        )
        if not self._store.open(recording):
            self._block(session, now_ns + RETRY_PERIOD_NS)
            return
        self._recordings[session] = recording
        for publisher in rig.publishers.values():
            self._store.record_source(recording, publisher.name, publisher.incarnation)
        rig.flush_block(self._wall_ns)
        for publisher in rig.publishers.values():
            recording.write(publisher.earlier_events.pop(session, ()))
        rig.add(recording, self._wall_ns - self._preroll_ns)

    def _end(self, recording: Recording, reason: str, end_wall_ns: int, now_ns: int) -> None:
        if recording.end_wall_ns is None:
            recording.end_wall_ns = end_wall_ns
            recording.end_reason = reason
            recording.ended_ns = now_ns

    def _recordings_of(self, publisher: PublisherState) -> list[Recording]:
        return [
            recording
            for recording in self._recordings.values()
            if self._rigs[recording.rig].publishers.get(publisher.name) is publisher
        ]

    # -- time -------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int, wall_ns: int) -> None:
        """Do periodic work, several times per second: flush blocks, close ended recordings, detect clock steps."""
        offset_ns = wall_ns - now_ns
        if self._clock_offset_ns is not None and abs(offset_ns - self._clock_offset_ns) > WALL_CLOCK_STEP_THRESHOLD_NS:
            self._count_clock_step(now_ns)
        self._clock_offset_ns = offset_ns
        for rig in self._rigs.values():
            if now_ns >= rig.due_ns:
                rig.due_ns = max(rig.due_ns + BLOCK_PERIOD_NS, now_ns)
                rig.flush_block(wall_ns)
                rig.evict(wall_ns - self._preroll_ns, wall_ns)
        last_received = self._publishers.last_received()
        self._check_outages(last_received, now_ns, wall_ns)
        for recording in self.recordings:
            self._record_gaps(recording)
            if recording.seen is not None and now_ns - recording.opened_ns > SETTLE_TIME_NS:
                # All cached messages were received: no more duplicates.
                recording.seen = None
            if recording.end_wall_ns is None:
                self._check_owner(recording, last_received.get(recording.owner, 0), now_ns)
            elif self._is_drained(recording, now_ns):
                self._close(recording, Ending.ENDED, recording.end_reason)
        for session, until_ns in list(self._blocked_until.items()):
            if now_ns > until_ns:
                del self._blocked_until[session]
        for publisher in self._publishers.evict_superseded(now_ns):
            for rig in self._rigs.values():
                if rig.publishers.get(publisher.name) is publisher:
                    del rig.publishers[publisher.name]

    def _check_outages(self, last_received: dict[str, int], now_ns: int, wall_ns: int) -> None:
        """Report the publishers of open recordings whose recording streams stopped or arrive again."""
        for name, last_ns in last_received.items():
            if name.startswith("recorder/"):
                # Only the services of the loop publish all the time.
                continue
            outage = self._outages.setdefault(name, OutageDetector(STREAM_TIMEOUT_NS)).check(last_ns, now_ns)
            if outage is None:
                continue
            recordings = [
                recording
                for recording in self._recordings.values()
                if recording.end_wall_ns is None and name in self._rigs[recording.rig].publishers
            ]
            text = describe_outage(f"messages of {name}", outage, wall_ns - now_ns)
            if recordings:
                self._store.report_outage(recordings, text, has_ended=outage.has_ended)
        for name in self._outages.keys() - last_received:
            del self._outages[name]

    def _check_owner(self, recording: Recording, last_received_ns: int, now_ns: int) -> None:
        if now_ns - max(last_received_ns, recording.opened_ns) > OWNER_TIMEOUT_NS:
            reason = f"no message from {recording.owner} for {OWNER_TIMEOUT_NS // SECOND_NS} s"
            # The session is not blocked: when the owner announces it again, it continues in a new segment.
            self._rigs[recording.rig].flush_block(self._wall_ns)
            self.drop(recording)
            self._store.close(recording, Ending.OWNER_LOST, reason)

    def _is_drained(self, recording: Recording, now_ns: int) -> bool:
        draining_ns = now_ns - recording.ended_ns
        if draining_ns >= DRAIN_MAX_NS:
            return True
        end_wall_ns = recording.end_wall_ns or 0
        # A stream is in order. It has passed the end when its publish times have. A publisher without messages has
        # passed the end when one of its batches arrived well after the end. Nothing is expected of one that is dead.
        return draining_ns >= DRAIN_MIN_NS and all(
            publisher.passed_ns >= end_wall_ns
            or publisher.last_ns >= recording.ended_ns + IDLE_ANNOUNCEMENT_NS
            or now_ns - publisher.last_ns > PUBLISHER_TIMEOUT_NS
            for publisher in self._rigs[recording.rig].publishers.values()
            if recording.rig in publisher.continuous_rigs
        )

    def flush(self) -> None:
        """Write all pending messages."""
        for rig in self._rigs.values():
            rig.flush_block(self._wall_ns)

    def stop(self) -> None:
        """Close every recording, because the recorder stops."""
        for recording in self.recordings:
            if recording.end_wall_ns is None:
                self._close(recording, Ending.RECORDER_STOPPED, "the recorder was stopped during the session")
            else:
                self._close(recording, Ending.ENDED, recording.end_reason)

    def drop(self, recording: Recording) -> None:
        """Remove a recording without closing its file; its session may be opened again."""
        self._recordings.pop(recording.session, None)
        rig = self._rigs.get(recording.rig)
        if rig is not None and recording in rig.recordings:
            rig.recordings.remove(recording)

    def _close(self, recording: Recording, end: Ending, reason: str) -> None:
        self._rigs[recording.rig].flush_block(self._wall_ns)
        self._record_gaps(recording)
        self.drop(recording)
        self._block(recording.session, recording.ended_ns + _ENDED_SESSION_MEMORY_NS)
        self._store.close(recording, end, reason)
