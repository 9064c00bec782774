"""What a loop costs on average when its latency varies: exact second moments instead of many simulated runs.

The age of what acts at each tick follows a Markov chain, and for each age the loop is a linear system of its own: a
jump linear system, whose second moments obey a linear recursion (O. L. V. Costa, M. D. Fragoso, R. P. Marques,
"Discrete-Time Markov Jump Linear Systems", 2005, ch. 3; Jitterbug, Lincoln and Cervin 2002, does so for its timing
models). Its spectral radius tells mean-square stability, its sum the expected cost, as `virtual_loop` defines cost. The
latency is taken on the command's way, with one poll a step: each state is served, and its command acts when it has
aged.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, eigs

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.controllers import LawController, Measured
from hilrig_study.simulation.simulated_loop import EFFORT_COST, ERROR_SCALE
from hilrig_study.simulation.timing import NO_POLL, Timeline
from hilrig_study.theory.linear import LinearPlant
from hilrig_study.theory.margins import LinearLaw

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SUBSPACE: Final = 64
"""Of Arnoldi's method: with less it takes long where the slowest modes are close to each other."""
PRECISE: Final = 1e-9


@dataclass(frozen=True, slots=True)
class AgeChain:
    """Ages of what acts, steps, as a Markov chain; its first states are the ticks before anything acts (age 0)."""

    ages: Ints
    """Age that each state stands for, (S,)."""
    transition: Floats
    """p[i, j]: probability that state j follows state i at the next tick, (S, S)."""
    start: Floats
    """Of each state at the first tick, (S,)."""

    @property
    def most(self) -> int:
        """Largest age."""
        return int(self.ages.max())


def ages_of(line: Timeline) -> Ints:
    """Age of what acts at every tick, steps, (T,); 0: nothing does."""
    acts = line.in_force != NO_POLL
    ages = np.arange(len(line.in_force)) - line.basis[np.maximum(line.in_force, 0)]
    return np.where(acts, ages, 0)


def age_chain(sequences: Sequence[Ints]) -> AgeChain:
    """The chain that sequences of ages, one a run, (T,) each, tell of.

    Raises:
        InputError: there is no command in any of them.
    """
    # Before anything acts the ticks are counted down, so that the wait is as long as it was.
    labels = [np.where(ages > 0, ages, -1 - np.arange(len(ages))) for ages in sequences]
    known = np.unique(np.concatenate(labels)) if labels else np.empty(0, dtype=np.int64)
    if not (known > 0).any():
        raise InputError("nothing acts in any of the runs, so there is no latency to take")
    counts, start = np.zeros((len(known), len(known))), np.zeros(len(known))
    for label in labels:
        rows = np.searchsorted(known, label)
        np.add.at(counts, (rows[:-1], rows[1:]), 1.0)
        start[rows[0]] += 1.0
    total = counts.sum(axis=1, keepdims=True)
    # A state that is only the last of a run stays: no probability may get lost.
    transition = np.where(total > 0, counts / np.maximum(total, 1.0), np.eye(len(known)))
    return AgeChain(np.maximum(known, 0), transition, start / start.sum())


def turns(phi: Floats, gamma: Floats, law: LinearLaw, most: int) -> list[Floats]:
    """The loop's matrices over a step in which what acts is of age 0 (nothing) to `most`, (n, n) each.

    The state is (x, ξ, the last `most` commands), newest first.
    """
    memory = len(law.a)
    held = 8 + memory
    size = held + 4 * most
    common = np.zeros((size, size))
    common[:8, :8] = phi
    common[8:held, :4], common[8:held, 8:held] = law.b, law.a
    common[held : held + 4, :4], common[held : held + 4, 8:held] = law.d, law.c
    common[held + 4 :, held:-4] = np.eye(4 * (most - 1))
    matrices = [common]
    for age in range(1, most + 1):
        matrix = common.copy()
        place = held + 4 * (age - 1)
        matrix[:8, place : place + 4] = gamma
        matrices.append(matrix)
    return matrices


