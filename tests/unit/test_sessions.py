"""The session tracker: sessions, their messages and losses, without clock, bus and disk."""

from typing import Any

import pytest
from google.protobuf.message import DecodeError

from hilrig_recorder.ingest.sessions import (
    BLOCK_PERIOD_NS,
    DRAIN_MAX_NS,
    MAX_RECORDINGS_PER_RIG,
    MAX_RIGS,
    OWNER_TIMEOUT_NS,
)
from hilrig_recorder.ingest.sources import MAX_PUBLISHERS
from hilrig_runtime.messaging.recording_stream import decode_batch, encode_batch, put_entries
from hilrig_schemas import Event, LogBatch, OpenSession
from hilrig_schemas.topics import COMMAND, EVENT, STATE
from hilrig_schemas.v1.event_pb2 import PartData
from support.log_streams import LAB, MS, SECOND, FakeSource, Sent
from support.session_tracker import WALL, TrackerBench


def payloads(*sent: Sent) -> list[bytes]:
    return [message.payload for message in sent]


def test_file_begins_with_the_preroll() -> None:
    bench = TrackerBench()
    states = bench.states(200)
    start = bench.start()
    before = bench.file.payloads[:-2]
    assert payloads(start)[0] in bench.file.payloads
    # Two seconds at 50 Hz, with the tolerance of one tick.
    assert before == payloads(*states)[-len(before) :]
    assert 95 <= len(before) <= 106


def test_without_preroll_file_begins_with_its_session() -> None:
    bench = TrackerBench(preroll_s=0)
    bench.states(50)
    bench.start()
    assert len(bench.file.payloads) <= 3


def test_file_closes_when_all_streams_passed_the_end() -> None:
    bench = TrackerBench()
    bench.states(1)
    bench.start()
    bench.states(10)
    end = bench.end()
    bench.wait(500 * MS)
    assert bench.file.end == "", "the simulation's stream has not passed the end yet"
    late = bench.sim.state("rig1", end.publish_ns - 5 * MS)
    after = bench.sim.state("rig1", end.publish_ns + 15 * MS)
    bench.accept(bench.sim.batch())
    bench.wait(200 * MS)
    assert (bench.file.end, bench.file.reason) == ("ended", "the controller closed the connection")
    assert payloads(late, after) == bench.file.payloads[-2:]


def test_drain_time_is_limited_for_a_silent_stream() -> None:
    bench = TrackerBench()
    bench.states(1)
    bench.start()
    bench.end()
    bench.wait(DRAIN_MAX_NS - 200 * MS)
    assert bench.file.end == ""
    bench.wait(400 * MS)
    assert bench.file.end == "ended"


def test_idle_stream_keeps_file_open_for_one_second_only() -> None:
    bench = TrackerBench()
    recorder = FakeSource("recorder/1")
    bench.start("s1")
    bench.end("s1")
    recorder.start("rig1", "manual", bench.wall)
    bench.accept(recorder.batch())
    bench.wait(SECOND)
    recorder.end("rig1", "manual", bench.wall)
    bench.accept(recorder.batch())
    bench.wait(1100 * MS)
    bench.accept(bench.edge.batch(sessions=[]))
    bench.wait(200 * MS)
    assert [file.end for file in bench.store.files] == ["ended", "ended"]


def test_late_messages_after_the_end_are_not_recorded() -> None:
    bench = TrackerBench()
    bench.start()
    end = bench.end()
    bench.sim.state("rig1", end.publish_ns - 10 * SECOND)
    far = bench.sim.state("rig1", end.publish_ns + SECOND)
    bench.accept(bench.sim.batch())
    assert payloads(far)[0] not in bench.file.payloads


