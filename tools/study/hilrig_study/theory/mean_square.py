"""Where the loop is stable in the mean square: the boundary of a plane whose delays are drawn, not constant.

Under a constant delay the spectral radius tells. Where delays are drawn, the age of what acts is a Markov chain
(`expected_cost.age_chain`), taken from a long course of draws, and the second moments of the linear loop either die out
or grow.
"""

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_study.controllers.controllers import LawController
from hilrig_study.study_config import StudyConfig
from hilrig_study.theory.expected_cost import age_chain, mean_square_radius, turns
from hilrig_study.theory.margins import STABLE, linearise_law

Ints = NDArray[np.int64]

TICKS: Final = 4000
"""Of the course of draws that the chain is taken from."""
LARGEST_AGE: Final = 24
"""The loop's matrices grow with the age of what acts: beyond this, steps, nothing is said."""


def stable_until(
    study: StudyConfig,
    controller: int,
    gain: float,
    step_ms: float,
    points: Sequence[float],
    ages_at: Callable[[float], Ints],
) -> float:
    """Largest of `points` up to which a loop with one poll a step is stable in the mean square.

    Args:
        study: the study.
        controller: its number; it has a law, and does not predict.
        gain: its gain factor.
        step_ms: of the simulation, and of the controller.
        points: values of what is swept beside the gain, ascending; a larger one is taken to be no better.
        ages_at: ages of what acts at one of them, steps, (T,).

    Returns:
        -1 where the first is not stable, inf where all are, NaN where ages are too large to tell.
    """
    rig, near = study.rig(step_ms), study.near()
    step_s = step_ms * 1e-3
    built = study.controllers[controller].build(rig, near, step_s, np.array([gain]))
    assert isinstance(built, LawController)
    law = linearise_law(built, near, step_s, step_s)
    phi, gamma = study.discretised(step_ms)

    def radius(number: int) -> float:
        ages = ages_at(points[number])
        if not len(ages) or ages.max() > LARGEST_AGE:
            return math.nan
        chain = age_chain([ages])
        return mean_square_radius(chain, turns(phi, gamma, law, chain.most))

    first = radius(0)
    if not first < STABLE:
        return math.nan if math.isnan(first) else -1.0
    low, high = 0, len(points)
    while high - low > 1:
        middle = (low + high) // 2
        found = radius(middle)
        if math.isnan(found):
            return math.nan
        low, high = (middle, high) if found < STABLE else (low, middle)
    return math.inf if high == len(points) else points[low]
