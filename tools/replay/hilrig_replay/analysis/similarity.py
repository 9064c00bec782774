"""Which runs of a class were driven by the same torques: one that was replayed, or a copy of a file.

Torques answer positions that were read a fraction of a millisecond earlier or later, so two honest runs, even of one
program, have few torques in common to the last count (1 to 11 % were measured); one that writes what was recorded of
another has all. A run's different torques are kept as the smallest of their hashes (a bottom-k sketch: Broder, *On the
resemblance and containment of documents*, 1997): as much for ten hours as for a minute.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

KEPT: Final = 2048
"""Hashes that are kept of a run."""
LEAST: Final = 100
"""With fewer different torques than this nothing is said: a motor that is switched has two."""
ALIKE: Final = 0.5
"""Runs that share as much are named."""
_COUNTS: Final = 1000.0
"""From N·m and N to the counts of the registers."""

Hashes = NDArray[np.uint64]


@dataclass(slots=True)
class Torques:
    """The different torques that a run's controllers wrote, as a sketch of bounded size."""

    hashes: Hashes = field(default_factory=lambda: np.empty(0, np.uint64))
    """The smallest, ascending."""

    def add(self, effort: NDArray[np.float64]) -> None:
        """Take commands in; shape (n, 4): N·m, N·m, N, N·m."""
        counts = np.rint(effort * _COUNTS).astype("<i2")
        words = np.ascontiguousarray(counts[counts.any(axis=1)]).view("<u8").ravel()
        self.hashes = np.union1d(self.hashes, _mixed(words))[:KEPT]

    def shared(self, other: "Torques") -> float:
        """Which share of the different torques of one run, the shorter, the other has too: 0 to 1.

        0 also where there are too few to tell.
        """
        # What both know completely: below the largest hash that each had to keep.
        end = min((each.hashes[-1] for each in (self, other) if len(each.hashes) == KEPT), default=_LARGEST)
        mine, theirs = (each.hashes[each.hashes <= end] for each in (self, other))
        fewer = min(len(mine), len(theirs))
        if fewer < LEAST:
            return 0.0
        return len(np.intersect1d(mine, theirs, assume_unique=True)) / fewer


_LARGEST: Final = np.uint64(2**64 - 1)


def alike(runs: Sequence[Torques]) -> list[tuple[int, int, float]]:
    """Pairs of runs, by their places, with the share of the torques that they have in common; the likest first."""
    pairs = [(one, other, runs[one].shared(runs[other])) for one, other in combinations(range(len(runs)), 2)]
    return sorted((pair for pair in pairs if pair[2] >= ALIKE), key=lambda pair: -pair[2])


def _mixed(words: Hashes) -> Hashes:
    """Each word's bits well mixed, one to one (the finaliser of SplitMix64), so that the smallest are a fair sample."""
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))