def test_session_is_recorded_from_its_announcement() -> None:
    bench = TrackerBench()
    bench.states(3)
    session = OpenSession(rig="rig1", session="s1", controller="192.0.2.9:1", start_wall_ns=bench.wall - 60 * SECOND)
    bench.accept(bench.edge.batch(sessions=[session]))
    assert bench.file.recording.controller == "192.0.2.9:1"
    assert len(bench.file.payloads) == 3


def test_session_ends_when_owner_no_longer_announces_it() -> None:
    bench = TrackerBench()
    bench.start()
    session = OpenSession(rig="rig1", session="s1")
    bench.accept(bench.edge.batch(sessions=[session]))
    for _ in range(2):
        bench.wait(500 * MS)
        bench.accept(bench.edge.batch(sessions=[]))
    bench.wait(2 * SECOND)
    assert bench.file.end == "ended"
    assert "no longer announces the session" in bench.file.reason


def test_one_outdated_announcement_does_not_end_a_session() -> None:
    bench = TrackerBench()
    bench.start()
    bench.accept(bench.edge.batch(sessions=[]))
    bench.accept(bench.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    bench.accept(bench.edge.batch(sessions=[]))
    bench.wait(5 * SECOND)
    assert bench.file.end == ""


def test_session_of_a_silent_owner_ends_and_resumes() -> None:
    bench = TrackerBench()
    bench.start()
    bench.wait(OWNER_TIMEOUT_NS - SECOND)
    assert bench.file.end == ""
    bench.wait(2 * SECOND)
    assert bench.file.end == "keeper lost"
    bench.accept(bench.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    assert [file.end for file in bench.store.files] == ["keeper lost", ""]


def test_old_announcement_does_not_reopen_an_ended_session() -> None:
    bench = TrackerBench()
    bench.start()
    bench.end()
    bench.wait(DRAIN_MAX_NS + SECOND)
    bench.accept(bench.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    assert bench.file.end == "ended"


def test_overlapping_sessions_of_a_rig_get_all_messages() -> None:
    bench = TrackerBench()
    bench.start("s1")
    bench.states(5)
    bench.start("s2")
    both = bench.states(5)
    bench.end("s1")
    first, second = bench.store.files
    assert payloads(*both) == [payload for payload in first.payloads if payload in payloads(*both)]
    assert payloads(*both) == [payload for payload in second.payloads if payload in payloads(*both)]


def test_messages_of_rigs_are_not_mixed() -> None:
    bench = TrackerBench()
    bench.start("s1", "rig1")
    bench.start("s2", "rig2")
    one = bench.states(3, "rig1")
    two = bench.states(3, "rig2")
    first, second = bench.store.files
    assert set(payloads(*one)) <= set(first.payloads)
    assert not set(payloads(*one)) & set(second.payloads)
    assert set(payloads(*two)) <= set(second.payloads)


def test_messages_of_unassigned_rigs_are_ignored() -> None:
    bench = TrackerBench(rigs=["rig2"])
    bench.start("s1", "rig1")
    bench.accept(bench.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    bench.start("s2", "rig2")
    bench.states(3, "rig1")
    states = bench.states(3, "rig2")
    assert bench.file.recording.rig == "rig2"
    assert set(payloads(*states)) <= set(bench.file.payloads)
    assert bench.store.rejected == []
    # A gap in messages of an unassigned rig is not counted.
    bench.sim.state("rig1", bench.wall)
    bench.sim.batch()
    bench.states(1, "rig1")
    assert (bench.file.recording.counters.lost_transport, bench.tracker.lost_transport) == (0, 0)


def test_first_block_is_immediate_and_later_ones_staggered() -> None:
    bench = TrackerBench()
    rigs = [f"rig{number}" for number in range(20)]
    for rig in rigs:
        bench.start(rig, rig)

    def counts_per_phase() -> list[int]:
        for rig in rigs:
            bench.sim.state(rig, bench.wall)
        bench.accept(bench.sim.batch())
        written = [len(file.records) for file in bench.store.files]
        phases = []
        for _ in range(10):
            bench.wait(BLOCK_PERIOD_NS // 10)
            counts = [len(file.records) for file in bench.store.files]
            phases.append(sum(now > before for now, before in zip(counts, written, strict=True)))
            written = counts
        return phases

    assert counts_per_phase() == [len(rigs)] + 9 * [0]
    phases = counts_per_phase()
    assert sum(phases) == len(rigs)
    assert max(phases) <= 4


def test_gap_is_counted_as_transport_loss() -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(2)
    for _ in range(7):
        bench.sim.state("rig1", bench.wall)
    bench.sim.batch()
    bench.states(1)
    counters = bench.file.recording.counters
    assert (counters.lost_transport, counters.lost_recorder, counters.lost_batches) == (7, 0, 1)
    assert bench.store.losses == [(STATE.key(LAB, "rig1"), 7, 0)]


@pytest.mark.parametrize(("waited", "set_back", "counted"), [(1, 0, 7), (4, 0, 0), (4, 3600, 0)])
def test_gap_within_the_preroll_is_counted(waited: int, set_back: int, counted: int) -> None:
    bench = TrackerBench()
    bench.states(2)
    for _ in range(7):
        bench.sim.state("rig1", bench.wall)
    bench.sim.batch()
    bench.states(1)
    bench.offset -= set_back * SECOND
    bench.states(50 * waited)
    bench.start()
    assert bench.file.recording.counters.lost_transport == counted


def test_lost_batches_before_a_session_resumes_are_counted() -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(2)
    bench.wait(OWNER_TIMEOUT_NS + SECOND)
    assert bench.file.end == "keeper lost"
    for source in (bench.sim, bench.edge):
        for _ in range(7):
            source.command("rig1", bench.wall)
            source.batch()
    bench.states(1)
    bench.accept(bench.edge.batch([OpenSession(rig="rig1", session="s1")]))
    assert [file.recording.counters.lost_batches for file in bench.store.files] == [0, 14]
    assert bench.tracker.lost_batches == {"sim/1": 7, "edge/1": 7}


def test_stream_that_stops_and_returns_is_reported() -> None:
    bench = TrackerBench()
    bench.states(100)
    bench.wait(3 * SECOND)
    assert bench.store.outages == [], "no recording is concerned"
    bench.states(100)
    bench.start()
    bench.accept(FakeSource("recorder/1").batch([]))
    for _ in range(20):
        bench.wait(500 * MS)
        bench.accept(bench.edge.batch([OpenSession(rig="rig1", session="s1")]))
    bench.states(600)
    assert bench.store.outages == [
        ("no messages of sim/1", ["rig1"]),
        ("no messages of edge/1", ["rig1"]),
        ("messages of sim/1 received again", ["rig1"]),
    ]


def test_loss_of_an_outage_of_an_hour_is_counted() -> None:
    """The simulation is unreachable, but not the edge; its clock drifts by 100 ppm."""
    bench = TrackerBench()
    bench.start()
    bench.states(50, every=400 * MS)
    lost = 50 * 3600
    bench.sim.sequence += lost
    bench.sim._sequences[STATE.key(LAB, "rig1")] += lost
    for _ in range(360):
        bench.wait(10 * SECOND)
        bench.accept(bench.edge.batch([OpenSession(rig="rig1", session="s1")]))
    drift = 3600 * SECOND // 10_000
    for _ in range(100):
        bench.sim.state("rig1", bench.wall + drift)
        bench.accept(bench.sim.batch())
        bench.wait(20 * MS)
    counters = bench.file.recording.counters
    assert (counters.lost_transport, counters.lost_batches, counters.clock_steps) == (lost, lost, 0)
    assert bench.store.losses == [(STATE.key(LAB, "rig1"), lost, 0)]
    assert bench.store.outages[-1][0] == "messages of sim/1 received again"
    assert bench.store.sources == [("edge/1", 1), ("sim/1", 1)]


def test_restart_within_a_long_outage_loses_first_messages() -> None:
    bench = TrackerBench()
    bench.states(2)
    bench.start()
    bench.sim = FakeSource("sim/1", incarnation=2)
    for _ in range(20):
        bench.wait(10 * SECOND)
        bench.accept(bench.edge.batch([OpenSession(rig="rig1", session="s1")]))
        bench.sim.state("rig1", bench.wall)
        bench.sim.batch()
    bench.states(2)
    assert bench.file.recording.counters.lost_transport == 20
    bench.accept(bench.edge.batch([OpenSession(rig="rig1", session="s1")]))
    bench.states(1, every=200 * SECOND)
    assert list(bench.tracker._publishers._publishers) == [("edge/1", 1), ("sim/1", 2)], "one incarnation of each"


def test_files_do_not_wait_for_a_dead_service() -> None:
    bench = TrackerBench()
    bench.states(2)
    for _ in range(13):
        bench.wait(10 * SECOND)
        bench.accept(bench.edge.batch([]))
    bench.start()
    bench.end()
    bench.wait(500 * MS)
    assert bench.file.end == "ended"


def test_event_of_a_long_outage_is_recorded() -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(2)
    for _ in range(7):
        bench.sim.state("rig1", bench.wall)
        bench.sim.batch()
    lost = bench.sim.put(EVENT, "rig1", Event(rig="rig1", session="s1", kind=Event.COMMAND_LOST), bench.wall)
    bench.accept(bench.sim.events())
    bench.states(1)
    assert bench.file.payloads[-2:] == [bench.sim.sent[-1].payload, lost.payload]
    assert bench.store.losses == [(STATE.key(LAB, "rig1"), 7, 0)]


def test_events_wait_for_the_messages_before_them() -> None:
    bench = TrackerBench()
    bench.start()
    bench.edge.command("rig1", bench.wall)
    last = bench.edge.batch()
    bench.edge.end("rig1", "s1", bench.wall)
    bench.accept(bench.edge.events())
    assert bench.file.recording.end_wall_ns is None
    bench.accept(last)
    assert bench.file.recording.end_wall_ns == bench.wall


def test_source_counts_as_received_when_its_stream_arrives() -> None:
    bench = TrackerBench()
    bench.sim.put(EVENT, "rig1", Event(rig="rig1", kind=Event.RESET), bench.wall)
    bench.accept(bench.sim.events())
    assert bench.tracker.last_received().keys() == set()
    bench.states(1)
    assert bench.tracker.last_received().keys() == {"sim/1"}


def test_stream_has_passed_its_last_event() -> None:
    bench = TrackerBench()
    bench.start()
    bench.wait(10 * MS)
    bench.edge.end("rig1", "s1", bench.wall)
    bench.accept(bench.edge.events())
    bench.wait(300 * MS)
    assert bench.file.end == "ended"


def test_lost_event_is_stated() -> None:
    bench = TrackerBench()
    bench.states(1)
    for number in range(3):
        bench.edge.put(EVENT, "rig1", Event(rig="rig1", session="s1", kind=Event.RESET), bench.wall)
        batch = bench.edge.events()
        if number != 1:
            bench.accept(bench.edge.batch([OpenSession(rig="rig1", session="s1")]))
            bench.accept(batch)
    assert bench.store.losses == [(EVENT.key(LAB, "rig1"), 1, 0)]


def test_restarted_recorder_takes_old_events_of_open_sessions() -> None:
    bench = TrackerBench()
    for session in ("s0", "s1"):
        bench.edge.start("rig1", session, bench.wall)
        bench.edge.batch()
        lost = bench.sim.put(EVENT, "rig1", Event(rig="rig1", session=session, kind=Event.COMMAND_LOST), bench.wall)
        bench.accept(bench.sim.events())
        bench.sim.batch()
    bench.sim.batch()
    bench.states(1)
    assert bench.store.files == [], "an old event opens no file"
    bench.accept(bench.edge.batch([OpenSession(rig="rig1", session="s1")]))
    assert bench.file.payloads[0] == lost.payload
    assert len(bench.file.payloads) == 2


def test_gap_before_first_message_after_a_restart_is_counted() -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(2)
    bench.sim = FakeSource("sim/1", incarnation=2)
    bench.sim.state("rig1", bench.wall)
    bench.sim.batch()
    bench.states(1)
    assert bench.file.recording.counters.lost_transport == 1


def test_restarted_service_has_new_sequence_numbers() -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(5)
    bench.sim = FakeSource("sim/1", incarnation=2)
    again = bench.states(5)
    counters = bench.file.recording.counters
    assert (counters.lost_transport, counters.lost_batches) == (0, 0)
    assert set(payloads(*again)) <= set(bench.file.payloads)
    assert bench.store.sources == [("edge/1", 1), ("sim/1", 1), ("sim/1", 2)]


def test_duplicate_batch_is_recorded_once() -> None:
    bench = TrackerBench()
    bench.start()
    bench.sim.state("rig1", bench.wall)
    batch = bench.sim.batch()
    bench.accept(batch)
    bench.accept(batch)
    assert len(bench.file.payloads) == 3


def test_publishers_on_one_key_have_separate_sequences() -> None:
    bench = TrackerBench()
    bench.start()
    event = Event(rig="rig1", kind=Event.LIMIT_HIT, text="joint 1 at its limit")
    for _ in range(3):
        bench.sim.put(EVENT, "rig1", event, bench.wall)
        bench.accept(bench.sim.batch())
    assert bench.file.recording.counters.lost_transport == 0
    assert len(bench.file.payloads) == 5


def test_overruns_are_counted_from_events() -> None:
    bench = TrackerBench()
    bench.start("s1", "rig1")
    bench.start("s2", "rig2")
    bench.states(1, "rig1")
    bench.states(1, "rig2")
    all_rigs = Event(kind=Event.OVERRUN)
    all_rigs.overrun_data.missed_steps = 3
    one = Event(kind=Event.OVERRUN, rig="rig2")
    one.overrun_data.missed_steps = 2
    bench.sim.put(EVENT, "sim", all_rigs, bench.wall)
    bench.sim.put(EVENT, "rig2", one, bench.wall)
    bench.accept(bench.sim.batch())
    first, second = (file.recording.counters for file in bench.store.files)
    assert (first.overruns, first.missed_steps) == (1, 3)
    assert (second.overruns, second.missed_steps) == (2, 5)


@pytest.mark.parametrize("step", [2 * SECOND, -2 * SECOND])
def test_clock_step_is_counted_once(step: int) -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(1000)
    bench.offset += step
    bench.states(20)
    assert bench.file.recording.counters.clock_steps == 1


@pytest.mark.parametrize("step", [2 * SECOND, -2 * SECOND])
def test_clock_step_of_a_publisher_is_detected(step: int) -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(1000)
    for _ in range(20):
        bench.sim.state("rig1", bench.wall + step)
        bench.accept(bench.sim.batch())
        bench.wait(20 * MS)
    assert bench.file.recording.counters.clock_steps == 1


def test_outage_is_not_a_clock_step() -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(1000)
    for _ in range(250):
        bench.sim.state("rig1", bench.wall)
        bench.wait(20 * MS)
    bench.accept(bench.sim.batch())
    bench.states(50)
    assert bench.file.recording.counters.clock_steps == 0


def test_continued_session_skips_duplicates_and_counts_the_gap() -> None:
    bench = TrackerBench()
    known = [bench.sim.state("rig1", bench.wall + number) for number in range(4)]
    bench.store.seen = {(1, message.sequence, message.publish_ns) for message in known}
    bench.store.last = {1: (4, known[-1].publish_ns)}
    bench.accept(bench.sim.batch())
    for number in range(4, 7):
        bench.sim.state("rig1", bench.wall + number)
    bench.sim.batch()
    bench.sim._sequences[STATE.key(LAB, "rig1")] = 7
    bench.accept(bench.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    assert bench.file.payloads == []
    # A restarted recorder knows no earlier sequence numbers. The gap is detected by the previous segment.
    bench.sim.name = "sim/2"
    bench.wait(SECOND)
    new = bench.states(1)
    assert bench.file.payloads == payloads(*new)
    assert bench.file.recording.counters.lost_recorder == 3


@pytest.mark.parametrize("opened_before_the_gap", [True, False])
def test_gap_between_segments_is_counted_once(opened_before_the_gap: bool) -> None:
    bench = TrackerBench()
    known = [bench.sim.state("rig1", bench.wall + number) for number in range(4)]
    bench.store.seen = {(1, message.sequence, message.publish_ns) for message in known}
    bench.store.last = {1: (4, known[-1].publish_ns)}
    bench.accept(bench.sim.batch())
    for lost in range(3):
        bench.sim.state("rig1", bench.wall + 4 + lost)
    bench.sim.batch()
    bench.sim.sequence -= 1
    session = OpenSession(rig="rig1", session="s1")
    if opened_before_the_gap:
        bench.accept(bench.edge.batch(sessions=[session]))
    wanted = bench.sim.state("rig1", bench.wall + 7)
    bench.accept(bench.sim.batch())
    if not opened_before_the_gap:
        bench.accept(bench.edge.batch(sessions=[session]))
    assert bench.file.payloads == payloads(wanted)
    counters = bench.file.recording.counters
    assert (counters.lost_transport, counters.lost_recorder) == (3, 0)


@pytest.mark.parametrize("stopped", [None, 3 * SECOND, -30 * SECOND])
def test_loss_of_a_restarted_simulation_is_estimated(stopped: int | None) -> None:
    bench = TrackerBench()
    begin = bench.wall
    bench.store.seen = {(1, 101 + number, begin - (99 - number) * 20 * MS) for number in range(100)}
    bench.store.last = {1: (200, begin)}
    bench.accept(bench.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    bench.wait(5 * SECOND)
    if stopped is not None:
        event = Event(rig="rig1", kind=Event.STATE_LOST, wall_ns=begin + stopped + SECOND)
        event.watchdog_data.silent_ns = SECOND
        bench.edge.put(EVENT, "rig1", event, bench.wall)
        bench.accept(bench.edge.batch())
    bench.states(1)
    bench.tracker.flush()
    expected = 150 if stopped == 3 * SECOND else 250
    lost = bench.file.recording.counters.lost_recorder
    assert lost == pytest.approx(expected, abs=1)
    bench.wait(SECOND)
    assert bench.store.losses == [(STATE.key(LAB, "rig1"), 0, lost)]


def test_recorded_messages_that_are_not_fetched_are_not_lost() -> None:
    bench = TrackerBench()
    known = [bench.sim.state("rig1", bench.wall + number) for number in range(100)]
    bench.store.seen = {(1, message.sequence, message.publish_ns) for message in known}
    bench.store.last = {1: (100, known[-1].publish_ns)}
    bench.sim.batch()
    bench.sim.sent.clear()
    bench.accept(bench.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    # The simulation was killed while its cache was fetched: 40 messages, then the ones that were received live.
    fetched = FakeSource("sim/1")
    for number in range(40):
        fetched.state("rig1", bench.wall + number)
    bench.accept(fetched.batch())
    fetched._sequences[STATE.key(LAB, "rig1")] = 150
    fetched.state("rig1", bench.wall + 150)
    bench.accept(fetched.batch())
    assert len(bench.file.payloads) == 1
    counters = bench.file.recording.counters
    assert (counters.lost_transport, counters.lost_recorder) == (50, 0)


def test_messages_before_the_horizon_are_skipped() -> None:
    bench = TrackerBench()
    bench.store.seen = set()
    bench.store.horizon_ns = {1: bench.wall}
    bench.sim.state("rig1", bench.wall - 1)
    wanted = bench.sim.state("rig1", bench.wall)
    bench.accept(bench.sim.batch())
    bench.accept(bench.edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    assert bench.file.payloads == payloads(wanted)


def test_session_that_cannot_be_opened_is_retried() -> None:
    bench = TrackerBench()
    bench.store.accepts = False
    session = OpenSession(rig="rig1", session="s1")
    bench.accept(bench.edge.batch(sessions=[session]))
    bench.store.accepts = True
    bench.accept(bench.edge.batch(sessions=[session]))
    assert bench.store.files == []
    bench.wait(11 * SECOND)
    bench.accept(bench.edge.batch(sessions=[session]))
    assert bench.file.end == ""


def test_stop_closes_all_recordings() -> None:
    bench = TrackerBench()
    bench.start("s1", "rig1")
    bench.start("s2", "rig2")
    bench.end("s2", "rig2")
    bench.tracker.stop()
    assert [file.end for file in bench.store.files] == ["recorder stopped", "ended"]


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
def test_invalid_session_and_rig_names_are_rejected(session: str, rig: str) -> None:
    bench = TrackerBench()
    event = Event(rig=rig, session=session, kind=Event.SESSION_START)
    bench.edge.put(EVENT, "rig1", event, bench.wall)
    bench.accept(bench.edge.batch())
    assert bench.store.files == []
    assert len(bench.store.rejected) == 1


def one_message(publish_ns: int = WALL, sequence: int = 1, **batch_fields: Any) -> LogBatch:
    batch = LogBatch(**{"source": "edge/west", "incarnation": 1, "sequence": 1, **batch_fields})
    put_entries(batch, [(EVENT.key(LAB, "rig2"), sequence, publish_ns, Event(rig="rig2").SerializeToString())])
    return batch


@pytest.mark.parametrize(
    "batch",
    [
        one_message(publish_ns=-1),
        one_message(publish_ns=-(1 << 63)),
        one_message(sequence=1 << 63),
        one_message(sequence=(1 << 64) - 1),
        one_message(incarnation=(1 << 64) - 1),
        LogBatch(source="edge/west", incarnation=1, sequence=1 << 63),
        one_message(sessions=[OpenSession(rig="rig2", session="s", start_wall_ns=-(1 << 63))]),
        one_message(sessions=[OpenSession(rig="rig2", session=f"s{number}") for number in range(5_000)]),
        one_message(sessions=[OpenSession(rig="rig2", session="s" * 5_000)]),
    ],
)
def test_batch_with_a_value_out_of_bounds_is_refused(batch: LogBatch) -> None:
    with pytest.raises(DecodeError):
        decode_batch(encode_batch(batch))
    assert decode_batch(encode_batch(one_message())).source == "edge/west"


@pytest.mark.parametrize(
    "event",
    [
        Event(rig="rig1", session="s", kind=Event.SESSION_START, wall_ns=-(1 << 63)),
        Event(rig="rig1", session="s", kind=Event.SESSION_START, step=(1 << 64) - 1),
        Event(rig="rig2", session="s", kind=Event.SESSION_START),
        Event(rig="rig1", session="s", kind=Event.PART_PICKED, part_data=PartData(x=float("nan"))),
        Event(rig="rig1", session="s", kind=Event.SESSION_START, source="s" * 5_000),
    ],
)
def test_invalid_event_is_dropped_and_counted(event: Event) -> None:
    bench = TrackerBench()
    bench.edge.put(EVENT, "rig1", event, bench.wall)
    bench.accept(bench.edge.batch())
    assert (bench.store.files, bench.counters.malformed) == ([], 1)


def test_gap_of_an_invented_number_is_not_a_loss() -> None:
    bench = TrackerBench()
    bench.start()
    bench.states(3)
    bench.edge._sequences[COMMAND.key(LAB, "rig1")] = 1 << 47
    bench.edge.command("rig1", bench.wall)
    bench.edge._sequences[COMMAND.key(LAB, "rig1")] = 1 << 40
    bench.edge.command("rig1", bench.wall)
    bench.accept(bench.edge.batch())
    assert bench.tracker.lost_transport == bench.file.recording.counters.lost_transport
    assert bench.counters.malformed == 2
    assert bench.tracker.lost_transport < 1 << 33


def test_rigs_and_sessions_of_another_certificate_are_dropped() -> None:
    bench = TrackerBench(may_serve=lambda source, rig: (source, rig) != ("edge/west", "rig1"))
    west = FakeSource("edge/west")
    west.start("rig1", "forged", bench.wall)
    west.command("rig1", bench.wall)
    bench.accept(west.batch(sessions=[OpenSession(rig="rig1", session="announced")]))
    assert bench.store.files == []
    assert bench.counters.malformed >= 2
    west.start("rig2", "own", bench.wall)
    bench.accept(west.batch())
    assert [file.recording.session for file in bench.store.files] == ["own"]


def test_messages_of_another_kind_of_service_are_dropped() -> None:
    bench = TrackerBench()
    bench.start()
    forged = bench.edge.state("rig1", bench.wall)
    event = bench.edge.put(EVENT, "sim", Event(kind=Event.OVERRUN, source="sim/1"), bench.wall)
    bench.edge.put(EVENT, "edge", Event(kind=Event.OVERRUN, source="edge/1"), bench.wall)
    bench.accept(bench.edge.batch())
    assert not {forged.payload, event.payload} & set(bench.file.payloads)
    assert bench.store.rejected == [f"edge/1: key {one.key} is of another service" for one in (forged, event)]
    assert bench.tracker.has_received("edge")


def test_session_is_ended_by_its_owner_only() -> None:
    bench = TrackerBench()
    bench.start()
    other = FakeSource("edge/west")
    other.end("rig1", "s1", bench.wall)
    bench.accept(other.batch())
    assert bench.file.recording.end_wall_ns is None
    assert bench.counters.malformed == 1


def test_sessions_rigs_and_publishers_are_bounded() -> None:
    bench = TrackerBench()
    sessions = [OpenSession(rig="rig1", session=f"s{number}") for number in range(3_000)]
    bench.accept(bench.edge.batch(sessions=sessions))
    assert len(bench.store.files) == MAX_RECORDINGS_PER_RIG
    for number in range(MAX_RIGS + 100):
        bench.sim.state(f"forged{number}", bench.wall)
    bench.accept(bench.sim.batch())
    assert len(bench.tracker._rigs) == MAX_RIGS
    for number in range(MAX_PUBLISHERS + 50):
        bench.accept(LogBatch(source="edge/9", incarnation=number + 1, sequence=1))
        bench.wait(MS)
    assert len(bench.tracker._publishers._publishers) == MAX_PUBLISHERS
    assert {"sim/1", "edge/1"} < bench.tracker.last_received().keys(), "it evicts its own incarnations"


def test_unknown_input_is_reported_once() -> None:
    bench = TrackerBench()
    bench.start()
    batch = LogBatch(source="edge/1", incarnation=1, sequence=2)
    keys = ("hil/lab/rig1/nothing", "hil/elsewhere/rig1/state", "hil/lab/rig1/config", "hil/lab/rig2/event")
    put_entries(batch, [(key, sequence, 0, b"\xff\xff") for sequence in (1, 2) for key in keys])
    bench.accept(batch)
    states = bench.states(2)
    assert len(bench.store.rejected) == 4
    assert set(payloads(*states)) <= set(bench.file.payloads)
