"""Sessions and files, decided without clock, bus or disk."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import pytest

from hilrig_recorder.ingest.queue import Arrival
from hilrig_recorder.ingest.recording import Recording
from hilrig_recorder.ingest.sessions import BLOCK_NS, KEEPER_SILENCE_NS, LINGER_MAX_NS, SessionBook
from hilrig_recorder.mcap_format.channels import message_head
from hilrig_runtime.messaging.recording_stream import put_entries
from hilrig_schemas import Event, LogBatch, OpenSession
from hilrig_schemas.topics import EVENT, STATE
from support.log_streams import LAB, MS, SECOND, FakeSource, Sent

MESSAGE_HEAD_BYTES = 31
"""Of an MCAP message record: opcode, length, channel, sequence, two times."""
WALL = 1_767_225_600 * SECOND


@dataclass
class FakeFile:
    """What one recording got."""

    recording: Recording
    flush: Callable[[], None]
    records: list[bytes] = field(default_factory=list)
    end: str = ""
    reason: str = ""

    def write(self, records: Sequence[bytes]) -> None:
        self.records += records

    @property
    def payloads(self) -> list[bytes]:
        """What it got, and what waits for it."""
        self.flush()
        return [record[MESSAGE_HEAD_BYTES:] for record in self.records]

    @property
    def log_times(self) -> list[int]:
        self.flush()
        return [message_head(record).log_time for record in self.records]


@dataclass
class FakeShelf:
    """Keeps recordings in memory."""

    flush: Callable[[], None] = lambda: None
    files: list[FakeFile] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    losses: list[tuple[str, int, int]] = field(default_factory=list)
    sources: list[tuple[str, int]] = field(default_factory=list)
    accepts: bool = True
    seen: set[tuple[int, int, int]] | None = None
    last: dict[int, tuple[int, int]] = field(default_factory=dict)
    horizon_ns: dict[int, int] = field(default_factory=dict)

    def open(self, recording: Recording) -> FakeFile | None:
        if not self.accepts:
            return None
        recording.seen, recording.last, recording.horizon_ns = self.seen, dict(self.last), self.horizon_ns
        self.files.append(FakeFile(recording, self.flush))
        return self.files[-1]

    def close(self, recording: Recording, end: str, reason: str) -> None:
        file = next(file for file in self.files if file.recording is recording)
        file.end, file.reason = end, reason

    def lost(self, _recording: Recording, _source: str, key: str, transport: int, recorder: int) -> None:
        self.losses.append((key, transport, recorder))

    def source(self, _recording: Recording, source: str, incarnation: int) -> None:
        self.sources.append((source, incarnation))

    def refuse(self, what: str) -> None:
        self.refused.append(what)


class Desk:
    """A book, its shelf, and a time that the test moves."""

    def __init__(self, preroll_s: float = 2.0, rigs: Sequence[str] | None = None) -> None:
        self.shelf = FakeShelf()
        self.book = SessionBook(LAB, preroll_s, self.shelf, lambda rig: rigs is None or rig in rigs)
        self.shelf.flush = self.book.flush
        self.now = 100 * SECOND
        self.offset = WALL
        self.sim, self.edge = FakeSource("sim/1"), FakeSource("edge/1")

    @property
    def wall(self) -> int:
        return self.now + self.offset

    def take(self, batch: LogBatch) -> None:
        self.book.accept(Arrival(batch, self.wall), self.now)

    def wait(self, duration: int) -> None:
        """Let time pass, ticking as the recorder does."""
        end = self.now + duration
        while self.now < end:
            self.now = min(end, self.now + 100 * MS)
            self.book.tick(self.now, self.wall)

    def states(self, count: int, rig: str = "rig1", every: int = 20 * MS) -> list[Sent]:
        sent = []
        for _ in range(count):
            sent.append(self.sim.state(rig, self.wall))
            self.take(self.sim.batch())
            self.wait(every)
        return sent

    def start(self, session: str = "s1", rig: str = "rig1") -> Sent:
        sent = self.edge.start(rig, session, self.wall)
        self.edge.command(rig, self.wall)
        self.take(self.edge.batch())
        return sent

    def end(self, session: str = "s1", rig: str = "rig1") -> Sent:
        sent = self.edge.end(rig, session, self.wall)
        self.take(self.edge.batch())
        return sent

    @property
    def file(self) -> FakeFile:
        [file] = self.shelf.files
        return file


def payloads(*sent: Sent) -> list[bytes]:
    return [message.payload for message in sent]


def test_a_file_begins_with_what_came_shortly_before_the_session() -> None:
    desk = Desk()
    states = desk.states(200)
    start = desk.start()
    before = desk.file.payloads[:-2]
    assert payloads(start)[0] in desk.file.payloads
    # Two seconds at 50 Hz, within what passes between two ticks.
    assert before == payloads(*states)[-len(before) :]
    assert 95 <= len(before) <= 106


def test_without_pre_roll_a_file_begins_with_its_session() -> None:
    desk = Desk(preroll_s=0)
    desk.states(50)
    desk.start()
    assert len(desk.file.payloads) <= 3


def test_a_file_closes_when_the_other_stream_has_passed_the_end() -> None:
    desk = Desk()
    desk.states(1)
    desk.start()
    desk.states(10)
    end = desk.end()
    desk.wait(500 * MS)
    assert desk.file.end == "", "the simulation's stream has not passed the end yet"
    late = desk.sim.state("rig1", end.publish_ns - 5 * MS)
    after = desk.sim.state("rig1", end.publish_ns + 15 * MS)
    desk.take(desk.sim.batch())
    desk.wait(200 * MS)
    assert (desk.file.end, desk.file.reason) == ("ended", "the controller left")
    assert payloads(late, after) == desk.file.payloads[-2:]


def test_a_stream_that_never_comes_back_is_not_waited_for_without_end() -> None:
    desk = Desk()
    desk.states(1)
    desk.start()
    desk.end()
    desk.wait(LINGER_MAX_NS - 200 * MS)
    assert desk.file.end == ""
    desk.wait(400 * MS)
    assert desk.file.end == "ended"


def test_a_stream_with_nothing_to_say_holds_a_file_open_for_a_second_only() -> None:
    desk = Desk()
    hand = FakeSource("recorder/1")
    desk.start("s1")
    desk.end("s1")
    hand.start("rig1", "by-hand", desk.wall)
    desk.take(hand.batch())
    desk.wait(SECOND)
    hand.end("rig1", "by-hand", desk.wall)
    desk.take(hand.batch())
    desk.wait(1100 * MS)
    desk.take(desk.edge.batch(sessions=[]))
    desk.wait(200 * MS)
    assert [file.end for file in desk.shelf.files] == ["ended", "ended"]


def test_what_comes_long_after_the_end_is_not_in_the_file() -> None:
    desk = Desk()
    desk.start()
    end = desk.end()
    desk.sim.state("rig1", end.publish_ns - 10 * SECOND)
    far = desk.sim.state("rig1", end.publish_ns + SECOND)
    desk.take(desk.sim.batch())
    assert payloads(far)[0] not in desk.file.payloads


def test_a_session_whose_start_was_not_heard_is_recorded_from_its_statement() -> None:
    desk = Desk()
    desk.states(3)
    session = OpenSession(rig="rig1", session="s1", controller="192.0.2.9:1", start_wall_ns=desk.wall - 60 * SECOND)
    desk.take(desk.edge.batch(sessions=[session]))
    assert desk.file.recording.controller == "192.0.2.9:1"
    assert len(desk.file.payloads) == 3


def test_a_session_that_its_keeper_no_longer_states_has_ended() -> None:
    desk = Desk()
    desk.start()
    session = OpenSession(rig="rig1", session="s1")
    desk.take(desk.edge.batch(sessions=[session]))
    for _ in range(2):
        desk.wait(500 * MS)
        desk.take(desk.edge.batch(sessions=[]))
    desk.wait(2 * SECOND)
    assert desk.file.end == "ended"
    assert "does not keep it" in desk.file.reason


def test_one_statement_that_is_older_than_the_event_ends_nothing() -> None:
    desk = Desk()
    desk.start()
    desk.take(desk.edge.batch(sessions=[]))
    desk.take(desk.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    desk.take(desk.edge.batch(sessions=[]))
    desk.wait(5 * SECOND)
    assert desk.file.end == ""


def test_a_silent_keeper_ends_its_sessions_and_takes_them_up_when_it_is_back() -> None:
    desk = Desk()
    desk.start()
    desk.wait(KEEPER_SILENCE_NS - SECOND)
    assert desk.file.end == ""
    desk.wait(2 * SECOND)
    assert desk.file.end == "keeper lost"
    desk.take(desk.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    assert [file.end for file in desk.shelf.files] == ["keeper lost", ""]


def test_a_session_that_is_over_does_not_come_back_with_an_old_statement() -> None:
    desk = Desk()
    desk.start()
    desk.end()
    desk.wait(LINGER_MAX_NS + SECOND)
    desk.take(desk.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    assert desk.file.end == "ended"


def test_sessions_of_one_rig_may_overlap_and_each_gets_every_message() -> None:
    desk = Desk()
    desk.start("s1")
    desk.states(5)
    desk.start("s2")
    both = desk.states(5)
    desk.end("s1")
    first, second = desk.shelf.files
    assert payloads(*both) == [payload for payload in first.payloads if payload in payloads(*both)]
    assert payloads(*both) == [payload for payload in second.payloads if payload in payloads(*both)]


def test_rigs_do_not_mix() -> None:
    desk = Desk()
    desk.start("s1", "rig1")
    desk.start("s2", "rig2")
    one = desk.states(3, "rig1")
    two = desk.states(3, "rig2")
    first, second = desk.shelf.files
    assert set(payloads(*one)) <= set(first.payloads)
    assert not set(payloads(*one)) & set(second.payloads)
    assert set(payloads(*two)) <= set(second.payloads)


def test_a_recorder_of_some_rigs_passes_over_the_others() -> None:
    desk = Desk(rigs=["rig2"])
    desk.start("s1", "rig1")
    desk.take(desk.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    desk.start("s2", "rig2")
    desk.states(3, "rig1")
    states = desk.states(3, "rig2")
    assert desk.file.recording.rig == "rig2"
    assert set(payloads(*states)) <= set(desk.file.payloads)
    assert desk.shelf.refused == []
    # What is missing of another recorder's rig is not lost here.
    desk.sim.state("rig1", desk.wall)
    desk.sim.batch()
    desk.states(1, "rig1")
    assert (desk.file.recording.tally.lost_transport, desk.book.lost_transport) == (0, 0)


def test_what_comes_first_is_written_at_once_and_then_within_a_second_and_not_of_all_rigs_at_once() -> None:
    desk = Desk()
    rigs = [f"rig{number}" for number in range(20)]
    for rig in rigs:
        desk.start(rig, rig)

    def written_in_turns() -> list[int]:
        for rig in rigs:
            desk.sim.state(rig, desk.wall)
        desk.take(desk.sim.batch())
        written = [len(file.records) for file in desk.shelf.files]
        turns = []
        for _ in range(10):
            desk.wait(BLOCK_NS // 10)
            counts = [len(file.records) for file in desk.shelf.files]
            turns.append(sum(now > before for now, before in zip(counts, written, strict=True)))
            written = counts
        return turns

    assert written_in_turns() == [len(rigs)] + 9 * [0]
    turns = written_in_turns()
    assert sum(turns) == len(rigs)
    assert max(turns) <= 4


def test_a_gap_is_counted_as_lost_on_the_way() -> None:
    desk = Desk()
    desk.start()
    desk.states(2)
    for _ in range(7):
        desk.sim.state("rig1", desk.wall)
    desk.sim.batch()
    desk.states(1)
    tally = desk.file.recording.tally
    assert (tally.lost_transport, tally.lost_recorder, tally.lost_batches) == (7, 0, 1)
    assert desk.shelf.losses == [(STATE.key(LAB, "rig1"), 7, 0)]


@pytest.mark.parametrize(("waited", "set_back", "counted"), [(1, 0, 7), (4, 0, 0), (4, 3600, 0)])
def test_a_gap_shortly_before_a_session_is_its_too(waited: int, set_back: int, counted: int) -> None:
    desk = Desk()
    desk.states(2)
    for _ in range(7):
        desk.sim.state("rig1", desk.wall)
    desk.sim.batch()
    desk.states(1)
    desk.offset -= set_back * SECOND
    desk.states(50 * waited)
    desk.start()
    assert desk.file.recording.tally.lost_transport == counted


def test_a_gap_before_the_first_message_of_a_fresh_run_is_counted() -> None:
    desk = Desk()
    desk.start()
    desk.states(2)
    desk.sim = FakeSource("sim/1", incarnation=2)
    desk.sim.state("rig1", desk.wall)
    desk.sim.batch()
    desk.states(1)
    assert desk.file.recording.tally.lost_transport == 1


def test_another_run_of_a_service_begins_its_numbers_anew() -> None:
    desk = Desk()
    desk.start()
    desk.states(5)
    desk.sim = FakeSource("sim/1", incarnation=2)
    again = desk.states(5)
    tally = desk.file.recording.tally
    assert (tally.lost_transport, tally.lost_batches) == (0, 0)
    assert set(payloads(*again)) <= set(desk.file.payloads)
    assert desk.shelf.sources == [("edge/1", 1), ("sim/1", 1), ("sim/1", 2)]


def test_what_comes_twice_is_recorded_once() -> None:
    desk = Desk()
    desk.start()
    desk.sim.state("rig1", desk.wall)
    batch = desk.sim.batch()
    desk.take(batch)
    desk.take(batch)
    assert len(desk.file.payloads) == 3


def test_two_senders_on_one_key_have_numbers_of_their_own() -> None:
    desk = Desk()
    desk.start()
    event = Event(rig="rig1", kind=Event.LIMIT_HIT, text="joint 1 on its stop")
    for _ in range(3):
        desk.sim.put(EVENT, "rig1", event, desk.wall)
        desk.take(desk.sim.batch())
    assert desk.file.recording.tally.lost_transport == 0
    assert len(desk.file.payloads) == 5


def test_overruns_are_counted_from_their_events() -> None:
    desk = Desk()
    desk.start("s1", "rig1")
    desk.start("s2", "rig2")
    desk.states(1, "rig1")
    desk.states(1, "rig2")
    whole = Event(kind=Event.OVERRUN)
    whole.overrun_data.missed_steps = 3
    one = Event(kind=Event.OVERRUN, rig="rig2")
    one.overrun_data.missed_steps = 2
    desk.sim.put(EVENT, "sim", whole, desk.wall)
    desk.sim.put(EVENT, "rig2", one, desk.wall)
    desk.take(desk.sim.batch())
    first, second = (file.recording.tally for file in desk.shelf.files)
    assert (first.overruns, first.missed_steps) == (1, 3)
    assert (second.overruns, second.missed_steps) == (2, 5)


@pytest.mark.parametrize("step", [2 * SECOND, -2 * SECOND])
def test_a_clock_that_is_set_is_counted_once(step: int) -> None:
    desk = Desk()
    desk.start()
    desk.states(1000)
    desk.offset += step
    desk.states(20)
    assert desk.file.recording.tally.clock_steps == 1


@pytest.mark.parametrize("step", [2 * SECOND, -2 * SECOND])
def test_a_sender_whose_clock_is_set_is_noticed(step: int) -> None:
    desk = Desk()
    desk.start()
    desk.states(1000)
    for _ in range(20):
        desk.sim.state("rig1", desk.wall + step)
        desk.take(desk.sim.batch())
        desk.wait(20 * MS)
    assert desk.file.recording.tally.clock_steps == 1


def test_an_outage_is_no_clock_step() -> None:
    desk = Desk()
    desk.start()
    desk.states(1000)
    for _ in range(250):
        desk.sim.state("rig1", desk.wall)
        desk.wait(20 * MS)
    desk.take(desk.sim.batch())
    desk.states(50)
    assert desk.file.recording.tally.clock_steps == 0


def test_a_continued_session_leaves_out_what_the_file_before_holds_and_counts_what_neither_has() -> None:
    desk = Desk()
    known = [desk.sim.state("rig1", desk.wall + number) for number in range(4)]
    desk.shelf.seen = {(1, message.sequence, message.publish_ns) for message in known}
    desk.shelf.last = {1: (4, known[-1].publish_ns)}
    desk.take(desk.sim.batch())
    for number in range(4, 7):
        desk.sim.state("rig1", desk.wall + number)
    desk.sim.batch()
    desk.sim._sequences[STATE.key(LAB, "rig1")] = 7
    desk.take(desk.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    assert desk.file.payloads == []
    # A recorder that starts anew knows of no number before: the gap is seen against the earlier file.
    desk.sim.name = "sim/2"
    desk.wait(SECOND)
    new = desk.states(1)
    assert desk.file.payloads == payloads(*new)
    assert desk.file.recording.tally.lost_recorder == 3


@pytest.mark.parametrize("opened_before_the_gap", [True, False])
def test_a_gap_between_two_files_that_was_seen_on_the_stream_is_counted_once(opened_before_the_gap: bool) -> None:
    desk = Desk()
    known = [desk.sim.state("rig1", desk.wall + number) for number in range(4)]
    desk.shelf.seen = {(1, message.sequence, message.publish_ns) for message in known}
    desk.shelf.last = {1: (4, known[-1].publish_ns)}
    desk.take(desk.sim.batch())
    for lost in range(3):
        desk.sim.state("rig1", desk.wall + 4 + lost)
    desk.sim.batch()
    desk.sim.sequence -= 1
    session = OpenSession(rig="rig1", session="s1")
    if opened_before_the_gap:
        desk.take(desk.edge.batch(sessions=[session]))
    wanted = desk.sim.state("rig1", desk.wall + 7)
    desk.take(desk.sim.batch())
    if not opened_before_the_gap:
        desk.take(desk.edge.batch(sessions=[session]))
    assert desk.file.payloads == payloads(wanted)
    tally = desk.file.recording.tally
    assert (tally.lost_transport, tally.lost_recorder) == (3, 0)


def test_what_is_repeated_from_before_what_is_known_of_the_file_before_is_left_out() -> None:
    desk = Desk()
    desk.shelf.seen = set()
    desk.shelf.horizon_ns = {1: desk.wall}
    desk.sim.state("rig1", desk.wall - 1)
    wanted = desk.sim.state("rig1", desk.wall)
    desk.take(desk.sim.batch())
    desk.take(desk.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    assert desk.file.payloads == payloads(wanted)


def test_a_session_that_can_not_be_recorded_is_tried_again() -> None:
    desk = Desk()
    desk.shelf.accepts = False
    session = OpenSession(rig="rig1", session="s1")
    desk.take(desk.edge.batch(sessions=[session]))
    desk.shelf.accepts = True
    desk.take(desk.edge.batch(sessions=[session]))
    assert desk.shelf.files == []
    desk.wait(11 * SECOND)
    desk.take(desk.edge.batch(sessions=[session]))
    assert desk.file.end == ""


def test_a_recorder_that_stops_closes_everything() -> None:
    desk = Desk()
    desk.start("s1", "rig1")
    desk.start("s2", "rig2")
    desk.end("s2", "rig2")
    desk.book.stop()
    assert [file.end for file in desk.shelf.files] == ["recorder stopped", "ended"]


@pytest.mark.parametrize(
    ("session", "rig"),
    [
        ("../../etc/passwd", "rig1"),
        ("", "rig1"),
        ("a/b", "rig1"),
        (".hidden", "rig1"),
        ("s" * 200, "rig1"),
        ("s1", ".."),
    ],
)
def test_names_that_lead_elsewhere_are_refused(session: str, rig: str) -> None:
    desk = Desk()
    event = Event(rig=rig, session=session, kind=Event.SESSION_START)
    desk.edge.put(EVENT, "rig1", event, desk.wall)
    desk.take(desk.edge.batch())
    assert desk.shelf.files == []
    assert len(desk.shelf.refused) == 1


def test_what_is_not_understood_is_told_once_and_stops_nothing() -> None:
    desk = Desk()
    desk.start()
    batch = LogBatch(source="edge/1", incarnation=1, sequence=2)
    keys = ("hil/lab/rig1/nothing", "hil/elsewhere/rig1/state", "hil/lab/rig1/config", "hil/lab/rig2/event")
    put_entries(batch, [(key, sequence, 0, b"\xff\xff") for sequence in (1, 2) for key in keys])
    desk.take(batch)
    states = desk.states(2)
    assert len(desk.shelf.refused) == 4
    assert set(payloads(*states)) <= set(desk.file.payloads)
