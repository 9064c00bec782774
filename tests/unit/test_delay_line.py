"""Messages on an impaired way: held up, lost, overtaken; and which impairment is in force when."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilrig_modbus_edge.impairment.delay_line import Line, StateWay
from hilrig_modbus_edge.impairment.schedule import Course
from hilrig_runtime.config.impairment import PRESETS, ImpairmentConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload

MS = 1_000_000


def line(*fates: tuple[int, bool]) -> Line[str]:
    return Line(iter(fates))


def test_each_message_arrives_after_its_own_delay() -> None:
    way = line((30, False), (30, False))
    assert way.put("a", 100)
    assert way.put("b", 110)
    assert way.next_ns == 130
    assert way.take(129) is None
    assert way.take(130) == ("a", 30)
    assert way.take(139) is None
    assert way.take(200) == ("b", 30)
    assert way.next_ns is None


def test_what_is_lost_does_not_arrive_and_overtakes_nobody() -> None:
    way = line((50, False), (1, True))
    assert way.put("a", 0)
    assert not way.put("b", 10)
    assert way.take(50) == ("a", 50)
    assert (way.count, way.lost, way.overtaken) == (2, 1, 0)


def test_what_is_overtaken_is_dropped() -> None:
    way = line((100, False), (90, False), (10, False))
    for start, item in enumerate("abc"):
        way.put(item, start)
    assert way.take(1000) == ("c", 10)
    assert way.take(1000) is None
    assert way.overtaken == 2


def test_when_the_way_is_freed_the_newest_arrives_at_once() -> None:
    way = line((100, False), (100, False))
    way.put("a", 0)
    way.put("b", 20)
    assert way.take_newest(50) == ("b", 30)
    assert (way.next_ns, way.overtaken) == (None, 1)
    assert way.take_newest(50) is None


@given(
    messages=st.lists(st.tuples(st.integers(0, 50), st.integers(0, 300), st.booleans()), max_size=60),
    looks=st.lists(st.integers(0, 3000), max_size=30),
)
def test_a_reader_sees_the_newest_state_that_has_arrived_and_never_an_older_one(
    messages: list[tuple[int, int, bool]], looks: list[int]
) -> None:
    """Held against the definition: of all whose release time has passed, the one that set out last."""
    way = StateWay(iter([(delay, lost) for _, delay, lost in messages]), None)
    starts = list(itertools.accumulate(gap for gap, _, _ in messages))
    for start, number in zip(starts, range(len(messages)), strict=True):
        way.arrive(TimestampedPayload(bytes([number]), start))
    seen = -1
    # What is read before all have come is no other case: a message is drawn for by its number.
    for now in sorted(looks):
        released = [
            number
            for number, (start, (_, delay, lost)) in enumerate(zip(starts, messages, strict=True))
            if not lost and start + delay <= now
        ]
        shown = way.newest(now)
        if not released:
            assert shown is None
            continue
        assert shown is not None
        assert shown.payload[0] == max(released)
        assert shown.injected_ns == messages[max(released)][1]
        assert shown.payload[0] >= seen
        seen = shown.payload[0]


def test_a_state_that_was_shown_stays_until_a_newer_one_has_arrived() -> None:
    first = TimestampedPayload(b"first", 0)
    way = StateWay(itertools.repeat((100, False)), first)
    assert way.newest(10) is first
    way.arrive(TimestampedPayload(b"second", 20))
    assert way.newest(119) is first
    second = way.newest(120)
    assert second == TimestampedPayload(b"second", 20, 100)
    assert way.newest(500) is second


@given(delays=st.lists(st.integers(0, 1000), min_size=1, max_size=200))
def test_commands_leave_in_the_order_of_their_numbers(delays: list[int]) -> None:
    way = Line(iter([(delay, False) for delay in delays]))
    left: list[int] = []
    for number, _ in enumerate(delays):
        way.put(number, 10 * number)
        while (arrived := way.take(10 * number)) is not None:
            left.append(arrived.item)
    while (arrived := way.take(10**6)) is not None:
        left.append(arrived.item)
    assert left == sorted(left)
    assert left[-1] == len(delays) - 1
    assert len(left) + way.overtaken == len(delays)


# -- which one is in force


def scheduled() -> ImpairmentConfig:
    entries = [{"at_s": 0.5, "preset": "vpn"}, {"at_s": 2, "preset": "none"}, {"at_s": 3, "state": "constant:7"}]
    return ImpairmentConfig.model_validate({"preset": "mobile", "seed": 9, "schedule": entries})


def test_a_schedule_runs_from_the_start_of_each_session() -> None:
    course = Course(scheduled())
    assert not course.check(10**12)
    assert (course.links, course.source, course.seed) == (PRESETS["mobile"], "lab.toml", 9)
    for start_ns in (5_000 * MS, 50_000 * MS):
        course.begin_session(start_ns)
        assert not course.check(start_ns + 499 * MS)
        assert course.links == PRESETS["mobile"]
        assert course.check(start_ns + 500 * MS)
        assert (course.links, course.source) == (PRESETS["vpn"], "schedule")
        assert not course.check(start_ns + 501 * MS)
        # A check that comes late goes straight to what holds by then.
        assert course.check(start_ns + 3_100 * MS)
        assert course.links.describe() == "state way constant delay 7 ms; command way none"


def test_what_is_set_by_hand_holds_until_it_is_taken_back() -> None:
    course = Course(scheduled())
    course.begin_session(0)
    course.set_by_hand(ImpairmentConfig(preset="wired", seed=3))
    assert not course.check(600 * MS)
    course.begin_session(10_000 * MS)
    assert not course.check(11_000 * MS)
    assert (course.links, course.source, course.seed) == (PRESETS["wired"], "hand", 3)
    course.set_as_lab()
    assert (course.links, course.source, course.seed) == (PRESETS["mobile"], "lab.toml", 9)
    assert not course.check(12_000 * MS), "the schedule waits for the next session"
    course.begin_session(20_000 * MS)
    assert course.check(20_600 * MS)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_quick_enough_for_a_watchdog(preset: str) -> None:
    """A mean delay of both ways far below its second, and losses that are not the rule."""
    from hilrig_modbus_edge.impairment.model import Impairment

    total_ms = 0.0
    for way in (PRESETS[preset].state, PRESETS[preset].command):
        delay_ns, lost = Impairment(way, 1).draw(20_000)
        total_ms += delay_ns.mean() / 1e6
        assert lost.mean() < 0.03
    assert total_ms < 100
