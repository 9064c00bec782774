"""Stalls of the edge as events of a rig: number and longest, at most one event a second, none is lost."""

import pytest

from hilrig_schemas import Event
from support.device_bench import MS, Bench


@pytest.fixture
def bench() -> Bench:
    bench = Bench()
    bench.state(3)
    return bench


def stall(bench: Bench, ms: int, run_delay_ms: int = 0) -> None:
    bench.clock.advance(ms * MS)
    bench.device.report_stall(ms * MS, run_delay_ms * MS, bench.clock.monotonic_ns())


def reported(bench: Bench) -> list[tuple[int, int]]:
    """Number and longest, in ms, of the stalls in each event."""
    data = [event.overrun_data for event in bench.events if event.kind == Event.OVERRUN]
    return [(one.stalls, one.lateness_ns // MS) for one in data]


def test_stalls_without_a_session_are_not_reported(bench: Bench) -> None:
    stall(bench, 60)
    assert bench.events == []


def test_event_names_the_stalls_of_its_session(bench: Bench) -> None:
    client = bench.connect()
    bench.read(client, 4, 4)
    bench.write(client, 0, 1)
    stall(bench, 187)
    event = bench.events[-1]
    assert (event.kind, event.severity, event.step) == (Event.OVERRUN, Event.WARNING, 3)
    assert event.session == bench.session.id
    assert event.text == "the edge stalled once for 187 ms: its host was overloaded, or it was stopped"
    assert reported(bench) == [(1, 187)]


def test_stalls_of_a_second_are_reported_together(bench: Bench) -> None:
    bench.write(bench.connect(), 0, 1)
    for ms in (190, 60, 75):
        stall(bench, ms)
        bench.wait(20)
    assert reported(bench) == [(1, 190)]
    bench.wait(800)
    assert reported(bench) == [(1, 190)]
    bench.wait(5)
    assert reported(bench) == [(1, 190), (2, 75)]
    assert bench.events[-1].text.startswith("the edge stalled 2 times, at most for 75 ms:")
    bench.wait(5000)
    assert len(reported(bench)) == 2


def test_event_has_the_run_delay_of_the_longest_stall(bench: Bench) -> None:
    bench.write(bench.connect(), 0, 1)
    stall(bench, 60)
    for ms, run_delay_ms in ((70, 65), (190, 170), (80, 80)):
        stall(bench, ms, run_delay_ms)
    bench.wait(1000)
    last = [event.overrun_data for event in bench.events if event.kind == Event.OVERRUN][-1]
    assert (last.lateness_ns, last.run_delay_ns) == (190 * MS, 170 * MS)


def test_stalls_at_the_end_of_a_session_are_reported_before_it(bench: Bench) -> None:
    bench.write(bench.connect(), 0, 1)
    for _ in range(12):
        stall(bench, 60)
    bench.device.stop("edge stopped")
    assert sum(count for count, _ in reported(bench)) == 12
    assert bench.kinds()[-2:] == ["OVERRUN", "SESSION_END"]
