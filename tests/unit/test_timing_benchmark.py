"""Verdict of the timing benchmark: reasons against a study at a step, and the shortest suitable step."""

from dataclasses import replace

import pytest

from hilrig_cli.bench.timing_benchmark import TimingResult
from hilrig_replay.analysis.distribution import Statistics


def statistics(p50: float, p99: float, p999: float, longest: float) -> Statistics:
    return Statistics(p50=p50, p95=p50, p99=p99, p999=p999, max=longest, mean=p50, std=0.0)


GOOD = TimingResult(
    loaded=False,
    step_ms=20.0,
    seconds=20.0,
    ticks=1000,
    overruns=0,
    missed_steps=0,
    tick_lateness_ms=statistics(0.04, 0.1, 0.3, 0.9),
    bus_ms=statistics(0.5, 1.0, 2.0, 3.0),
    modbus_ms=statistics(0.1, 0.2, 0.5, 1.0),
    loop_ms=statistics(20.0, 20.1, 20.3, 21.0),
    stolen=0.0005,
)


def test_accurate_host_is_suitable() -> None:
    assert GOOD.reasons == ()
    assert GOOD.as_dict()["fit"] is True
    assert replace(GOOD, stolen=None).reasons == ()


@pytest.mark.parametrize(
    ("worse", "reason"),
    [
        ({"ticks": 300}, "only 300 ticks measured, 500 required"),
        (
            {"overruns": 2, "missed_steps": 5},
            "2 of 1000 ticks were more than a step late, at most 0.9 ms; 5 steps were",
        ),
        ({"tick_lateness_ms": statistics(0.04, 0.1, 2.5, 3.0)}, "tick lateness p99.9 is 2.50 ms, more than a tenth"),
        ({"bus_ms": statistics(0.5, 9.8, 12.0, 15.0)}, "bus and Modbus take 10.20 ms (p99), more than half"),
        ({"modbus_ms": statistics(0.5, 4.8, 12.0, 15.0)}, "bus and Modbus take 10.60 ms"),
        (
            {"loop_ms": statistics(20.0, 25.0, 40.0, 40.0)},
            "loop latency p99.9 of a fast controller is 40.0 ms, more than 1.5 steps",
        ),
        ({"stolen": 0.03}, "CPU steal is 3.0 %"),
    ],
)
def test_each_bad_value_is_a_reason(worse: dict[str, object], reason: str) -> None:
    result = replace(GOOD, **worse)  # type: ignore[arg-type]
    assert len(result.reasons) == 1
    assert result.reasons[0].startswith(reason)
    assert result.as_dict()["fit"] is False


def test_shortest_suitable_step() -> None:
    assert GOOD.fit_from_ms == 3
    assert replace(GOOD, tick_lateness_ms=statistics(0.1, 1.0, 2.5, 3.0)).fit_from_ms == 25
    assert replace(GOOD, tick_lateness_ms=statistics(0.1, 0.2, 0.3, 31.0)).fit_from_ms == 31
    slow_bus = replace(GOOD, bus_ms=statistics(0.5, 11.0, 12.0, 12.0))
    assert slow_bus.fit_from_ms == 23
    # At the reported step the same statistics are suitable.
    assert replace(slow_bus, step_ms=float(slow_bus.fit_from_ms)).reasons == ()
