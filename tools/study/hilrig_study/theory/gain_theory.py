"""What theory says of one controller at one gain: up to which delay its loop is stable, and its margins."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilrig_study.controllers.controllers import LawController
from hilrig_study.study_config import StudyConfig
from hilrig_study.theory.margins import STABLE, Margins, linearise_law, loop_matrix, margins, spectral_radius


@dataclass(frozen=True, slots=True)
class GainTheory:
    """What theory says of one controller at one gain, step and period."""

    controller: int
    gain: float
    step_ms: float
    poll_ms: float
    stable_until_ms: float
    """Largest constant delay that can be added to the command's way before the loop is unstable; -1: it is, without
    any; inf: more than was looked at."""
    nominal: Margins | None
    """At the loop's own latency; None: the controller does not poll once a step."""
    nominal_latency_ms: float
    mean_square_until: float = math.nan
    """Where delays or losses are drawn: largest value of what is swept beside the gain, in its unit, up to which the
    loop is stable in the mean square; -1 and inf as above; NaN: nothing is drawn, or it can't be told."""


def gain_theory(
    study: StudyConfig, controller: int, gain: float, step_ms: float, poll_ms: float, delays_ms: Sequence[float]
) -> tuple[GainTheory, dict[float, float]] | None:
    """Theory of one controller at one gain, and the spectral radius at each added delay; None: it has no law."""
    rig, near = study.rig(step_ms), study.near()
    timing = study.loop.timing(step_ms, poll_ms)
    config = study.controllers[controller]
    built = config.build(rig, near, timing.period_ns * 1e-9, np.array([gain])) if config.kind != "file" else None
    if not isinstance(built, LawController):
        return None
    phi, gamma = study.discretised(step_ms)
    by_pattern: dict[tuple[int, ...], float] = {}

    def radius(delay_ms: float) -> float:
        delay_ns = round(delay_ms * 1e6)
        polls = range(math.lcm(timing.step_ns, timing.period_ns) // timing.period_ns)
        pattern = tuple(timing.acts(poll, delay_ns) for poll in polls)
        if pattern not in by_pattern:
            latency_s = timing.latency_steps(0, delay_ns)[1] * timing.step_ns * 1e-9
            law = linearise_law(built, near, timing.period_ns * 1e-9, latency_s)
            by_pattern[pattern] = spectral_radius(loop_matrix(phi, gamma, law, timing, 0, delay_ns))
        return by_pattern[pattern]

    radii = {delay_ms: radius(delay_ms) for delay_ms in delays_ms}
    unstable = [delay_ms for delay_ms in sorted(radii) if radii[delay_ms] >= STABLE]
    # The boundary is a tick's: the last delay before the one from which the command comes a tick later.
    until = math.inf if not unstable else _last_stable(radius, unstable[0])
    steps = timing.latency_steps()[1]
    nominal = None
    if timing.period_ns == timing.step_ns:
        law = linearise_law(built, near, timing.period_ns * 1e-9, steps * timing.step_ns * 1e-9)
        nominal = margins(phi, gamma, law, timing, steps)
    found = GainTheory(controller, gain, step_ms, poll_ms, until, nominal, steps * timing.step_ns / 1e6)
    return found, radii


def _last_stable(radius: Callable[[float], float], unstable_ms: float) -> float:
    """Largest stable delay below an unstable one, ms, to 10 µs; -1: there is none."""
    if radius(0.0) >= STABLE:
        return -1.0
    low, high = 0.0, unstable_ms
    while high - low > 0.01:
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < STABLE else (low, middle)
    return low
