"""The ingest queue: bounded, in order, with exact counts of dropped messages."""

import threading

from hilrig_recorder.ingest.queue import IngestQueue, ReceivedBatch
from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.recording_stream import encode_batch
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import LogBatch, OpenSession
from hilrig_schemas.topics import LOG, STATE
from support.log_streams import LAB, SECOND, FakeSource
from support.session_tracker import TrackerBench

KEY = STATE.key(LAB, "rig1")


SIM_LOG = LOG.key(LAB, "sim", "1")


def put(queue: IngestQueue, batch: LogBatch) -> None:
    queue.put(LOG.key(LAB, *batch.source.split("/")), batch.SerializeToString())


def put_states(queue: IngestQueue, source: FakeSource, count: int) -> None:
    for _ in range(count):
        source.state("rig1", 1)
        put(queue, source.batch())


def get_all(queue: IngestQueue) -> list[ReceivedBatch]:
    received = []
    while (arrival := queue.get(0)) is not None:
        received.append(arrival)
    return received


def test_batches_keep_order_and_arrival_time() -> None:
    clock = ManualClock()
    queue = IngestQueue(100, clock, Counters())
    source = FakeSource()
    stamps = []
    for _ in range(3):
        clock.advance(SECOND)
        stamps.append(clock.wall_ns())
        put_states(queue, source, 1)
    assert queue.depth == 3
    received = get_all(queue)
    assert [arrival.wall_ns for arrival in received] == stamps
    assert [arrival.batch.sequence for arrival in received] == [1, 2, 3]
    assert (queue.depth, queue.received, queue.dropped) == (0, 3, 0)


def test_full_queue_drops_and_counts_messages() -> None:
    queue = IngestQueue(5, ManualClock(), Counters())
    source = FakeSource()
    put_states(queue, source, 12)
    assert (queue.depth, queue.dropped) == (5, 7)
    received = get_all(queue)
    assert [len(arrival.batch.keys) for arrival in received] == [1] * 5 + [0]
    [dropped] = received[-1].dropped.values()
    assert (dropped.count, dropped.last_sequence, received[-1].batch_count) == (7, 12, 7)
    assert queue.depth == 0


def test_overflow_markers_are_in_order_of_the_drops() -> None:
    queue = IngestQueue(2, ManualClock(), Counters())
    source = FakeSource()
    put_states(queue, source, 3)
    assert queue.get(0) is not None
    put_states(queue, source, 2)
    batches = [(arrival.batch.sequence, bool(arrival.dropped)) for arrival in get_all(queue)]
    assert batches == [(2, False), (3, True), (4, False), (5, True)]


def test_dropped_messages_are_recorder_losses() -> None:
    bench = TrackerBench()
    bench.start()
    queue = IngestQueue(4, ManualClock(bench.now, bench.wall), Counters())
    source = bench.sim
    put_states(queue, source, 3)
    source.state("rig1", 1)
    source.batch()
    put_states(queue, source, 6)
    for arrival in get_all(queue):
        bench.tracker.accept(arrival, bench.now)
    put_states(queue, source, 2)
    for arrival in get_all(queue):
        bench.tracker.accept(arrival, bench.now)
    counters = bench.file.recording.counters
    assert (counters.lost_transport, counters.lost_recorder, counters.lost_batches) == (1, 5, 1)
    assert bench.tracker.lost_recorder == queue.dropped == 5


def test_events_and_announcements_of_dropped_batches_are_kept() -> None:
    queue = IngestQueue(1, ManualClock(), Counters())
    edge = FakeSource("edge/1")
    put_states(queue, edge, 2)
    edge.start("rig1", "s1", 5)
    edge.state("rig1", 6)
    put(queue, edge.batch(sessions=[OpenSession(rig="rig1", session="s1")]))
    marker = get_all(queue)[-1]
    assert list(marker.batch.keys) == ["hil/lab/rig1/event"]
    assert [session.session for session in marker.batch.sessions] == ["s1"]
    assert marker.dropped[KEY].count == 2


def test_empty_queue_accepts_a_batch_of_any_size() -> None:
    queue = IngestQueue(3, ManualClock(), Counters())
    source = FakeSource()
    for number in range(10):
        source.state(f"rig{number}", 1)
    put(queue, source.batch())
    assert [len(arrival.batch.keys) for arrival in get_all(queue)] == [10]


def test_malformed_batches_are_counted_and_ignored() -> None:
    queue = IngestQueue(3, ManualClock(), Counters())
    queue.put(SIM_LOG, b"\xff\xff\xff")
    uneven = FakeSource()
    uneven.state("rig1", 1)
    batch = uneven.batch()
    batch.keys.append("hil/lab/rig2/state")
    put(queue, batch)
    assert (queue.counters.malformed, queue.get(0)) == (2, None)


def test_batch_with_an_overwritten_end_is_not_recorded() -> None:
    source = FakeSource()
    for _ in range(3):
        source.state("rig1", 1)
    sent = encode_batch(source.batch())
    # Bytes that a closing zenoh session writes after a truncated batch: a length and frames of its own.
    following = bytes.fromhex("c009a5b7f08c3b31009e21088585025f0200") * len(sent)
    for length in range(1, len(sent)):
        queue = IngestQueue(10, ManualClock(), Counters())
        queue.put(SIM_LOG, sent[:length] + following[: len(sent) - length])
        queue.put(SIM_LOG, sent[:length])
        assert (queue.counters.malformed, queue.get(0)) == (2, None), f"{length} bytes are as they were sent"
    queue = IngestQueue(10, ManualClock(), Counters())
    queue.put(SIM_LOG, sent)
    queue.put(SIM_LOG, b"")
    assert (queue.counters.malformed, queue.depth) == (1, 3)


def test_queue_of_a_blocked_recorder_is_bounded() -> None:
    queue = IngestQueue(10, ManualClock(), Counters())
    one, two = FakeSource("sim/1"), FakeSource("edge/1")
    for _ in range(2_000):
        put_states(queue, one, 1)
        put_states(queue, two, 1)
    received = get_all(queue)
    assert len(received) == 12
    assert sum(drop.count for arrival in received for drop in arrival.dropped.values()) == 4_000 - 10


def test_concurrent_put_and_get_keep_order_and_counts() -> None:
    queue = IngestQueue(50, ManualClock(), Counters())
    source = FakeSource()
    payloads = []
    for _ in range(3_000):
        source.state("rig1", 1)
        payloads.append(source.batch().SerializeToString())

    def put_all() -> None:
        for payload in payloads:
            queue.put(SIM_LOG, payload)

    thread = threading.Thread(target=put_all)
    thread.start()
    expected, dropped = 1, 0
    while thread.is_alive() or queue.depth:
        arrival = queue.get(0.01)
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
    for arrival in get_all(queue):
        for drop in arrival.dropped.values():
            dropped += drop.count
            expected = drop.last_sequence + 1
    assert expected == 3_001
    assert dropped == queue.dropped
