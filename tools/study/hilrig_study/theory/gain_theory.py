"""Theory of one controller at one gain: largest stable delay, delay margin and jitter margin."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilrig_study.controllers.control_laws import LawController
from hilrig_study.study_config import StudyConfig
from hilrig_study.theory.margins import STABLE_RADIUS, Margins, linearize_law, loop_matrix, margins, spectral_radius


@dataclass(frozen=True, slots=True)
class GainTheory:
    """Stability limits of one controller at one gain, step and poll period."""

    controller: int
    gain: float
    step_ms: float
    poll_ms: float
    stable_until_ms: float
    """Largest constant delay of the command link for which the loop is stable; -1: unstable without delay; inf: stable
    at all swept delays."""
    nominal: Margins | None
    """Margins at the nominal latency; None: the controller does not poll once per step."""
    nominal_latency_ms: float
    mean_square_until: float = math.nan
    """For random delays or losses: largest value of the other swept parameter for which the loop is mean-square stable;
    -1 and inf as above; NaN: nothing is random, or the limit is unknown."""


def gain_theory(
    study: StudyConfig, controller: int, gain: float, step_ms: float, poll_ms: float, delays_ms: Sequence[float]
) -> tuple[GainTheory, dict[float, float]] | None:
    """Return the theory of one controller at one gain, and the spectral radius at each added delay.

    None: the controller can't be linearized.
    """
    rig, plant_model = study.rig(step_ms), study.linear_plant()
    timing = study.loop.timing(step_ms, poll_ms)
    config = study.controllers[controller]
    built = config.build(rig, plant_model, timing.period_ns * 1e-9, np.array([gain])) if config.kind != "file" else None
    if not isinstance(built, LawController):
        return None
    phi, gamma = study.discretized_plant(step_ms)
    by_pattern: dict[tuple[int, ...], float] = {}

    def radius(delay_ms: float) -> float:
        delay_ns = round(delay_ms * 1e6)
        polls = range(math.lcm(timing.step_ns, timing.period_ns) // timing.period_ns)
        pattern = tuple(timing.acts(poll, delay_ns) for poll in polls)
        if pattern not in by_pattern:
            latency_s = timing.latency_steps(0, delay_ns)[1] * timing.step_ns * 1e-9
            law = linearize_law(built, plant_model, timing.period_ns * 1e-9, latency_s)
            by_pattern[pattern] = spectral_radius(loop_matrix(phi, gamma, law, timing, 0, delay_ns))
        return by_pattern[pattern]

    radii = {delay_ms: radius(delay_ms) for delay_ms in delays_ms}
    unstable = [delay_ms for delay_ms in sorted(radii) if radii[delay_ms] >= STABLE_RADIUS]
    # The limit is the largest delay for which the command still arrives before the same tick.
    until = math.inf if not unstable else _last_stable(radius, unstable[0])
    steps = timing.latency_steps()[1]
    nominal = None
    if timing.period_ns == timing.step_ns:
        law = linearize_law(built, plant_model, timing.period_ns * 1e-9, steps * timing.step_ns * 1e-9)
        nominal = margins(phi, gamma, law, timing, steps)
    found = GainTheory(controller, gain, step_ms, poll_ms, until, nominal, steps * timing.step_ns / 1e6)
    return found, radii


def _last_stable(radius: Callable[[float], float], unstable_ms: float) -> float:
    """Return the largest stable delay below an unstable one, ms, with a resolution of 10 µs; -1: none."""
    if radius(0.0) >= STABLE_RADIUS:
        return -1.0
    low, high = 0.0, unstable_ms
    while high - low > 0.01:
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < STABLE_RADIUS else (low, middle)
    return low
