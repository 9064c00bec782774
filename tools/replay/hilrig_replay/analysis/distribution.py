"""How the values of a quantity are distributed, however many there are: exactly, and in the memory of a block.

Percentiles need all values in their order, and are found without sorting them: values are counted in bins, and only
those in the bins that the wanted ones fall into are gathered. Means and deviations are merged block by block.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.disk_table import Blocks

GATHERED: Final = 1 << 18
"""So many values are sorted at once, count: 2 MB."""
BINS: Final = 1 << 14
TAIL_POINTS: Final = 4000
"""Of a tail that is drawn: some to a pixel."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Statistics:
    """How a quantity is distributed; ms. Percentiles are interpolated between samples."""

    p50: float
    p95: float
    p99: float
    p999: float
    max: float
    mean: float
    std: float

    @classmethod
    def of(cls, values_ns: NDArray[np.int64] | Blocks) -> "Statistics":
        """Statistics of ns: an array of shape (n,), or blocks; n at least 1."""
        blocks = values_ns if callable(values_ns) else lambda: iter((values_ns,))
        count, mean, squares, largest = 0, 0.0, 0.0, -np.inf
        for values in blocks():
            # Chan, Golub, LeVeque: two sets of values as one, by their means and squared deviations.
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


def percentiles(blocks: Blocks, shares: Sequence[float], *, gathered: int = GATHERED) -> Floats:
    """What `numpy.percentile` gives for all values together, interpolated, shape (shares,).

    Args:
        blocks: the values, at least one; whole numbers beyond 2**53 lose their last digits.
        shares: per cent.
        gathered: values that may be sorted at once, count.
    """
    count = sum(len(values) for values in blocks())
    at = np.asarray(shares) / 100 * (count - 1)
    below = np.floor(at).astype(np.int64)
    ranks = np.unique(np.concatenate((below, np.minimum(below + 1, count - 1))))
    found = _ranked(blocks, ranks, gathered)
    low, high = (found[np.searchsorted(ranks, np.minimum(rank, count - 1))] for rank in (below, below + 1))
    share, apart = at - below, high - low
    # From the nearer end, as numpy does it.
    return np.asarray(np.where(share < 0.5, low + apart * share, high - apart * (1 - share)))


def median(blocks: Blocks) -> float:
    """The median of all values together, of which there is at least one."""
    return float(percentiles(blocks, (50,))[0])


def differences(blocks: Blocks) -> Blocks:
    """From each value to the next one, across the blocks too."""

    def between() -> Iterator[NDArray[Any]]:
        last: NDArray[Any] | None = None
        for values in blocks():
            followed = values if last is None else np.concatenate((last, values))
            last = followed[-1:]
            if len(followed) > 1:
                yield np.diff(followed)

    return between


def tail(blocks: Blocks) -> tuple[Floats, Floats]:
    """Values from the smallest to the largest, evenly, and the share of all that is not below each; for a plot.

    Shapes (`TAIL_POINTS` + 1,); of values that are all the same, (1,).
    """
    count, low, high = _extent(blocks)
    if low == high:
        return np.array([low]), np.ones(1)
    counts = np.zeros(TAIL_POINTS, np.int64)
    for values in blocks():
        counts += np.histogram(values, TAIL_POINTS, (low, high))[0]
    from_here = np.append(np.cumsum(counts[::-1])[::-1], 1)
    return np.linspace(low, high, TAIL_POINTS + 1), from_here / count


def _ranked(blocks: Blocks, ranks: NDArray[np.int64], gathered: int) -> Floats:
    """The values at some places of their order, from 0; shape (ranks,)."""
    count, low, high = _extent(blocks)
    if low == high:
        return np.full(len(ranks), low)
    if count <= gathered:
        return np.sort(_all(blocks))[ranks]

    def bins(values: NDArray[Any]) -> NDArray[np.intp]:
        return np.minimum((values - low) * (BINS / (high - low)), BINS - 1).astype(np.intp)

    counts = np.zeros(BINS, np.int64)
    for values in blocks():
        counts += np.bincount(bins(values), minlength=BINS)
    ends = np.cumsum(counts)
    bin_of_rank = np.searchsorted(ends, ranks, side="right")
    wanted = np.zeros(BINS, np.bool_)
    wanted[bin_of_rank] = True
    if counts[wanted].sum() <= gathered:
        left_out = np.cumsum(np.where(wanted, 0, counts))
        inside = np.sort(_all(lambda: (values[wanted[bins(values)]] for values in blocks())))
        return np.asarray(inside[ranks - left_out[bin_of_rank]])
    # Crowded bins are divided in their turn.
    found = np.empty(len(ranks))
    for number in np.flatnonzero(wanted):
        mine = bin_of_rank == number
        within = _within(blocks, bins, int(number))
        found[mine] = _ranked(within, ranks[mine] - (ends[number] - counts[number]), gathered)
    return found


def _within(blocks: Blocks, bins: Any, number: int) -> Blocks:
    return lambda: (values[bins(values) == number] for values in blocks())


def _all(blocks: Blocks) -> Floats:
    return np.concatenate([np.asarray(values, np.float64) for values in blocks()])


def _extent(blocks: Blocks) -> tuple[int, float, float]:
    """How many values there are, the smallest and the largest."""
    count, low, high = 0, np.inf, -np.inf
    for values in blocks():
        if len(values):
            count += len(values)
            low, high = min(low, float(values.min())), max(high, float(values.max()))
    return count, low, high
