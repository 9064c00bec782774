"""Stalls of the edge: number and longest of the late ticks, at most one report a second."""

from hilrig_modbus_edge.stalls import StallReporter
from hilrig_runtime.timing.rate import Tick
from hilrig_schemas import Event
from support.device_bench import MS, Bench

PERIOD_NS = 20 * MS


def reports_of(latenesses_ms: list[int], wait_ms: int = 20) -> list[tuple[int, int]]:
    """Report the late ticks of a rate whose ticks start `wait_ms` after the one before, or late."""
    reports: list[tuple[int, int]] = []
    reporter = StallReporter(PERIOD_NS, lambda count, longest_ns: reports.append((count, longest_ns // MS)))
    now_ns = 0
    for late_ms in latenesses_ms:
        now_ns += (wait_ms + late_ms) * MS
        missed, late_ns = divmod(late_ms * MS, PERIOD_NS)
        reporter.on_tick(Tick(now_ns - late_ns, late_ns, missed), now_ns)
    return reports


def test_lateness_of_at_most_one_period_is_no_stall() -> None:
    assert reports_of([0, 5, 19, 20]) == []
    assert reports_of([21]) == [(1, 21)]


def test_stalls_of_a_second_are_reported_with_their_number() -> None:
    assert reports_of([190, 0, 60, 0, 75, 0]) == [(1, 190)]
    assert reports_of([190, 0, 60, 0, 75] + [0] * 60) == [(1, 190), (2, 75)]
    assert sum(count for count, _ in reports_of([200] * 12 + [0] * 60)) == 12


def test_event_names_the_stalls_of_a_rig_with_a_session() -> None:
    bench = Bench()
    bench.state(3)
    bench.device.report_stalls(1, 60 * MS)
    assert bench.events == []
    client = bench.connect()
    bench.read(client, 4, 4)
    bench.write(client, 0, 1)
    bench.device.report_stalls(1, 187 * MS)
    bench.device.report_stalls(12, 201 * MS)
    one, more = bench.events[-2:]
    assert one.kind == more.kind == Event.OVERRUN
    assert one.severity == Event.WARNING
    assert one.session == bench.device.session.id
    assert one.step == 3
    assert (more.overrun_data.stalls, more.overrun_data.lateness_ns) == (12, 201 * MS)
    assert one.text == "the edge stalled once for 187 ms: its host was overloaded, or it was stopped"
    assert more.text.startswith("the edge stalled 12 times, at most for 201 ms:")
