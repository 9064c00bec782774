"""Mean-square stability limit of loops with random delays.

For constant delays the spectral radius determines stability. For random delays, the age of the acting command is
modeled as a Markov chain (`expected_cost.age_chain`), estimated from a long sequence of draws. The loop is mean-square
stable if the second moments of its state decay.
"""

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_study.controllers.control_laws import LawController
from hilrig_study.study_config import StudyConfig
from hilrig_study.theory.expected_cost import age_chain, mean_square_radius, transition_matrices
from hilrig_study.theory.margins import STABLE_RADIUS, linearize_law

Ints = NDArray[np.int64]

CHAIN_TICKS: Final = 4000
"""Length of the sequence from which the chain is estimated, ticks."""
MAX_AGE_STEPS: Final = 24
"""Largest age of the acting command for which the limit is computed, steps; the matrices grow with the age."""


def stable_until(
    study: StudyConfig,
    controller: int,
    gain: float,
    step_ms: float,
    points: Sequence[float],
    ages_at: Callable[[float], Ints],
) -> float:
    """Return the largest of `points` for which a loop with one poll per step is mean-square stable.

    Args:
        study: the study.
        controller: index of the controller, which must be a control law without prediction.
        gain: its gain factor.
        step_ms: step of the simulation and poll period of the controller.
        points: ascending values of the other swept parameter; stability is assumed to be monotonic in it.
        ages_at: returns the ages of the acting command at one of the points, steps, (T,).

    Returns:
        -1 if the first point is unstable, inf if all are stable, NaN if the ages are too large.
    """
    rig, plant_model = study.rig(step_ms), study.linear_plant()
    step_s = step_ms * 1e-3
    built = study.controllers[controller].build(rig, plant_model, step_s, np.array([gain]))
    assert isinstance(built, LawController)
    law = linearize_law(built, plant_model, step_s, step_s)
    phi, gamma = study.discretized_plant(step_ms)

    def radius(number: int) -> float:
        ages = ages_at(points[number])
        if not len(ages) or ages.max() > MAX_AGE_STEPS:
            return math.nan
        chain = age_chain([ages])
        return mean_square_radius(chain, transition_matrices(phi, gamma, law, chain.max_age))

    first = radius(0)
    if not first < STABLE_RADIUS:
        return math.nan if math.isnan(first) else -1.0
    low, high = 0, len(points)
    while high - low > 1:
        middle = (low + high) // 2
        found = radius(middle)
        if math.isnan(found):
            return math.nan
        low, high = (middle, high) if found < STABLE_RADIUS else (low, middle)
    return math.inf if high == len(points) else points[low]
