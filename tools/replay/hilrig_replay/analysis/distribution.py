"""Exact statistics of any number of values, in the memory of one block.

Percentiles are computed without sorting all values: the values are counted in bins, and only the bins that contain the
requested ranks are collected and sorted. Means and standard deviations are merged block by block.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.disk_table import Blocks

MAX_SORTED_VALUES: Final = 1 << 18
"""Maximum number of values that are sorted at once (2 MB)."""
HISTOGRAM_BINS: Final = 1 << 14
CCDF_POINTS: Final = 4000
"""Points of a plotted distribution: several per pixel."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of a quantity, ms. Percentiles are interpolated between samples."""

    p50: float
    p95: float
    p99: float
    p999: float
    max: float
    mean: float
    std: float

    @classmethod
    def of(cls, values_ns: NDArray[np.int64] | Blocks) -> "Statistics":
        """Compute the statistics of values in ns: an array of shape (n,), or blocks; n ≥ 1."""
        blocks = values_ns if callable(values_ns) else lambda: iter((values_ns,))
        count, mean, squares, largest = 0, 0.0, 0.0, -np.inf
        for values in blocks():
            # Chan, Golub, LeVeque: merge the means and squared deviations of two sets of values.
            added, off = len(values), float(values.mean()) - mean
            squares += float(((values - values.mean()) ** 2).sum()) + off * off * count * added / (count + added)
            count += added
            mean += off * added / count
            largest = max(largest, float(values.max()))
        p50, p95, p99, p999 = percentiles(blocks, (50, 95, 99, 99.9)) / 1e6
        return cls(
            p50=float(p50),
            p95=float(p95),
            p99=float(p99),
            p999=float(p999),
            max=largest / 1e6,
            mean=mean / 1e6,
            std=float(np.sqrt(squares / count)) / 1e6,
        )


STATISTICS_TITLES: Final = tuple(field.name.replace("p999", "p99.9") for field in fields(Statistics))
"""Column titles of the fields of `Statistics`."""


def percentiles(blocks: Blocks, shares: Sequence[float], *, max_sorted: int = MAX_SORTED_VALUES) -> Floats:
    """Percentiles of all values together, as `numpy.percentile` computes them (interpolated), shape (shares,).

    Args:
        blocks: the values, at least one; integers above 2**53 are rounded to float64.
        shares: percentages, 0 to 100.
        max_sorted: maximum number of values that are sorted at once.
    """
    count = sum(len(values) for values in blocks())
    at = np.asarray(shares) / 100 * (count - 1)
    below = np.floor(at).astype(np.int64)
    ranks = np.unique(np.concatenate((below, np.minimum(below + 1, count - 1))))
    found = _ranked(blocks, ranks, max_sorted)
    low, high = (found[np.searchsorted(ranks, np.minimum(rank, count - 1))] for rank in (below, below + 1))
    share, apart = at - below, high - low
    # Interpolated from the nearer end, as numpy does.
    return np.asarray(np.where(share < 0.5, low + apart * share, high - apart * (1 - share)))


def median(blocks: Blocks) -> float:
    """Median of all values together, at least one."""
    return float(percentiles(blocks, (50,))[0])


def differences(blocks: Blocks) -> Blocks:
    """Differences between consecutive values, also across blocks."""

    def between() -> Iterator[NDArray[Any]]:
        last: NDArray[Any] | None = None
        for values in blocks():
            followed = values if last is None else np.concatenate((last, values))
            last = followed[-1:]
            if len(followed) > 1:
                yield np.diff(followed)

    return between


def complementary_cdf(blocks: Blocks) -> tuple[Floats, Floats]:
    """Complementary cumulative distribution: evenly spaced values, and for each the share of values ≥ it.

    Shapes (`CCDF_POINTS` + 1,); (1,) if all values are equal.
    """
    count, low, high = _extent(blocks)
    if low == high:
        return np.array([low]), np.ones(1)
    counts = np.zeros(CCDF_POINTS, np.int64)
    for values in blocks():
        counts += np.histogram(values, CCDF_POINTS, (low, high))[0]
    from_here = np.append(np.cumsum(counts[::-1])[::-1], 1)
    return np.linspace(low, high, CCDF_POINTS + 1), from_here / count


def _ranked(blocks: Blocks, ranks: NDArray[np.int64], max_sorted: int) -> Floats:
    """Order statistics: the values at the given ranks (from 0), shape (ranks,)."""
    count, low, high = _extent(blocks)
    if low == high:
        return np.full(len(ranks), low)
    if count <= max_sorted:
        return np.sort(_concatenate(blocks))[ranks]

    def bins(values: NDArray[Any]) -> NDArray[np.intp]:
        return np.minimum((values - low) * (HISTOGRAM_BINS / (high - low)), HISTOGRAM_BINS - 1).astype(np.intp)

    counts = np.zeros(HISTOGRAM_BINS, np.int64)
    for values in blocks():
        counts += np.bincount(bins(values), minlength=HISTOGRAM_BINS)
    ends = np.cumsum(counts)
    bin_of_rank = np.searchsorted(ends, ranks, side="right")
    wanted = np.zeros(HISTOGRAM_BINS, np.bool_)
    wanted[bin_of_rank] = True
    if counts[wanted].sum() <= max_sorted:
        skipped = np.cumsum(np.where(wanted, 0, counts))
        collected = np.sort(_concatenate(lambda: (values[wanted[bins(values)]] for values in blocks())))
        return np.asarray(collected[ranks - skipped[bin_of_rank]])
    # Bins with too many values are divided again.
    found = np.empty(len(ranks))
    for number in np.flatnonzero(wanted):
        in_bin = bin_of_rank == number
        values_in_bin = _select_bin(blocks, bins, int(number))
        found[in_bin] = _ranked(values_in_bin, ranks[in_bin] - (ends[number] - counts[number]), max_sorted)
    return found


def _select_bin(blocks: Blocks, bins: Any, number: int) -> Blocks:
    return lambda: (values[bins(values) == number] for values in blocks())


def _concatenate(blocks: Blocks) -> Floats:
    return np.concatenate([np.asarray(values, np.float64) for values in blocks()])


def _extent(blocks: Blocks) -> tuple[int, float, float]:
    """Number of values, the smallest and the largest value."""
    count, low, high = 0, np.inf, -np.inf
    for values in blocks():
        if len(values):
            count += len(values)
            low, high = min(low, float(values.min())), max(high, float(values.max()))
    return count, low, high
