from hypothesis import given
from hypothesis import strategies as st

from hilrig_modbus_edge.device.watchdog import Watchdog, WatchdogState


def test_first_write_arms_the_watchdog() -> None:
    watchdog = Watchdog(100)
    assert watchdog.state is WatchdogState.WAITING
    assert watchdog.deadline_ns is None
    assert not watchdog.check(10_000)


def test_trips_once_and_latches_until_next_write() -> None:
    watchdog = Watchdog(100)
    assert not watchdog.feed(1000)
    assert watchdog.state is WatchdogState.WATCHING
    assert watchdog.deadline_ns == 1100
    assert not watchdog.check(1099)
    assert watchdog.check(1105) == 105
    assert watchdog.state is WatchdogState.TRIPPED
    assert not watchdog.check(5000)
    assert watchdog.feed(6000)
    assert watchdog.state is WatchdogState.WATCHING


def test_timeout_zero_turns_it_off() -> None:
    watchdog = Watchdog(0)
    watchdog.feed(1000)
    assert watchdog.state is WatchdogState.OFF
    assert watchdog.deadline_ns is None
    assert not watchdog.check(10**12)


def test_disarmed_watchdog_does_not_trip() -> None:
    watchdog = Watchdog(100)
    watchdog.feed(1000)
    watchdog.disarm()
    assert not watchdog.check(10_000)
    assert watchdog.state is WatchdogState.WAITING


@given(st.lists(st.integers(1, 300), min_size=1))
def test_trips_exactly_when_a_gap_reaches_the_timeout(gaps: list[int]) -> None:
    watchdog, now_ns = Watchdog(100), 0
    watchdog.feed(now_ns)
    for gap in gaps:
        tripped = [now_ns + t for t in range(1, gap + 1) if watchdog.check(now_ns + t)]
        assert tripped == ([now_ns + 100] if gap >= 100 else [])
        now_ns += gap
        assert watchdog.feed(now_ns) == bool(tripped)
