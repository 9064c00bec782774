"""Unit tests of the delay lines (delay, loss, superseded messages) and of the impairment schedule."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilrig_modbus_edge.impairment.delay_line import DelayedStates, DelayLine
from hilrig_modbus_edge.impairment.schedule import ImpairmentSchedule
from hilrig_runtime.config.impairment import PRESETS, ImpairmentConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload

MS = 1_000_000


def delay_line(*samples: tuple[int, bool]) -> DelayLine[str]:
    return DelayLine(iter(samples))


def test_each_message_has_its_own_delay() -> None:
    line = delay_line((30, False), (30, False))
    assert line.put("a", 100)
    assert line.put("b", 110)
    assert line.next_ns == 130
    assert line.pop_due(129) is None
    assert line.pop_due(130) == ("a", 30)
    assert line.pop_due(139) is None
    assert line.pop_due(200) == ("b", 30)
    assert line.next_ns is None


def test_lost_message_supersedes_no_other() -> None:
    line = delay_line((50, False), (1, True))
    assert line.put("a", 0)
    assert not line.put("b", 10)
    assert line.pop_due(50) == ("a", 50)
    assert (line.count, line.lost, line.superseded) == (2, 1, 0)


def test_superseded_message_is_dropped() -> None:
    line = delay_line((100, False), (90, False), (10, False))
    for start, item in enumerate("abc"):
        line.put(item, start)
    assert line.pop_due(1000) == ("c", 10)
    assert line.pop_due(1000) is None
    assert line.superseded == 2


def test_release_newest_delivers_at_once() -> None:
    line = delay_line((100, False), (100, False))
    line.put("a", 0)
    line.put("b", 20)
    assert line.release_newest(50) == ("b", 30)
    assert (line.next_ns, line.superseded) == (None, 1)
    assert line.release_newest(50) is None


@given(
    messages=st.lists(st.tuples(st.integers(0, 50), st.integers(0, 300), st.booleans()), max_size=60),
    read_times=st.lists(st.integers(0, 3000), max_size=30),
)
def test_reader_gets_newest_delivered_state_never_older(
    messages: list[tuple[int, int, bool]], read_times: list[int]
) -> None:
    """Compared with the definition: the last sent one of all messages whose delay has passed."""
    states = DelayedStates(iter([(delay, lost) for _, delay, lost in messages]), None)
    starts = list(itertools.accumulate(gap for gap, _, _ in messages))
    for start, number in zip(starts, range(len(messages)), strict=True):
        states.arrive(TimestampedPayload(bytes([number]), start))
    seen = -1
    # Reading before all messages were sent is no special case: each message has the sample of its number.
    for now in sorted(read_times):
        released = [
            number
            for number, (start, (_, delay, lost)) in enumerate(zip(starts, messages, strict=True))
            if not lost and start + delay <= now
        ]
        newest = states.newest(now)
        if not released:
            assert newest is None
            continue
        assert newest is not None
        assert newest.payload[0] == max(released)
        assert newest.injected_ns == messages[max(released)][1]
        assert newest.payload[0] >= seen
        seen = newest.payload[0]


def test_served_state_stays_until_newer_one_is_delivered() -> None:
    first = TimestampedPayload(b"first", 0)
    states = DelayedStates(itertools.repeat((100, False)), first)
    assert states.newest(10) is first
    states.arrive(TimestampedPayload(b"second", 20))
    assert states.newest(119) is first
    second = states.newest(120)
    assert second == TimestampedPayload(b"second", 20, 100)
    assert states.newest(500) is second


@given(delays=st.lists(st.integers(0, 1000), min_size=1, max_size=200))
def test_commands_are_delivered_in_order(delays: list[int]) -> None:
    line: DelayLine[int] = DelayLine(iter([(delay, False) for delay in delays]))
    delivered: list[int] = []
    for number, _ in enumerate(delays):
        line.put(number, 10 * number)
        while (message := line.pop_due(10 * number)) is not None:
            delivered.append(message.item)
    while (message := line.pop_due(10**6)) is not None:
        delivered.append(message.item)
    assert delivered == sorted(delivered)
    assert delivered[-1] == len(delays) - 1
    assert len(delivered) + line.superseded == len(delays)


# -- active impairment


def scheduled() -> ImpairmentConfig:
    entries = [{"at_s": 0.5, "preset": "vpn"}, {"at_s": 2, "preset": "none"}, {"at_s": 3, "state": "constant:7"}]
    return ImpairmentConfig.model_validate({"preset": "mobile", "seed": 9, "schedule": entries})


def test_schedule_restarts_with_each_session() -> None:
    schedule = ImpairmentSchedule(scheduled())
    assert not schedule.check(10**12)
    assert (schedule.links, schedule.source, schedule.seed) == (PRESETS["mobile"], "lab.toml", 9)
    for start_ns in (5_000 * MS, 50_000 * MS):
        schedule.start_session(start_ns)
        assert not schedule.check(start_ns + 499 * MS)
        assert schedule.links == PRESETS["mobile"]
        assert schedule.check(start_ns + 500 * MS)
        assert (schedule.links, schedule.source) == (PRESETS["vpn"], "schedule")
        assert not schedule.check(start_ns + 501 * MS)
        # A late check applies the entry that is active by then.
        assert schedule.check(start_ns + 3_100 * MS)
        assert schedule.links.describe() == "state link constant delay 7 ms; command link none"


def test_override_is_active_until_cleared() -> None:
    schedule = ImpairmentSchedule(scheduled())
    schedule.start_session(0)
    schedule.set_override(ImpairmentConfig(preset="wired", seed=3))
    assert not schedule.check(600 * MS)
    schedule.start_session(10_000 * MS)
    assert not schedule.check(11_000 * MS)
    assert (schedule.links, schedule.source, schedule.seed) == (PRESETS["wired"], "override", 3)
    schedule.clear_override()
    assert (schedule.links, schedule.source, schedule.seed) == (PRESETS["mobile"], "lab.toml", 9)
    assert not schedule.check(12_000 * MS), "the schedule must restart with the next session only"
    schedule.start_session(20_000 * MS)
    assert schedule.check(20_600 * MS)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_do_not_trip_the_watchdog(preset: str) -> None:
    """The mean delay of both links is far below the watchdog timeout of 1 s, and losses are rare."""
    from hilrig_modbus_edge.impairment.model import Impairment

    total_ms = 0.0
    for link in (PRESETS[preset].state, PRESETS[preset].command):
        delay_ns, lost = Impairment(link, 1).draw(20_000)
        total_ms += delay_ns.mean() / 1e6
        assert lost.mean() < 0.03
    assert total_ms < 100
