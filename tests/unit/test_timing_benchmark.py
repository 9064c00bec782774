"""The verdict on a machine's timekeeping: what speaks against a study at a step, and which step would do."""

from dataclasses import replace

import pytest

from hilrig_cli.bench.timing_benchmark import Timekeeping
from hilrig_replay.analysis.distribution import Statistics


def figures(p50: float, p99: float, p999: float, longest: float) -> Statistics:
    return Statistics(p50=p50, p95=p50, p99=p99, p999=p999, max=longest, mean=p50, std=0.0)


GOOD = Timekeeping(
    loaded=False,
    step_ms=20.0,
    seconds=20.0,
    ticks=1000,
    overruns=0,
    missed_steps=0,
    tick_lateness_ms=figures(0.04, 0.1, 0.3, 0.9),
    bus_ms=figures(0.5, 1.0, 2.0, 3.0),
    modbus_ms=figures(0.1, 0.2, 0.5, 1.0),
    loop_ms=figures(20.0, 20.1, 20.3, 21.0),
    stolen=0.0005,
)


def test_a_machine_that_keeps_time_is_fit() -> None:
    assert GOOD.reasons == ()
    assert GOOD.as_dict()["fit"] is True
    assert replace(GOOD, stolen=None).reasons == ()


@pytest.mark.parametrize(
    ("worse", "reason"),
    [
        ({"ticks": 300}, "300 ticks were measured only, 500 are needed"),
        ({"overruns": 2, "missed_steps": 5}, "2 of 1000 ticks came later than a step, at most 0.9 ms; 5 steps were"),
        ({"tick_lateness_ms": figures(0.04, 0.1, 2.5, 3.0)}, "ticks are 2.50 ms late (p99.9), more than a tenth"),
        ({"bus_ms": figures(0.5, 9.8, 12.0, 15.0)}, "bus and Modbus take 10.20 ms of a step (p99), more than half"),
        ({"modbus_ms": figures(0.5, 4.8, 12.0, 15.0)}, "bus and Modbus take 10.60 ms"),
        ({"loop_ms": figures(20.0, 25.0, 40.0, 40.0)}, "the loop of a quick controller takes 40.0 ms (p99.9)"),
        ({"stolen": 0.03}, "the host takes 3.0 % of the processors away"),
    ],
)
def test_what_speaks_against_it_is_said(worse: dict[str, object], reason: str) -> None:
    judged = replace(GOOD, **worse)  # type: ignore[arg-type]
    assert len(judged.reasons) == 1
    assert judged.reasons[0].startswith(reason)
    assert judged.as_dict()["fit"] is False


def test_the_step_at_which_the_figures_would_do_is_named() -> None:
    assert GOOD.fit_from_ms == 3
    assert replace(GOOD, tick_lateness_ms=figures(0.1, 1.0, 2.5, 3.0)).fit_from_ms == 25
    assert replace(GOOD, tick_lateness_ms=figures(0.1, 0.2, 0.3, 31.0)).fit_from_ms == 31
    judged = replace(GOOD, bus_ms=figures(0.5, 11.0, 12.0, 12.0))
    assert judged.fit_from_ms == 23
    # A step that is named is one at which the same figures are no reason any more.
    assert replace(judged, step_ms=float(judged.fit_from_ms)).reasons == ()
