"""The queue between the bus and the recorder: bounded, in order, and exact about what it dropped."""

import threading

from test_sessions import Desk

from hilrig_recorder.ingest.queue import Arrival, Intake
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import OpenSession
from hilrig_schemas.topics import STATE
from support.log_streams import LAB, SECOND, FakeSource

KEY = STATE.key(LAB, "rig1")


def offered(intake: Intake, source: FakeSource, count: int) -> None:
    for _ in range(count):
        source.state("rig1", 1)
        intake.offer("key", source.batch().SerializeToString())


def taken(intake: Intake) -> list[Arrival]:
    arrivals = []
    while (arrival := intake.take(0)) is not None:
        arrivals.append(arrival)
    return arrivals


def test_batches_come_out_as_they_went_in_with_their_arrival() -> None:
    clock = ManualClock()
    intake = Intake(100, clock)
    source = FakeSource()
    stamps = []
    for _ in range(3):
        clock.advance(SECOND)
        stamps.append(clock.wall_ns())
        offered(intake, source, 1)
    assert intake.depth == 3
    arrivals = taken(intake)
    assert [arrival.wall_ns for arrival in arrivals] == stamps
    assert [arrival.batch.sequence for arrival in arrivals] == [1, 2, 3]
    assert (intake.depth, intake.received, intake.dropped) == (0, 3, 0)


def test_a_full_queue_drops_and_says_where_and_how_many() -> None:
    intake = Intake(5, ManualClock())
    source = FakeSource()
    offered(intake, source, 12)
    assert (intake.depth, intake.dropped) == (5, 7)
    arrivals = taken(intake)
    assert [len(arrival.batch.keys) for arrival in arrivals] == [1] * 5 + [0]
    [drop] = arrivals[-1].dropped.values()
    assert (drop.count, drop.last_sequence, arrivals[-1].batches) == (7, 12, 7)
    assert intake.depth == 0


def test_each_stretch_of_drops_stands_where_it_happened() -> None:
    intake = Intake(2, ManualClock())
    source = FakeSource()
    offered(intake, source, 3)
    assert intake.take(0) is not None
    offered(intake, source, 2)
    batches = [(arrival.batch.sequence, bool(arrival.dropped)) for arrival in taken(intake)]
    assert batches == [(2, False), (3, True), (4, False), (5, True)]


def test_dropped_messages_are_losses_of_the_recorder_and_not_of_the_way() -> None:
    desk = Desk()
    desk.start()
    intake = Intake(4, ManualClock(desk.now, desk.wall))
    source = desk.sim
    offered(intake, source, 3)
    source.state("rig1", 1)
    source.batch()
    offered(intake, source, 6)
    for arrival in taken(intake):
        desk.book.accept(arrival, desk.now)
    offered(intake, source, 2)
    for arrival in taken(intake):
        desk.book.accept(arrival, desk.now)
    tally = desk.file.recording.tally
    assert (tally.lost_transport, tally.lost_recorder, tally.lost_batches) == (1, 5, 1)
    assert desk.book.lost_recorder == intake.dropped == 5


def test_events_and_statements_of_what_is_dropped_are_kept() -> None:
    intake = Intake(1, ManualClock())
    edge = FakeSource("edge/1")
    offered(intake, edge, 2)
    edge.start("rig1", "s1", 5)
    edge.state("rig1", 6)
    intake.offer("key", edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]).SerializeToString())
    pile = taken(intake)[-1]
    assert list(pile.batch.keys) == ["hil/lab/rig1/event"]
    assert [session.session for session in pile.batch.sessions] == ["s1"]
    assert pile.dropped[KEY].count == 2


def test_one_batch_larger_than_the_queue_gets_in_when_it_is_empty() -> None:
    intake = Intake(3, ManualClock())
    source = FakeSource()
    for number in range(10):
        source.state(f"rig{number}", 1)
    intake.offer("key", source.batch().SerializeToString())
    assert [len(arrival.batch.keys) for arrival in taken(intake)] == [10]


def test_what_is_no_batch_is_counted_and_passed_over() -> None:
    intake = Intake(3, ManualClock())
    intake.offer("key", b"\xff\xff\xff")
    uneven = FakeSource()
    uneven.state("rig1", 1)
    batch = uneven.batch()
    batch.keys.append("hil/lab/rig2/state")
    intake.offer("key", batch.SerializeToString())
    assert (intake.malformed, intake.take(0)) == (2, None)


def test_a_stuck_recorder_does_not_grow() -> None:
    intake = Intake(10, ManualClock())
    one, two = FakeSource("sim/1"), FakeSource("edge/1")
    for _ in range(2_000):
        offered(intake, one, 1)
        offered(intake, two, 1)
    arrivals = taken(intake)
    assert len(arrivals) == 12
    assert sum(drop.count for arrival in arrivals for drop in arrival.dropped.values()) == 4_000 - 10


def test_offering_and_taking_at_once_loses_nothing_and_keeps_the_order() -> None:
    intake = Intake(50, ManualClock())
    source = FakeSource()
    payloads = []
    for _ in range(3_000):
        source.state("rig1", 1)
        payloads.append(source.batch().SerializeToString())

    def offer_all() -> None:
        for payload in payloads:
            intake.offer("key", payload)

    thread = threading.Thread(target=offer_all)
    thread.start()
    expected, dropped = 1, 0
    while thread.is_alive() or intake.depth:
        arrival = intake.take(0.01)
        if arrival is None:
            continue
        for sequence in arrival.batch.sequences:
            assert sequence == expected
            expected += 1
        for drop in arrival.dropped.values():
            dropped += drop.count
            assert drop.last_sequence == expected + drop.count - 1
            expected = drop.last_sequence + 1
    thread.join()
    for arrival in taken(intake):
        for drop in arrival.dropped.values():
            dropped += drop.count
            expected = drop.last_sequence + 1
    assert expected == 3_001
    assert dropped == intake.dropped
