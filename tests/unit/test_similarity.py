"""The sketch of a run's torques: as good as the torques themselves, and bounded."""

import numpy as np
import pytest

from hilrig_replay.analysis.similarity import KEPT, LEAST, Torques, alike


def drawn(count: int, seed: int) -> np.ndarray:
    """Efforts of a controller, whole counts of the registers; shape (count, 4)."""
    return np.random.default_rng(seed).integers(-32767, 32768, (count, 4)) / 1000


def torques(*pieces: np.ndarray) -> Torques:
    made = Torques()
    for piece in pieces:
        made.add(piece)
    return made


def test_a_run_shares_all_with_itself_in_whatever_pieces_it_is_read() -> None:
    effort = drawn(5000, 1)
    whole, pieces = torques(effort), torques(effort[:7], effort[7:3000], effort[3000:])
    assert (whole.hashes == pieces.hashes).all()
    assert whole.shared(pieces) == 1.0


@pytest.mark.parametrize("count", [400, 40_000])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_what_two_runs_share_is_estimated_however_long_they_are(count: int, share: float) -> None:
    common, rest = drawn(round(share * count), 1), count - round(share * count)
    one, other = torques(common, drawn(rest, 2)), torques(common, drawn(rest, 3))
    # Of 2,048 samples the standard deviation is 1 %.
    assert one.shared(other) == pytest.approx(share, abs=0.05)
    assert one.shared(other) == other.shared(one)
    assert max(len(one.hashes), len(other.hashes)) <= KEPT


def test_a_replay_with_something_of_its_own_around_it_is_found() -> None:
    stolen = drawn(1000, 1)
    assert torques(stolen).shared(torques(drawn(500, 2), stolen)) == 1.0


def test_a_piece_of_a_long_run_is_found_in_it() -> None:
    long = drawn(20_000, 1)
    # Of the long run only the smallest hashes are kept: the piece's larger ones say nothing.
    assert torques(long).shared(torques(long[5000:8000])) == 1.0


def test_torques_that_differ_by_a_count_are_different() -> None:
    effort = drawn(1000, 1)
    assert torques(effort).shared(torques(effort + 0.001)) == 0.0
    # What a register can't tell apart is the same.
    assert torques(effort).shared(torques(effort + 0.0001)) == 1.0


def test_few_torques_say_nothing_and_neither_does_none() -> None:
    few = drawn(LEAST - 1, 1)
    assert torques(few).shared(torques(few)) == 0.0
    silent = torques(np.zeros((1000, 4)))
    assert len(silent.hashes) == 0
    assert silent.shared(silent) == 0.0
    assert torques().shared(torques(drawn(1000, 1))) == 0.0


def test_pairs_come_with_the_likest_first() -> None:
    base = drawn(1000, 1)
    runs = [torques(base), torques(drawn(1000, 2)), torques(base[:700], drawn(300, 3)), torques(base)]
    assert [(one, other) for one, other, _ in alike(runs)] == [(0, 3), (0, 2), (2, 3)]
