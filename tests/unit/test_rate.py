"""The loop's rate: one grid of deadlines, lateness as data, no burst after a stall."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilrig_runtime.timing.clock import ManualClock
from hilrig_runtime.timing.rate import Rate

PERIOD = 20_000_000


def test_deadlines_are_on_a_fixed_grid() -> None:
    clock = ManualClock()
    rate = Rate(PERIOD, clock)
    first = rate.wait().deadline_ns
    for number in range(1, 50):
        clock.advance(number * 300_000)
        tick = rate.wait()
        assert tick.deadline_ns == first + number * PERIOD
        assert tick.missed_steps == 0


def test_late_tick_keeps_deadline_and_has_lateness() -> None:
    clock = ManualClock()
    rate = Rate(PERIOD, clock)
    first = rate.wait().deadline_ns
    clock.advance(PERIOD + 7_000_000)
    tick = rate.wait()
    assert (tick.deadline_ns, tick.lateness_ns, tick.missed_steps) == (first + PERIOD, 7_000_000, 0)


def test_stall_skips_and_counts_whole_periods() -> None:
    clock = ManualClock()
    rate = Rate(PERIOD, clock)
    first = rate.wait().deadline_ns
    clock.advance(5 * PERIOD + 3_000_000)
    stalled = rate.wait()
    assert (stalled.missed_steps, stalled.lateness_ns) == (4, 3_000_000)
    assert stalled.deadline_ns == first + 5 * PERIOD
    after = rate.wait()
    assert (after.missed_steps, after.lateness_ns) == (0, 0)
    assert clock.monotonic_ns() == first + 6 * PERIOD, "the next tick comes a whole period later, not in a burst"


@given(st.lists(st.integers(min_value=0, max_value=10 * PERIOD), max_size=50))
def test_every_deadline_is_ticked_or_counted_as_missed(work: list[int]) -> None:
    clock = ManualClock()
    rate = Rate(PERIOD, clock)
    first = rate.wait().deadline_ns
    accounted = 0
    for duration in work:
        clock.advance(duration)
        tick = rate.wait()
        accounted += 1 + tick.missed_steps
        assert tick.deadline_ns == first + accounted * PERIOD
        assert 0 <= tick.lateness_ns < PERIOD
        assert clock.monotonic_ns() >= tick.deadline_ns


def test_deadlines_missed_in_sleep_are_counted() -> None:
    class Oversleeping(ManualClock):
        def sleep_until_ns(self, deadline_ns: int) -> None:
            super().sleep_until_ns(deadline_ns + 2 * PERIOD + 1)

    tick = Rate(PERIOD, Oversleeping()).wait()
    assert (tick.missed_steps, tick.lateness_ns) == (2, 1)


def test_period_must_be_positive() -> None:
    with pytest.raises(ValueError, match="the period must be > 0 ns, got 0"):
        Rate(0)


def test_next_deadline_is_known_before_wait() -> None:
    clock = ManualClock()
    rate = Rate(20_000_000, clock)
    for _ in range(3):
        expected_ns = rate.next_ns
        assert rate.wait().deadline_ns == expected_ns
        clock.advance(5_000_000)


def test_setting_the_next_deadline_shifts_the_grid() -> None:
    clock = ManualClock()
    rate = Rate(PERIOD, clock)
    first = rate.wait().deadline_ns
    rate.next_ns += PERIOD // 4
    assert [rate.wait().deadline_ns - first for _ in range(2)] == [PERIOD * 5 // 4, PERIOD * 9 // 4]


def test_restart_sets_the_deadline_one_period_from_now() -> None:
    clock = ManualClock()
    rate = Rate(PERIOD, clock)
    clock.advance(7 * PERIOD + 3)
    rate.restart()
    assert rate.remaining_s == PERIOD * 1e-9
    assert rate.tick(rate.next_ns).missed_steps == 0
