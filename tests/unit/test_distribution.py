"""Statistics over blocks: percentiles, means and deviations equal those of all values together."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from hilrig_replay.analysis.distribution import Statistics, complementary_cdf, differences, median, percentiles
from hilrig_replay.io.disk_table import Blocks

SHARES = (0, 1, 5, 25, 50, 75, 95, 99, 99.9, 100)


def in_blocks(values: NDArray[np.int64], size: int) -> Blocks:
    def blocks() -> Iterator[NDArray[np.int64]]:
        return (values[at : at + size] for at in range(0, len(values), size))

    return blocks


def samples(kind: str, count: int) -> NDArray[np.int64]:
    random = np.random.default_rng(seed=count)
    values = {
        "spread": random.integers(0, 20_000_000, count),
        # Like loop latencies: nearly all within microseconds of a step, and one stall.
        "crowded": np.append(20_000_000 + random.normal(0, 3000, count - 1), 4e9),
        "few": random.choice([0, 20_000_000, 40_000_000], count, p=[0.01, 0.98, 0.01]),
        "same": np.full(count, 12_500_000),
        "negative": random.integers(-500, 500, count),
    }[kind]
    return np.asarray(values, np.int64)


@pytest.mark.parametrize("count", [2, 3, 999, 20_000])
@pytest.mark.parametrize("kind", ["spread", "crowded", "few", "same", "negative"])
def test_percentiles_equal_numpy_for_any_sorting_limit(kind: str, count: int) -> None:
    values = samples(kind, count)
    expected = np.percentile(values, SHARES)
    for max_sorted in (1, 40, 3000, 1 << 18):
        found = percentiles(in_blocks(values, 700), SHARES, max_sorted=max_sorted)
        np.testing.assert_array_equal(found, expected, err_msg=f"{max_sorted} sorted at once")


def test_percentiles_of_one_value() -> None:
    assert percentiles(in_blocks(np.array([7]), 10), SHARES).tolist() == [7.0] * len(SHARES)


@pytest.mark.parametrize("kind", ["spread", "crowded", "few", "same"])
def test_statistics_of_blocks_equal_those_of_all_values(kind: str) -> None:
    values = samples(kind, 5000)
    whole, found = Statistics.of(values), Statistics.of(in_blocks(values, 333))
    assert (found.p50, found.p95, found.p99, found.p999, found.max) == (
        whole.p50,
        whole.p95,
        whole.p99,
        whole.p999,
        values.max() / 1e6,
    )
    assert found.mean == pytest.approx(values.mean() / 1e6, rel=1e-12)
    assert found.std == pytest.approx(values.std() / 1e6, rel=1e-9, abs=1e-12)


def test_differences_cross_block_boundaries() -> None:
    values = samples("spread", 100)
    pieces = [values[:1], values[1:1], values[1:60], values[60:60], values[60:]]
    found = np.concatenate(list(differences(lambda: iter(pieces))()))
    np.testing.assert_array_equal(found, np.diff(values))
    assert median(differences(lambda: iter(pieces))) == np.median(np.diff(values))
    assert list(differences(lambda: iter([values[:1]]))()) == []


@pytest.mark.parametrize("kind", ["spread", "crowded", "few"])
def test_ccdf_is_the_share_of_values_not_below(kind: str) -> None:
    values = samples(kind, 5000)
    at, share = complementary_cdf(in_blocks(values, 700))
    assert (at[0], at[-1]) == (values.min(), values.max())
    assert (share[0], share[-1]) == (1.0, 1 / len(values))
    assert (np.diff(share) <= 0).all()
    for number in range(0, len(at), 97):
        assert share[number] == pytest.approx((values >= at[number]).mean(), abs=1 / len(values)), at[number]


def test_ccdf_of_equal_values_is_a_point() -> None:
    at, share = complementary_cdf(in_blocks(samples("same", 10), 3))
    assert (at.tolist(), share.tolist()) == ([12_500_000.0], [1.0])
