"""Confidence intervals of percentiles of autocorrelated values, and of medians over runs.

Consecutive loop latencies and ages depend on each other: a stall or a drifting phase makes many of them long. The
interval of a percentile is that of R. S. Woodruff (1952): the share of the values below it has a confidence interval,
and the percentiles of both bounds are the interval. The interval of the share is that of Clopper and Pearson with an
effective number of values (E. L. Korn, B. I. Graubard, 1998), which follows from the long-run variance of the indicator
of the values below. That variance is estimated with a flat-top lag window and the automatic bandwidth of D. N. Politis
and H. White (2004).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, betaincinv

from hilrig_replay.analysis.distribution import Floats, Statistics, percentiles
from hilrig_replay.io.disk_table import Blocks

CONFIDENCE: Final = 0.95
MAX_SERIES: Final = 1 << 16
"""Longest series whose variance is estimated; of a longer one, means of consecutive values."""
SHARES: Final = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p999": 99.9}
"""Percentages by the names of the fields of `Statistics`."""
MIN_ABOVE: Final = 10
"""Values above a percentile that an upper bound needs: with 1,000 values p99, with 10,000 p99.9."""
MIN_EFFECTIVE_ABOVE: Final = 4
"""The same, of the effective number of values."""
MAX_DECIMALS: Final = 3

Interval = tuple[float, float]


def percentile_intervals(values: NDArray[Any] | Blocks) -> dict[str, Interval]:
    """Confidence intervals of the percentiles `SHARES`, in the unit of the values: (n,) or blocks, n ≥ 1, in order.

    An upper bound that is supported by fewer than `MIN_ABOVE` values is infinite.
    """
    blocks = values if callable(values) else lambda: iter((values,))
    found = percentiles(blocks, tuple(SHARES.values()))
    count = sum(len(block) for block in blocks())
    shares, supported = [], []
    for share, (series, variance) in zip(SHARES.values(), _indicators(blocks, found, count), strict=True):
        # Long-run variance of the indicators over their variance; a group has the mean of several.
        group = count / len(series)
        factor = group * float(series.var()) * inefficiency(series) / variance if variance > 0 else 1.0
        effective = count / max(factor, 1.0)
        shares.append(share_interval(share / 100, effective))
        above = 1 - share / 100
        supported.append(above * count >= MIN_ABOVE and above * effective >= MIN_EFFECTIVE_ABOVE)
    bounds = percentiles(blocks, [100 * bound for pair in shares for bound in pair]).reshape(-1, 2).tolist()
    return {
        name: (low, high if is_supported else math.inf)
        for name, is_supported, (low, high) in zip(SHARES, supported, bounds, strict=True)
    }


def _indicators(blocks: Blocks, limits: Floats, count: int) -> list[tuple[Floats, float]]:
    """For each limit: whether each value is below (1), equal (½) or above (0), and the variance of that.

    Of many values, the means of consecutive ones.
    """
    size = -(-count // MAX_SERIES)
    sums, squares = np.zeros((len(limits), -(-count // size))), np.zeros(len(limits))
    position = 0
    for block in blocks():
        at = (position + np.arange(len(block))) // size
        for row, limit in enumerate(limits):
            below = ((block < limit).astype(np.float64) + (block <= limit)) / 2
            sums[row] += np.bincount(at, below, minlength=sums.shape[1])
            squares[row] += float((below**2).sum())
        position += len(block)
    # An incomplete last group is of other size, which hardly matters in a long series.
    variances = squares / count - (sums.sum(axis=1) / count) ** 2
    return [(series / size, float(variance)) for series, variance in zip(sums, variances, strict=True)]


def inefficiency(series: Floats) -> float:
    """Factor by which the autocorrelation of a series, (n,), increases the variance of its mean, at least 1."""
    count = len(series)
    moved = series - series.mean()
    if count < 4 or not moved.any():
        return 1.0
    spectrum = np.abs(np.fft.rfft(moved, 2 * count)) ** 2
    covariance = np.fft.irfft(spectrum, 2 * count)[: count // 2] / count
    correlation = covariance / covariance[0]
    # The lag after which the correlation is not significant for some lags.
    quiet = np.abs(correlation[1:]) < 2 * math.sqrt(math.log10(count) / count)
    needed = min(max(5, math.ceil(math.sqrt(math.log10(count)))), len(quiet))
    runs = np.convolve(quiet, np.ones(needed, np.int64), "valid")
    complete = np.flatnonzero(runs == needed)
    last = int(complete[0]) if len(complete) else len(quiet) // 2
    window = 2 * max(last, 1)
    lags = np.arange(1, min(window, len(correlation) - 1) + 1)
    weight = np.minimum(1.0, 2 * (1 - lags / window))
    return max(1.0, float(1 + 2 * (weight * correlation[lags]).sum()))


def share_interval(share: float, effective: float) -> Interval:
    """Clopper–Pearson interval of a share, 0 to 1, that was found in an effective number of values."""
    below, above = share * effective, (1 - share) * effective
    tail = (1 - CONFIDENCE) / 2
    low = float(betaincinv(below, above + 1, tail)) if below > 0 else 0.0
    high = float(betaincinv(below + 1, above, 1 - tail)) if above > 0 else 1.0
    return low, high


def median_over_runs(values: Sequence[float]) -> tuple[float, Interval | None]:
    """Median of a figure over runs, and its distribution-free interval; None: fewer than six runs.

    The interval is between two order statistics: the number of runs below the median is binomially distributed.
    """
    ordered, count = np.sort(np.asarray(values, np.float64)), len(values)
    median = float(np.median(ordered))
    # A quantile of the binomial distribution.
    below = int(np.searchsorted(bdtr(np.arange(count), count, 0.5), (1 - CONFIDENCE) / 2))
    if not below:
        return median, None
    return median, (float(ordered[below - 1]), float(ordered[count - below]))


def aggregate(reports: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    """Median and interval over runs of each figure of the loop latency and the age, from JSON values of the runs."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for quantity in ("loop_ms", "age_ms"):
        figures = [report[quantity] for report in reports if report[quantity] is not None]
        for name in figures[0] if figures else ():
            median, interval = median_over_runs([figure[name] for figure in figures])
            values = {"runs": len(figures), "median": median, "interval": interval}
            found.setdefault(quantity, {})[name] = values
    return found


def rounded(value: float, interval: Interval | None) -> str:
    """A value as text, with no digit finer than the width of its interval; "<10": it is less than half of that.

    None: the interval is not known; with `MAX_DECIMALS` decimals, whole from 1,000 on so that it fits a terminal.
    """
    if interval is None:
        return f"{value:.{MAX_DECIMALS}f}" if abs(value) < 1_000 else f"{value:.0f}"
    width = interval[1] - interval[0] if interval[1] < math.inf else value - interval[0]
    exponent = math.floor(math.log10(width)) if width > 0 else -MAX_DECIMALS
    decimals = min(-exponent, MAX_DECIMALS)
    near = round(value, decimals)
    return f"<{10.0**-decimals:g}" if not near and value > 0 else f"{near:.{max(decimals, 0)}f}"


def cells(statistics: Statistics, intervals: Mapping[str, Interval] | None = None) -> list[str]:
    """Text of statistics in the order of `STATISTICS_TITLES`; the digits of a percentile follow from its interval.

    The largest value has the digits of the highest percentile, mean and standard deviation those of the median.
    """
    known = intervals or {}
    like = {"max": "p999", "mean": "p50", "std": "p50"}
    names = ("p50", "p95", "p99", "p999", "max", "mean", "std")
    return [rounded(getattr(statistics, name), known.get(like.get(name, name))) for name in names]
