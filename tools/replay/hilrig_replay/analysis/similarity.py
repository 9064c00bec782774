"""Similarity of runs: finds runs of a group with the same torques, e.g. a replayed recording or a copy of a file.

Torques depend on positions that are read a fraction of a millisecond earlier or later. Two independent runs, even of
one program, therefore have few identical torques (measured: 1 to 11 %), while a program that writes the torques of
another recording has all of them. The distinct torques of a run are kept as the smallest of their hashes (bottom-k
sketch: Broder, *On the resemblance and containment of documents*, 1997), so the size does not depend on the length.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

SKETCH_SIZE: Final = 2048
"""Number of hashes in the sketch of a run."""
MIN_DISTINCT_TORQUES: Final = 100
"""Runs with fewer distinct torques are not compared: on-off control has only two."""
SIMILARITY_THRESHOLD: Final = 0.5
"""Minimum share of common torques of a pair of similar runs."""
_COUNTS_PER_UNIT: Final = 1000.0
"""Register counts per N·m or N."""

Hashes = NDArray[np.uint64]


@dataclass(slots=True)
class TorqueSketch:
    """Sketch of bounded size of the distinct torques that were written by the controllers of a run."""

    hashes: Hashes = field(default_factory=lambda: np.empty(0, np.uint64))
    """The smallest hashes, ascending."""

    def add(self, effort: NDArray[np.float64]) -> None:
        """Add the efforts of commands, shape (n, 4): N·m, N·m, N, N·m."""
        counts = np.rint(effort * _COUNTS_PER_UNIT).astype("<i2")
        words = np.ascontiguousarray(counts[counts.any(axis=1)]).view("<u8").ravel()
        self.hashes = np.union1d(self.hashes, _hashed(words))[:SKETCH_SIZE]

    def overlap(self, other: "TorqueSketch") -> float:
        """Overlap coefficient: share of the distinct torques of the smaller set that are also in the other, 0 to 1.

        0 if there are fewer than `MIN_DISTINCT_TORQUES`.
        """
        # Both sketches are complete up to the smaller of their largest hashes.
        end = min((each.hashes[-1] for each in (self, other) if len(each.hashes) == SKETCH_SIZE), default=_MAX_HASH)
        mine, theirs = (each.hashes[each.hashes <= end] for each in (self, other))
        fewer = min(len(mine), len(theirs))
        if fewer < MIN_DISTINCT_TORQUES:
            return 0.0
        return len(np.intersect1d(mine, theirs, assume_unique=True)) / fewer


_MAX_HASH: Final = np.uint64(2**64 - 1)


def find_similar(runs: Sequence[TorqueSketch]) -> list[tuple[int, int, float]]:
    """Pairs of similar runs, as indexes into `runs`, with the share of common torques; the most similar first."""
    pairs = [(one, other, runs[one].overlap(runs[other])) for one, other in combinations(range(len(runs)), 2)]
    return sorted((pair for pair in pairs if pair[2] >= SIMILARITY_THRESHOLD), key=lambda pair: -pair[2])


def _hashed(words: Hashes) -> Hashes:
    """Bijective hash of 64-bit values (finalizer of SplitMix64), so that the smallest hashes are a random sample."""
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))
