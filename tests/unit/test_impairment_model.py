"""Unit tests of the impairment model: distributions, reproducibility, independent streams."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from hilrig_modbus_edge.impairment.model import Impairment, link_seed
from hilrig_runtime.config.impairment import LinkImpairment

COUNT = 20_000
DISTRIBUTIONS = {
    "uniform:5,20": stats.uniform(5, 15),
    "normal:30,8": stats.truncnorm(-30 / 8, np.inf, 30, 8),
    "normal:4,6": stats.truncnorm(-4 / 6, np.inf, 4, 6),
    "gamma:20,8": stats.gamma((20 / 8) ** 2, scale=8**2 / 20),
    "gamma:8,8,2": stats.gamma(1, loc=2, scale=8),
    "exponential:12": stats.expon(scale=12),
    "exponential:5,25": stats.expon(25, 5),
}


def sampled_ms(text: str, count: int = COUNT, seed: int = 1) -> np.ndarray:
    delay_ns, lost = Impairment(LinkImpairment.model_validate(text), seed).draw(count)
    assert delay_ns.dtype == np.int64
    assert not lost.any()
    return np.asarray(delay_ns / 1e6)


@pytest.mark.parametrize("text", DISTRIBUTIONS)
def test_delays_have_configured_distribution(text: str) -> None:
    found = stats.kstest(sampled_ms(text), DISTRIBUTIONS[text].cdf)
    assert found.pvalue > 0.01, found


def test_constant_delay_is_constant() -> None:
    assert set(sampled_ms("constant:12.5", 5000)) == {12.5}


def test_delay_is_never_negative() -> None:
    assert sampled_ms("normal:0,50").min() >= 0


def test_trace_is_repeated_in_its_order() -> None:
    trace = [1.0, 2.0, 3.0, 50.0, 7.0]
    link = LinkImpairment.model_validate({"delay": {"kind": "trace", "delays_ms": trace}})
    starts = set()
    for seed in range(40):
        delays = (Impairment(link, seed).draw(3000)[0] / 1e6).tolist()
        first = trace.index(delays[0])
        assert delays == list(itertools.islice(itertools.cycle(trace), first, first + 3000))
        starts.add(first)
    assert starts == set(range(5)), "the start index must depend on the seed"


def test_independent_losses_have_their_rate() -> None:
    link = LinkImpairment.model_validate({"loss": "bernoulli:0.03"})
    lost = Impairment(link, 5).draw(100_000)[1]
    assert stats.binomtest(int(lost.sum()), len(lost), 0.03).pvalue > 0.01
    assert Impairment(LinkImpairment.model_validate({"loss": "bernoulli:1"}), 5).draw(3000)[1].all()


def test_gilbert_losses_have_configured_burst_length() -> None:
    """A fraction to_bad / (to_bad + to_good) is lost, in bursts of geometric length with mean 1 / to_good."""
    lost = Impairment(LinkImpairment.model_validate({"loss": "gilbert:0.01,0.2"}), 5).draw(400_000)[1]
    assert lost.mean() == pytest.approx(0.01 / 0.21, rel=0.05)
    edges = np.flatnonzero(np.diff(lost.astype(int)))
    lengths = np.diff(edges)[(0 if lost[edges[0] + 1] else 1) :: 2]
    max_length = 25
    expected = stats.geom(0.2).pmf(np.arange(1, max_length))
    counted = [int((lengths == length).sum()) for length in range(1, max_length)]
    last = len(lengths) - sum(counted)
    chi = stats.chisquare([*counted, last], np.append(expected, 1 - expected.sum()) * len(lengths))
    assert chi.pvalue > 0.01, chi


def test_gilbert_model_starts_in_stationary_distribution() -> None:
    link = LinkImpairment.model_validate({"loss": "gilbert:0.05,0.2"})
    first = [Impairment(link, seed).draw(1)[1][0] for seed in range(400)]
    assert stats.binomtest(sum(map(int, first)), len(first), 0.05 / 0.25).pvalue > 0.01


def test_gilbert_elliott_has_loss_rate_per_state() -> None:
    lost = Impairment(LinkImpairment.model_validate({"loss": "gilbert:0.1,0.3,0.6,0.05"}), 5).draw(200_000)[1]
    assert lost.mean() == pytest.approx(0.25 * 0.6 + 0.75 * 0.05, rel=0.03)


@given(
    text=st.sampled_from([*DISTRIBUTIONS, "constant:3"]),
    loss=st.sampled_from(["none", "bernoulli:0.1", "gilbert:0.05,0.3"]),
    pieces=st.lists(st.integers(0, 1500), max_size=8),
    seed=st.integers(0, 2**63 - 1),
)
def test_samples_do_not_depend_on_block_sizes(text: str, loss: str, pieces: list[int], seed: int) -> None:
    link = LinkImpairment.model_validate({"delay": text, "loss": loss})
    delays, losses = Impairment(link, seed).draw(sum(pieces))
    again = Impairment(link, seed)
    parts = [again.draw(count) for count in pieces]
    assert np.concatenate([np.empty(0, np.int64), *(delay for delay, _ in parts)]).tolist() == delays.tolist()
    assert np.concatenate([np.empty(0, bool), *(lost for _, lost in parts)]).tolist() == losses.tolist()
    one_by_one = list(itertools.islice(Impairment(link, seed).samples(), len(losses)))
    assert one_by_one == list(zip(delays.tolist(), losses.tolist(), strict=True))


def test_loss_model_does_not_change_the_delays() -> None:
    without = Impairment(LinkImpairment.model_validate("gamma:20,8"), 3).draw(2000)[0]
    lossy = LinkImpairment.model_validate({"delay": "gamma:20,8", "loss": "bernoulli:0.5"})
    assert Impairment(lossy, 3).draw(2000)[0].tolist() == without.tolist()


def test_each_rig_and_link_has_an_independent_stream() -> None:
    link = LinkImpairment.model_validate("uniform:0,10")
    streams = [
        Impairment(link, link_seed(seed, rig, name)).draw(4000)[0]
        for seed in (1, 2)
        for rig in ("rig1", "rig2")
        for name in ("state", "command")
    ]
    for one, other in itertools.combinations(streams, 2):
        assert abs(np.corrcoef(one, other)[0, 1]) < 0.06
    again = Impairment(link, link_seed(1, "rig1", "state")).draw(4000)[0]
    assert again.tolist() == streams[0].tolist()
