"""Torque sketch of a run: estimates the overlap of torques with bounded memory."""

import numpy as np
import pytest

from hilrig_replay.analysis.similarity import MIN_DISTINCT_TORQUES, SKETCH_SIZE, TorqueSketch, find_similar


def drawn(count: int, seed: int) -> np.ndarray:
    """Efforts of a controller in whole register counts; shape (count, 4)."""
    return np.random.default_rng(seed).integers(-32767, 32768, (count, 4)) / 1000


def torques(*pieces: np.ndarray) -> TorqueSketch:
    made = TorqueSketch()
    for piece in pieces:
        made.add(piece)
    return made


def test_sketch_does_not_depend_on_the_block_size() -> None:
    effort = drawn(5000, 1)
    whole, pieces = torques(effort), torques(effort[:7], effort[7:3000], effort[3000:])
    assert (whole.hashes == pieces.hashes).all()
    assert whole.overlap(pieces) == 1.0


@pytest.mark.parametrize("count", [400, 40_000])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_overlap_estimates_the_share_for_any_length(count: int, share: float) -> None:
    common, rest = drawn(round(share * count), 1), count - round(share * count)
    one, other = torques(common, drawn(rest, 2)), torques(common, drawn(rest, 3))
    # Of 2,048 samples the standard deviation is 1 %.
    assert one.overlap(other) == pytest.approx(share, abs=0.05)
    assert one.overlap(other) == other.overlap(one)
    assert max(len(one.hashes), len(other.hashes)) <= SKETCH_SIZE


def test_finds_a_replay_with_additional_torques() -> None:
    copied = drawn(1000, 1)
    assert torques(copied).overlap(torques(drawn(500, 2), copied)) == 1.0


def test_finds_a_section_of_a_long_run() -> None:
    long = drawn(20_000, 1)
    # The sketch of the long run has only its smallest hashes: larger hashes of the section are not compared.
    assert torques(long).overlap(torques(long[5000:8000])) == 1.0


def test_torques_differ_from_one_register_count_on() -> None:
    effort = drawn(1000, 1)
    assert torques(effort).overlap(torques(effort + 0.001)) == 0.0
    # Differences below the register resolution are ignored.
    assert torques(effort).overlap(torques(effort + 0.0001)) == 1.0


def test_overlap_is_zero_for_few_torques() -> None:
    few = drawn(MIN_DISTINCT_TORQUES - 1, 1)
    assert torques(few).overlap(torques(few)) == 0.0
    silent = torques(np.zeros((1000, 4)))
    assert len(silent.hashes) == 0
    assert silent.overlap(silent) == 0.0
    assert torques().overlap(torques(drawn(1000, 1))) == 0.0


def test_sorts_pairs_by_decreasing_overlap() -> None:
    base = drawn(1000, 1)
    runs = [torques(base), torques(drawn(1000, 2)), torques(base[:700], drawn(300, 3)), torques(base)]
    assert [(one, other) for one, other, _ in find_similar(runs)] == [(0, 3), (0, 2), (2, 3)]
