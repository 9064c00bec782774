"""The recording stream: batches that lose nothing and keep the bytes as they were."""

import random

import pytest
from google.protobuf.message import DecodeError

from hilrig_runtime.bus.api import Publisher
from hilrig_runtime.messaging.recording_stream import (
    EVENTS_PERIOD_NS,
    FLUSH_PERIOD_NS,
    SESSIONS_PERIOD_NS,
    RecordingStream,
    batch_cache_depth,
    decode_batch,
    entries_of,
)
from hilrig_schemas import LogBatch, OpenSession


class Collecting(Publisher):
    def __init__(self) -> None:
        self.batches: list[LogBatch] = []
        super().__init__(lambda payload: self.batches.append(decode_batch(payload)))


def test_entries_leave_in_order_with_their_bytes_untouched() -> None:
    out = Collecting()
    log = RecordingStream(out, out, "sim/1", incarnation=7)
    for number in range(3):
        log.append("hil/lab/rig1/state", number + 1, 100 + number, bytes([number, 255]))
    log.flush(0)
    (batch,) = out.batches
    assert (batch.source, batch.incarnation, batch.sequence) == ("sim/1", 7, 1)
    assert list(entries_of(batch)) == [
        ("hil/lab/rig1/state", 1, 100, b"\x00\xff"),
        ("hil/lab/rig1/state", 2, 101, b"\x01\xff"),
        ("hil/lab/rig1/state", 3, 102, b"\x02\xff"),
    ]


def test_a_batch_has_a_checksum_and_any_changed_byte_is_found() -> None:
    sent: list[bytes] = []
    out = Collecting()
    out.put = sent.append
    log = RecordingStream(out, out, "sim/1", incarnation=7)
    log.append("hil/lab/rig1/state", 1, 100, b"payload")
    log.flush(0)
    (payload,) = sent
    batch = decode_batch(payload)
    assert batch.HasField("checksum")
    for at in range(5, len(payload)):
        with pytest.raises(DecodeError):
            decode_batch(payload[:at] + bytes([payload[at] ^ 1]) + payload[at + 1 :])


def test_batches_are_numbered_and_an_empty_one_is_not_sent() -> None:
    out = Collecting()
    log = RecordingStream(out, out, "sim/1", incarnation=7)
    log.flush(0)
    for _ in range(2):
        log.append("k", 1, 0, b"")
        log.flush(0)
    assert [batch.sequence for batch in out.batches] == [1, 2]


def test_a_flush_is_due_once_a_period() -> None:
    out = Collecting()
    log = RecordingStream(out, out, "sim/1", incarnation=7)
    for now in (1_000, 2_000, FLUSH_PERIOD_NS - 1_000, FLUSH_PERIOD_NS, FLUSH_PERIOD_NS + 1_000):
        log.append("k", 1, 0, b"")
        log.flush_if_due(now)
    assert [len(batch.keys) for batch in out.batches] == [1, 3]


def test_open_sessions_are_sent_at_once_and_repeated() -> None:
    out = Collecting()
    log = RecordingStream(out, out, "edge/1", incarnation=7)
    log.set_sessions([OpenSession(rig="rig1", session="s1")])
    log.flush(10)
    log.flush(20)
    log.set_sessions([])
    log.flush(30)
    log.flush(30 + SESSIONS_PERIOD_NS)
    assert [[s.session for s in batch.sessions] for batch in out.batches] == [["s1"], [], []]
    assert all(batch.complete_sessions for batch in out.batches)


def test_jittering_loop_sends_a_batch_each_turn() -> None:
    out = Collecting()
    log = RecordingStream(out, out, "sim/1", incarnation=7)
    jitter = random.Random(1)
    for turn in range(200):
        log.append("hil/lab/rig1/state", turn + 1, turn, b"")
        log.flush_if_due(turn * FLUSH_PERIOD_NS + jitter.randrange(1_000_000))
    assert len(out.batches) >= 198
    # And one that is quicker does not send more often.
    for turn in range(4_000):
        log.append("hil/lab/rig1/state", 201 + turn, turn, b"")
        log.flush_if_due((4_000 + turn) * 1_000_000)
    assert len(out.batches) <= 402


def test_events_are_published_after_the_messages_before_them() -> None:
    out, events = Collecting(), Collecting()
    log = RecordingStream(out, events, "sim/1", incarnation=7)
    log.append("hil/lab/rig1/state", 1, 100, b"")
    log.events.append("hil/lab/rig1/event", 1, 100, b"zero torque")
    log.flush_if_due(0)
    assert [(batch.sequence, batch.events, list(batch.keys)) for batch in out.batches + events.batches] == [
        (1, False, ["hil/lab/rig1/state"]),
        (1, True, ["hil/lab/rig1/event"]),
    ]


def test_many_events_share_a_batch() -> None:
    events = Collecting()
    log = RecordingStream(Collecting(), events, "sim/1", incarnation=7)
    for number in range(20):
        log.events.append("hil/lab/rig1/event", number + 1, 100, b"")
        log.flush_if_due(number * FLUSH_PERIOD_NS)
    assert [len(batch.keys) for batch in events.batches] == [1, EVENTS_PERIOD_NS // FLUSH_PERIOD_NS]
    log.flush(0)
    assert sum(len(batch.keys) for batch in events.batches) == 20


def test_a_few_rigs_are_kept_for_long_and_many_for_ten_seconds() -> None:
    kept_ns = {rigs: batch_cache_depth(rigs, 20.0) * FLUSH_PERIOD_NS for rigs in (1, 30, 50, 100, 500)}
    assert {rigs: ns / 1e9 for rigs, ns in kept_ns.items()} == {1: 30, 30: 30, 50: 20, 100: 10, 500: 10}
    # At a step of 1 ms a rig says twenty times as much.
    assert batch_cache_depth(1, 1.0) == 1500
    assert batch_cache_depth(10, 1.0) == 500
