"""Expected cost and mean-square stability of a loop with random latency, from exact second moments.

The age of the acting command at each tick is a Markov chain, and each age gives a different linear system: the loop is
a Markov jump linear system, whose second moments follow a linear recursion (O. L. V. Costa, M. D. Fragoso,
R. P. Marques, "Discrete-Time Markov Jump Linear Systems", 2005, ch. 3; used for other timing models by Jitterbug,
Lincoln and Cervin 2002). The spectral radius of the recursion determines mean-square stability, and its sum the
expected cost, with the cost defined in `simulation.simulated_loop`. The whole latency is modeled on the command link,
with one poll per step: each state is served at its tick, and its command acts after its age.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, eigs

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.control_laws import LawController, Measurement
from hilrig_study.linear_model import LinearPlant
from hilrig_study.simulation.simulated_loop import EFFORT_COST, ERROR_SCALE
from hilrig_study.theory.margins import LinearLaw

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ARNOLDI_SUBSPACE_SIZE: Final = 64
"""Size of the Arnoldi subspace; a smaller one converges slowly if the dominant eigenvalues are close to each other."""
EIGENVALUE_TOLERANCE: Final = 1e-9
"""Relative tolerance of the Arnoldi method."""


@dataclass(frozen=True, slots=True)
class AgeChain:
    """Markov chain of the age of the acting command, steps; ticks before the first command are states of age 0."""

    ages: Ints
    """Age of each state, (S,)."""
    transition: Floats
    """Transition probabilities p[i, j] from state i to state j, (S, S)."""
    start: Floats
    """Initial probability of each state, (S,)."""

    @property
    def max_age(self) -> int:
        """Largest age."""
        return int(self.ages.max())


def age_chain(sequences: Sequence[Ints]) -> AgeChain:
    """Estimate the Markov chain from sequences of ages, one per run, (T,) each.

    Raises:
        InputError: no command acts in any of the runs.
    """
    # Ticks before the first command get distinct states, so that the length of this phase is reproduced.
    labels = [np.where(ages > 0, ages, -1 - np.arange(len(ages))) for ages in sequences]
    states = np.unique(np.concatenate(labels)) if labels else np.empty(0, dtype=np.int64)
    if not (states > 0).any():
        raise InputError("no loop latency: no command acts in any of the runs")
    counts, start = np.zeros((len(states), len(states))), np.zeros(len(states))
    for label in labels:
        rows = np.searchsorted(states, label)
        np.add.at(counts, (rows[:-1], rows[1:]), 1.0)
        start[rows[0]] += 1.0
    total = counts.sum(axis=1, keepdims=True)
    # A state that occurs only at the end of a run is followed by any age, as often as it occurs: it is not absorbing.
    occurs = np.where(states > 0, np.bincount(np.searchsorted(states, np.concatenate(labels))), 0)
    transition = np.where(total > 0, counts / np.maximum(total, 1.0), occurs / occurs.sum())
    return AgeChain(np.maximum(states, 0), transition, start / start.sum())


def transition_matrices(phi: Floats, gamma: Floats, law: LinearLaw, max_age: int) -> list[Floats]:
    """Return the transition matrices of the loop over a step, (n, n), for ages 0 (no command) to `max_age`.

    The state is (x, ξ, the last `max_age` commands, newest first).
    """
    memory = len(law.a)
    commands_at = 8 + memory
    size = commands_at + 4 * max_age
    common = np.zeros((size, size))
    common[:8, :8] = phi
    common[8:commands_at, :4], common[8:commands_at, 8:commands_at] = law.b, law.a
    common[commands_at : commands_at + 4, :4], common[commands_at : commands_at + 4, 8:commands_at] = law.d, law.c
    common[commands_at + 4 :, commands_at:-4] = np.eye(4 * (max_age - 1))
    matrices = [common]
    for age in range(1, max_age + 1):
        matrix = common.copy()
        place = commands_at + 4 * (age - 1)
        matrix[:8, place : place + 4] = gamma
        matrices.append(matrix)
    return matrices


def mean_square_radius(chain: AgeChain, matrices: Sequence[Floats]) -> float:
    """Return the asymptotic growth of the second moment per step; below 1 the loop is mean-square stable.

    Uncoupled groups of joints are evaluated separately, which is much faster: the cross moments of two groups grow no
    faster than the moments of the groups.
    """
    acting = np.flatnonzero(chain.ages > 0)
    p = chain.transition[np.ix_(acting, acting)].T
    stacked = np.stack([matrices[age] for age in chain.ages[acting].tolist()])
    count, group = connected_components(np.abs(stacked).sum(axis=0) > 0, directed=False)
    joints = [np.flatnonzero(group == number) for number in range(count)]
    return max(_growth(p, stacked[:, own[:, np.newaxis], own]) for own in joints)


def _growth(p: Floats, stacked: Floats) -> float:
    """Return the growth for matrices (K, n, n); `p` is the transposed transition matrix, (K, K).

    The recursion preserves positive semidefinite moments, so its dominant eigenvalue is real and positive (Krein-Rutman
    theorem). The identity is added to separate it from complex eigenvalues of the same modulus, which an oscillating
    loop has. The eigenvalue is computed by the Arnoldi method of scipy.
    """
    transposed = stacked.transpose(0, 2, 1)
    count, size, _ = stacked.shape
    entries = stacked.size

    def shifted(moments: Floats) -> Floats:
        updated = p @ (stacked @ moments.reshape(stacked.shape) @ transposed).reshape(count, -1)
        return np.asarray(updated.ravel() + moments.ravel())

    if entries <= ARNOLDI_SUBSPACE_SIZE:
        return float(np.linalg.eigvals(np.apply_along_axis(shifted, 0, np.eye(entries))).real.max()) - 1.0
    recursion = LinearOperator((entries, entries), matvec=shifted, dtype=np.float64)
    first = np.repeat(np.eye(size)[np.newaxis], count, axis=0).ravel()
    (largest,) = eigs(
        recursion, k=1, v0=first, ncv=ARNOLDI_SUBSPACE_SIZE, tol=EIGENVALUE_TOLERANCE, return_eigenvectors=False
    )
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
    """Return the expected cost of moving from `offset` to the pose in `ticks` steps, defined as `Outcome.cost`.

    Args:
        plant: linear model of the arm near the pose.
        phi: state matrix of the arm over a step, (8, 8).
        gamma: input matrix of the arm over a step, (8, 4).
        controller: controller whose first poll gives the initial memory; one run.
        law: linear model of the controller.
        chain: ages of the acting command.
        offset: start position relative to the pose; rad, rad, m, rad, (4,).
        ticks: T.
    """
    matrices = transition_matrices(phi, gamma, law, chain.max_age)
    size, commands_at = len(matrices[0]), 8 + len(law.a)
    pose, start = np.array(plant.pose)[:, np.newaxis], np.array(offset)[:, np.newaxis]
    initial = Measurement(np.zeros(1), pose + start, pose, np.zeros(1))
    effort, memory = controller.law(controller.start(1), initial)
    # The first tick is evaluated directly, because the initial memory is not in the linear model.
    state = np.zeros(size)
    state[:8] = phi @ np.concatenate([start[:, 0], np.zeros(4)])
    rest = memory
    for _ in range(200):
        _, rest = controller.law(rest, Measurement(np.zeros(1), pose, pose, np.zeros(1)))
    state[8:commands_at] = memory[law.rows, 0] - rest[law.rows, 0]
    state[commands_at : commands_at + 4] = effort[:, 0] - np.array(plant.holding)
    weights = np.zeros((len(chain.ages), size))
    weights[:, :4] = ERROR_SCALE[:, 0] ** -2.0
    for weight, age in zip(weights, chain.ages.tolist(), strict=True):
        if age:
            weight[commands_at + 4 * (age - 1) : commands_at + 4 * age] = EFFORT_COST
    total = float((start[:, 0] ** 2) @ weights[0, :4])
    stacked = np.stack([matrices[age] for age in chain.ages.tolist()])
    transposed = stacked.transpose(0, 2, 1)
    moments = (chain.start @ chain.transition)[:, np.newaxis, np.newaxis] * np.outer(state, state)
    for _ in range(1, ticks):
        total += float(np.einsum("kii,ki->", moments, weights))
        moments = np.tensordot(chain.transition.T, stacked @ moments @ transposed, axes=1)
        if not np.isfinite(total):
            return float("inf")
    return total / ticks