def mean_square_radius(chain: AgeChain, matrices: Sequence[Floats]) -> float:
    """Growth of the second moment a step, in the long run; below 1 the loop is mean-square stable.

    Joints that nothing couples are looked at apart, which takes far less time: what two of them have in common grows no
    faster than either.
    """
    lasting = np.flatnonzero(chain.ages > 0)
    p = chain.transition[np.ix_(lasting, lasting)].T
    some = np.stack([matrices[age] for age in chain.ages[lasting].tolist()])
    count, group = connected_components(np.abs(some).sum(axis=0) > 0, directed=False)
    joints = [np.flatnonzero(group == number) for number in range(count)]
    return max(_growth(p, some[:, own[:, np.newaxis], own]) for own in joints)


def _growth(p: Floats, some: Floats) -> float:
    """The same of matrices (K, n, n), whose probabilities one after another are `p` transposed, (K, K).

    The recursion keeps moments positive, so its largest eigenvalue is real (Krein and Rutman); the identity is added to
    it, for that leaves behind those of the same modulus that a swaying loop has. Arnoldi's method, of scipy.
    """
    turned = some.transpose(0, 2, 1)
    count, size, _ = some.shape
    entries = some.size

    def shifted(moments: Floats) -> Floats:
        moved = p @ (some @ moments.reshape(some.shape) @ turned).reshape(count, -1)
        return np.asarray(moved.ravel() + moments.ravel())

    if entries <= SUBSPACE:
        return float(np.linalg.eigvals(np.apply_along_axis(shifted, 0, np.eye(entries))).real.max()) - 1.0
    recursion = LinearOperator((entries, entries), matvec=shifted, dtype=np.float64)
    first = np.repeat(np.eye(size)[np.newaxis], count, axis=0).ravel()
    (largest,) = eigs(recursion, k=1, v0=first, ncv=SUBSPACE, tol=PRECISE, return_eigenvectors=False)
    return float(largest.real) - 1.0


def expected_cost(
    plant: LinearPlant,
    phi: Floats,
    gamma: Floats,
    controller: LawController,
    law: LinearLaw,
    chain: AgeChain,
    offset: Sequence[float],
    ticks: int,
) -> float:
    """Expected cost of going from `offset` to the pose in `ticks` steps, defined as `virtual_loop.Outcome.cost`.

    Args:
        plant: the arm near the pose.
        phi: of the arm over a step, (8, 8).
        gamma: the same, (8, 4).
        controller: whose first poll tells how its memory starts; one run.
        law: the controller, linear.
        chain: ages of what acts.
        offset: of the start from the pose; rad, rad, m, rad, (4,).
        ticks: T.
    """
    matrices = turns(phi, gamma, law, chain.most)
    size, held = len(matrices[0]), 8 + len(law.a)
    pose, start = np.array(plant.pose)[:, np.newaxis], np.array(offset)[:, np.newaxis]
    still = Measured(np.zeros(1), pose + start, pose, np.zeros(1))
    effort, memory = controller.law(controller.start(1), still)
    # The first tick by hand: the memory starts without a past.
    state = np.zeros(size)
    state[:8] = phi @ np.concatenate([start[:, 0], np.zeros(4)])
    rest = memory
    for _ in range(200):
        _, rest = controller.law(rest, Measured(np.zeros(1), pose, pose, np.zeros(1)))
    state[8:held] = memory[law.rows, 0] - rest[law.rows, 0]
    state[held : held + 4] = effort[:, 0] - np.array(plant.holding)
    weights = np.zeros((len(chain.ages), size))
    weights[:, :4] = ERROR_SCALE[:, 0] ** -2.0
    for weight, age in zip(weights, chain.ages.tolist(), strict=True):
        if age:
            weight[held + 4 * (age - 1) : held + 4 * age] = EFFORT_COST
    total = float((start[:, 0] ** 2) @ weights[0, :4])
    some = np.stack([matrices[age] for age in chain.ages.tolist()])
    turned = some.transpose(0, 2, 1)
    moments = (chain.start @ chain.transition)[:, np.newaxis, np.newaxis] * np.outer(state, state)
    for _ in range(1, ticks):
        total += float(np.einsum("kii,ki->", moments, weights))
        moments = np.tensordot(chain.transition.T, some @ moments @ turned, axes=1)
        if not np.isfinite(total):
            return float("inf")
    return total / ticks
