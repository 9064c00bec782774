"""Confidence intervals: their coverage on known autocorrelated distributions, and the digits that they permit."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm

from hilrig_replay.analysis import intervals
from hilrig_replay.analysis.distribution import Statistics
from hilrig_replay.analysis.intervals import (
    SHARES,
    aggregate,
    cells,
    inefficiency,
    median_over_runs,
    percentile_intervals,
    rounded,
)
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from support.in_process import hilrig_in_process
from support.recordings import Script, record


def autoregressive(rho: float, count: int, random: np.random.Generator) -> np.ndarray:
    """Stationary standard normal values with a correlation of `rho` between neighbors."""
    noise = random.normal(size=count + 300) * math.sqrt(1 - rho**2)
    return np.asarray(lfilter([1], [1, -rho], noise)[300:])


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_intervals_cover_the_percentiles_of_a_known_distribution(rho: float) -> None:
    random, covered = np.random.default_rng(5), dict.fromkeys(SHARES, 0)
    for _ in range(100):
        found = percentile_intervals(20 * np.exp(0.3 * autoregressive(rho, 5000, random)))
        for name, (low, high) in found.items():
            covered[name] += bool(low <= 20 * np.exp(0.3 * norm.ppf(SHARES[name] / 100)) <= high)
    # Of p99.9, five values of 5,000 are above: its upper bound is infinite.
    assert all(90 <= covered[name] <= 98 for name in ("p50", "p95", "p99")), covered
    assert covered["p999"] >= 90


def test_bounds_of_strongly_correlated_values_are_not_too_narrow() -> None:
    random, covered = np.random.default_rng(6), dict.fromkeys(("p50", "p95", "p99"), 0)
    for _ in range(100):
        found = percentile_intervals(autoregressive(0.95, 2000, random))
        for name in covered:
            covered[name] += bool(found[name][0] <= norm.ppf(SHARES[name] / 100) <= found[name][1])
    assert min(covered.values()) >= 85, covered


def test_correlation_reduces_the_effective_number_of_values() -> None:
    random = np.random.default_rng(2)
    correlated, independent = (autoregressive(rho, 4000, random) for rho in (0.9, 0.0))
    assert inefficiency(independent) < 1.5
    # (1 + ρ) / (1 − ρ) = 19.
    assert 12 < inefficiency(correlated) < 28


def test_equal_values_have_a_point_as_interval() -> None:
    assert set(percentile_intervals(np.full(50, 7))) == set(SHARES)
    assert set(percentile_intervals(np.full(20_000, 7)).values()) == {(7.0, 7.0)}


def test_bound_without_support_is_infinite() -> None:
    found = percentile_intervals(np.random.default_rng(1).normal(size=300))
    assert found["p999"][1] == math.inf
    assert found["p50"][1] < 1
    assert percentile_intervals(np.array([3]))["p50"] == (3.0, math.inf)


def test_long_series_gives_the_same_interval_in_less_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    values = autoregressive(0.9, 20_000, np.random.default_rng(3))
    whole = percentile_intervals(values)
    monkeypatch.setattr(intervals, "MAX_SERIES", 1000)
    means = percentile_intervals(lambda: iter(np.array_split(values, 7)))
    for name in ("p50", "p95"):
        assert means[name] == pytest.approx(whole[name], abs=0.05)


def test_median_over_runs_has_a_distribution_free_interval() -> None:
    assert median_over_runs([3.0, 1.0, 2.0]) == (2.0, None)
    assert median_over_runs([1, 2, 3, 4, 5]) == (3.0, None)
    # With ten runs, the second and the ninth value: 97.9 %.
    assert median_over_runs(range(10)) == (4.5, (1.0, 8.0))
    random, covered = np.random.default_rng(4), 0
    for _ in range(400):
        _, interval = median_over_runs(random.exponential(size=12).tolist())
        assert interval is not None
        covered += interval[0] <= math.log(2) <= interval[1]
    assert 0.93 * 400 <= covered <= 0.99 * 400


def test_aggregate_skips_runs_without_a_loop() -> None:
    runs = [{"loop_ms": {"p50": float(value)}, "age_ms": None} for value in range(7)]
    found = aggregate([*runs, {"loop_ms": None, "age_ms": None}])
    assert found == {"loop_ms": {"p50": {"runs": 7, "median": 3.0, "interval": (0.0, 6.0)}}}


@pytest.mark.parametrize(
    ("value", "interval", "text"),
    [
        (83.456, (80.1, 94.1), "80"),
        (83.456, (82.0, 84.5), "83"),
        (83.456, (83.4, 83.52), "83.5"),
        (20.0004, (20.0004, 20.0004), "20.000"),
        (83.456, (83.0, math.inf), "83.5"),
        (19.9996, None, "20.000"),
        (26019.94, None, "26020"),
        (26019.94, (25000.0, 27500.0), "26000"),
        (4.2, (3.7, 20.0), "<10"),
        (0.0, (0.0, 0.2), "0.0"),
    ],
)
def test_digits_are_no_finer_than_the_interval(value: float, interval: tuple[float, float] | None, text: str) -> None:
    assert rounded(value, interval) == text


def test_statistics_without_intervals_fit_a_terminal() -> None:
    statistics = Statistics(0.5, 20.0, 999.9994, 1000.0, 26019.94, 1234.5, 7498.4)
    assert cells(statistics) == ["0.500", "20.000", "999.999", "1000", "26020", "1234", "7498"]
    known = {"p50": (0.4, 0.6), "p999": (900.0, 1100.0)}
    assert cells(statistics, known) == ["0.5", "20.000", "999.999", "1000", "26000", "1234.5", "7498.4"]


def test_report_has_the_intervals_of_loop_stages_and_age(tmp_path: Path) -> None:
    report = measure(open_run(record(tmp_path / "run.mcap", Script(seconds=8.0, poll_ms=33.0))))
    plain = report.as_dict()
    assert set(plain["intervals_ms"]) == {"loop", "age", "tick_lateness", *plain["stages_ms"]}
    for quantity in ("loop", "age"):
        for name, (low, high) in plain["intervals_ms"][quantity].items():
            assert low <= plain[f"{quantity}_ms"][name] <= (math.inf if high is None else high)


def test_table_of_runs_fits_a_terminal_of_80_characters(tmp_path: Path) -> None:
    names = [f"20261201T01133{number}Z-rig1-abcd" for number in range(6)]
    for number, name in enumerate(names):
        record(tmp_path / f"{name}.mcap", Script(seconds=1.0, poll_ms=20.0 + 7 * number, seed=number))
    table = hilrig_in_process("latency", tmp_path).stdout.partition(f"{names[0]}: ")[0]
    assert max(map(len, table.splitlines())) <= 80
    assert "…" not in table
    # Names are folded.
    labels = "".join(line[:18].strip() for line in table.splitlines())
    assert all(name in labels for name in names)
    assert labels.endswith("median over runs95 % interval fromto")
