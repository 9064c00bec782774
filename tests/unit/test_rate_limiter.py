"""Rate limiter: the first occurrence is reported, later ones are counted, and no counted one is lost in the table."""

from hypothesis import given
from hypothesis import strategies as st

from hilrig_runtime.timing.rate_limiter import RateLimiter, RepeatReporter, repeat_suffix

PERIOD = 100


def test_first_is_reported_and_later_ones_are_counted() -> None:
    limiter: RateLimiter[str] = RateLimiter(PERIOD)
    assert [limiter.record("a", now) for now in (0, 1, 99)] == [1, 0, 0]
    assert limiter.record("b", 99) == 1, "keys are independent"
    assert [limiter.record("a", now) for now in (100, 199, 200)] == [3, 0, 2]


def test_remainder_is_due_when_the_period_ends() -> None:
    limiter: RateLimiter[tuple[str, str]] = RateLimiter(PERIOD)
    for now in (0, 10, 20):
        limiter.record(("lease", "session 1"), now)
    limiter.record(("range", "session 1"), 50)
    assert list(limiter.pop_remainders(99)) == []
    assert list(limiter.pop_remainders(100)) == [(("lease", "session 1"), 2)]
    # A report starts a new period, and a key without suppressed occurrences has no remainder.
    assert limiter.record(("lease", "session 1"), 199) == 0
    assert list(limiter.pop_remainders(200)) == [(("lease", "session 1"), 1)]


def test_reports_of_all_keys_are_limited() -> None:
    """The addresses of a flood may all differ."""
    limiter: RateLimiter[int] = RateLimiter(PERIOD, keys=3)
    assert [limiter.record(key, key) for key in range(5)] == [1, 1, 1, 0, 0]
    assert [limiter.record(key, 10) for key in (2, 1, 0)] == [0, 0, 0]
    # The first report is a period old: its key gives way.
    assert limiter.record(4, PERIOD) == 1
    assert [limiter.record(key, PERIOD) for key in (3, 0)] == [0, 0]
    assert limiter.record(1, PERIOD + 1) == 2


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 80), st.booleans()), max_size=60))
def test_every_occurrence_is_reported_once(steps: list[tuple[int, int, bool]]) -> None:
    limiter: RateLimiter[int] = RateLimiter(PERIOD)
    now, reported, last = 0, [0] * 4, dict.fromkeys(range(4), -PERIOD)

    def report(key: int, count: int) -> None:
        if count:
            assert now - last[key] >= PERIOD
            reported[key] += count
            last[key] = now

    for key, wait, polls in steps:
        now += wait
        if polls:
            for found, count in limiter.pop_remainders(now):
                report(found, count)
        report(key, limiter.record(key, now))
    now += PERIOD
    for found, count in limiter.pop_remainders(now):
        report(found, count)
    assert reported == [sum(step[0] == key for step in steps) for key in range(4)]


def test_repeats_are_reported_when_their_period_ends() -> None:
    reports: list[tuple[int, int]] = []
    reporter: RepeatReporter[str, int] = RepeatReporter(PERIOD, lambda item, count: reports.append((item, count)))
    for now in (0, 10, 20):
        reporter.record("a", now, now)
    reporter.check(99)
    assert reports == [(0, 1)]
    reporter.check(100)
    assert reports == [(0, 1), (20, 2)]
    reporter.check(500)
    assert len(reports) == 2


def test_report_counts_nothing_of_a_later_time() -> None:
    reports: list[tuple[int, int]] = []
    reporter: RepeatReporter[str, int] = RepeatReporter(PERIOD, lambda item, count: reports.append((item, count)))
    for now in (0, 10, 20, 10_000):
        reporter.record("a", now, now)
    assert reports == [(0, 1), (20, 2)]
    reporter.flush()
    assert reports[2:] == [(10_000, 1)]
    reporter.record("a", 10_001, 10_001)
    assert reports[3:] == [(10_001, 1)], "the cause has ended: this is a first occurrence"


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 150), st.sampled_from(["record", "check", "flush"]))))
def test_each_occurrence_is_in_one_report(steps: list[tuple[str, int, str]]) -> None:
    reported: dict[str, int] = dict.fromkeys("abc", 0)
    recorded = dict(reported)
    last_ns: dict[str, int] = {}
    now = 0

    def report(item: str, count: int) -> None:
        reported[item] += count
        last_ns[item] = now

    reporter: RepeatReporter[str, str] = RepeatReporter(PERIOD, report, keys=3)
    for key, after, step in steps:
        now += after
        if step == "record":
            recorded[key] += 1
            reporter.record(key, key, now)
        elif step == "check":
            reporter.check(now)
            assert all(reported[one] == recorded[one] for one, at in last_ns.items() if now - at >= PERIOD)
        else:
            reporter.flush()
            assert reported == recorded


def test_further_keys_of_a_period_are_reported_together() -> None:
    """The hosts of a flood may all differ."""
    reports: list[tuple[int, int]] = []
    reporter: RepeatReporter[int, int] = RepeatReporter(
        PERIOD, lambda item, count: reports.append((item, count)), keys=3
    )
    for host in range(50):
        reporter.record(host, host, host)
    assert reports == [(0, 1), (1, 1), (2, 1), (3, 1)]
    reporter.record(1, 1, 60)
    reporter.check(PERIOD + 3)
    assert reports[4:] == [(1, 1), (49, 46)]
    # Their period has ended: new keys have places again.
    reporter.record(70, 70, 3 * PERIOD)
    assert reports[6:] == [(70, 1)]
    reporter.flush()
    assert sum(count for _, count in reports) == 52


def test_repeat_suffix_is_empty_for_one_occurrence() -> None:
    assert (repeat_suffix(1), repeat_suffix(2)) == ("", " (2 times)")
