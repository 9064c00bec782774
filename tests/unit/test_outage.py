"""Outages: since when and until when messages were missing, one report of each outage, and one log message."""

import logging
from collections.abc import Callable

import pytest

from hilrig_runtime.process.event_log import DELAY_NS, OUTAGE_PERIOD_NS, EventLog
from hilrig_runtime.process.outage import RETURN_NS, STEADY_NS, Outage, OutageDetector, describe_outage
from hilrig_schemas import Event

MS = 1_000_000
SECOND = 1_000_000_000


def outages(arrives: Callable[[int], bool], until_s: float, stopped_ms: range = range(0)) -> list[Outage]:
    """Outages of messages that may arrive every 20 ms, for a process that does nothing in the range `stopped_ms`."""
    detector, found, last_ns = OutageDetector(500 * MS), [], 0
    for now_ms in range(20, round(until_s * 1000), 20):
        if now_ms not in stopped_ms:
            if arrives(now_ms):
                last_ns = now_ms * MS
            outage = detector.check(last_ns, now_ms * MS)
            if outage is not None:
                found.append(outage)
    return found


def test_outage_has_its_begin_and_end() -> None:
    begin, end = outages(lambda ms: not 2_000 < ms < 16_000, 20)
    assert (begin.has_ended, begin.since_ns, begin.until_ns) == (False, 2_000 * MS, 2_520 * MS)
    assert (end.has_ended, end.since_ns, end.until_ns, end.silent_ns) == (True, 2_000 * MS, 16_000 * MS, 14 * SECOND)
    assert describe_outage("states", begin, 0) == "no states since 00:00:02.000 UTC"
    assert describe_outage("states", end, 0) == "states received again since 00:00:16.000 UTC, after 14.0 s"


def test_short_interruption_is_not_an_outage() -> None:
    assert outages(lambda ms: ms % 1_000 >= 480, 20) == []


def test_source_that_flaps_has_one_long_outage() -> None:
    found = outages(lambda ms: ms < 1_000 or ms % 2_000 >= 1_000 or ms > 60_000, 75)
    assert len(found) <= 4
    assert found[-1].has_ended
    assert found[-1].until_ns == pytest.approx(60_000 * MS, abs=SECOND)
    assert found[-1].interruptions >= 25
    assert describe_outage("states", found[-1], 0).endswith(f" s with {found[-1].interruptions} interruptions")


def test_returned_source_is_reported_after_steady_messages_only() -> None:
    begin, end = outages(lambda ms: ms < 1_000 or ms == 3_000 or ms > 5_000, 5.02 + RETURN_NS / 1e9 + 0.1)
    assert (begin.since_ns, end.until_ns) == (980 * MS, 5_020 * MS)
    assert STEADY_NS > RETURN_NS


def test_own_stall_is_not_an_outage_of_others() -> None:
    assert outages(lambda _: True, 20, stopped_ms=range(2_000, 16_000)) == []
    # Also if the messages of that time are processed after the first check.
    assert outages(lambda ms: not 2_000 < ms < 16_200, 20, stopped_ms=range(2_020, 16_000)) == []


def test_source_that_never_sent_is_reported() -> None:
    (begin,) = outages(lambda _: False, 3)
    assert not begin.has_ended


def test_outages_of_all_rigs_are_one_log_message(caplog: pytest.LogCaptureFixture) -> None:
    log = EventLog()
    with caplog.at_level(logging.INFO):
        for rig in range(1, 9):
            log.record(Event(rig=f"rig{rig}", kind=Event.STATE_LOST, severity=Event.WARNING, text="no states"), rig)
        log.record(Event(rig="rig1", kind=Event.LIMIT_HIT, text="joint 1"), 9)
        log.flush_if_due(DELAY_NS // 2)
        assert caplog.messages == []
        log.flush_if_due(DELAY_NS + 10)
        assert caplog.messages == ["rig1, rig2, rig3 and 5 more: no states"]
        for now_ns in range(SECOND, OUTAGE_PERIOD_NS, SECOND // 2):
            log.record(Event(rig="rig1", kind=Event.STATE_LOST, severity=Event.WARNING, text="no states"), now_ns)
            log.flush_if_due(now_ns)
        assert len(caplog.messages) == 1
        log.flush_if_due(2 * OUTAGE_PERIOD_NS)
    assert caplog.messages[1:] == ["rig1: no states"]
    assert {record.levelname for record in caplog.records} == {"WARNING"}


def test_different_events_of_a_kind_are_counted_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    log = EventLog()
    with caplog.at_level(logging.INFO):
        for client in ("a", "b", "b"):
            log.record(Event(rig="rig1", kind=Event.LEASE_REFUSED, severity=Event.WARNING, text=f"{client} refused"), 0)
        log.record(Event(kind=Event.OVERRUN, severity=Event.WARNING, text="late"), 0)
        log.flush()
    assert caplog.messages == ["rig1: a refused (and 1 more of this kind: hilrig events)", "late"]


def test_log_message_of_several_rigs_names_the_one_of_its_text(caplog: pytest.LogCaptureFixture) -> None:
    log = EventLog()
    with caplog.at_level(logging.INFO):
        for rig in ("rig2", "rig1", "rig3"):
            log.record(Event(rig=rig, kind=Event.SESSION_START, text=f"session of {rig} started"), 0)
        log.flush()
    assert caplog.messages == ["rig2: session of rig2 started (also rig1, rig3)"]
