"""Drawn delays and losses: what was asked for, the same from the same seed, other streams for other ways."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from hilrig_modbus_edge.impairment.model import Impairment, way_seed
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


def drawn_ms(text: str, count: int = COUNT, seed: int = 1) -> np.ndarray:
    delay_ns, lost = Impairment(LinkImpairment.model_validate(text), seed).draw(count)
    assert delay_ns.dtype == np.int64
    assert not lost.any()
    return np.asarray(delay_ns / 1e6)


@pytest.mark.parametrize("text", DISTRIBUTIONS)
def test_delays_are_distributed_as_asked(text: str) -> None:
    found = stats.kstest(drawn_ms(text), DISTRIBUTIONS[text].cdf)
    assert found.pvalue > 0.01, found


def test_a_constant_delay_is_one() -> None:
    assert set(drawn_ms("constant:12.5", 5000)) == {12.5}


def test_a_delay_is_never_negative() -> None:
    assert drawn_ms("normal:0,50").min() >= 0


def test_a_trace_goes_round_in_its_order() -> None:
    trace = [1.0, 2.0, 3.0, 50.0, 7.0]
    way = LinkImpairment.model_validate({"delay": {"kind": "trace", "delays_ms": trace}})
    starts = set()
    for seed in range(40):
        delays = (Impairment(way, seed).draw(3000)[0] / 1e6).tolist()
        first = trace.index(delays[0])
        assert delays == list(itertools.islice(itertools.cycle(trace), first, first + 3000))
        starts.add(first)
    assert starts == set(range(5)), "rigs begin at different places of it"


def test_independent_losses_have_their_rate() -> None:
    way = LinkImpairment.model_validate({"loss": "bernoulli:0.03"})
    lost = Impairment(way, 5).draw(100_000)[1]
    assert stats.binomtest(int(lost.sum()), len(lost), 0.03).pvalue > 0.01
    assert Impairment(LinkImpairment.model_validate({"loss": "bernoulli:1"}), 5).draw(3000)[1].all()


def test_losses_of_a_bad_channel_come_in_bursts_of_the_length_that_was_asked() -> None:
    """In the long run a share to_bad / (to_bad + to_good) is lost, in bursts that are geometric with 1/to_good."""
    lost = Impairment(LinkImpairment.model_validate({"loss": "gilbert:0.01,0.2"}), 5).draw(400_000)[1]
    assert lost.mean() == pytest.approx(0.01 / 0.21, rel=0.05)
    edges = np.flatnonzero(np.diff(lost.astype(int)))
    lengths = np.diff(edges)[(0 if lost[edges[0] + 1] else 1) :: 2]
    longest = 25
    expected = stats.geom(0.2).pmf(np.arange(1, longest))
    counted = [int((lengths == length).sum()) for length in range(1, longest)]
    last = len(lengths) - sum(counted)
    chi = stats.chisquare([*counted, last], np.append(expected, 1 - expected.sum()) * len(lengths))
    assert chi.pvalue > 0.01, chi


def test_a_channel_begins_as_it_is_in_the_long_run() -> None:
    way = LinkImpairment.model_validate({"loss": "gilbert:0.05,0.2"})
    first = [Impairment(way, seed).draw(1)[1][0] for seed in range(400)]
    assert stats.binomtest(sum(map(int, first)), len(first), 0.05 / 0.25).pvalue > 0.01


def test_a_channel_may_lose_some_when_it_is_good_and_keep_some_when_it_is_bad() -> None:
    lost = Impairment(LinkImpairment.model_validate({"loss": "gilbert:0.1,0.3,0.6,0.05"}), 5).draw(200_000)[1]
    assert lost.mean() == pytest.approx(0.25 * 0.6 + 0.75 * 0.05, rel=0.03)


@given(
    text=st.sampled_from([*DISTRIBUTIONS, "constant:3"]),
    loss=st.sampled_from(["none", "bernoulli:0.1", "gilbert:0.05,0.3"]),
    pieces=st.lists(st.integers(0, 1500), max_size=8),
    seed=st.integers(0, 2**63 - 1),
)
def test_what_is_drawn_does_not_depend_on_how_it_is_asked_for(
    text: str, loss: str, pieces: list[int], seed: int
) -> None:
    way = LinkImpairment.model_validate({"delay": text, "loss": loss})
    delays, losses = Impairment(way, seed).draw(sum(pieces))
    again = Impairment(way, seed)
    parts = [again.draw(count) for count in pieces]
    assert np.concatenate([np.empty(0, np.int64), *(delay for delay, _ in parts)]).tolist() == delays.tolist()
    assert np.concatenate([np.empty(0, bool), *(lost for _, lost in parts)]).tolist() == losses.tolist()
    one_by_one = list(itertools.islice(Impairment(way, seed).each(), len(losses)))
    assert one_by_one == list(zip(delays.tolist(), losses.tolist(), strict=True))


def test_the_loss_does_not_change_the_delays() -> None:
    without = Impairment(LinkImpairment.model_validate("gamma:20,8"), 3).draw(2000)[0]
    lossy = LinkImpairment.model_validate({"delay": "gamma:20,8", "loss": "bernoulli:0.5"})
    assert Impairment(lossy, 3).draw(2000)[0].tolist() == without.tolist()


def test_rigs_and_ways_have_streams_of_their_own() -> None:
    way = LinkImpairment.model_validate("uniform:0,10")
    streams = [
        Impairment(way, way_seed(seed, rig, name)).draw(4000)[0]
        for seed in (1, 2)
        for rig in ("rig1", "rig2")
        for name in ("state", "command")
    ]
    for one, other in itertools.combinations(streams, 2):
        assert abs(np.corrcoef(one, other)[0, 1]) < 0.06
    again = Impairment(way, way_seed(1, "rig1", "state")).draw(4000)[0]
    assert again.tolist() == streams[0].tolist()
