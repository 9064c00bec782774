"""Stability of the linearized loop, and its delay margin and jitter margin.

The control law is linearized at the pose (exactly, if it is linear). The sampled loop with constant delays is
represented by one transition matrix over a period of its poll pattern; the state consists of the arm's state, the
positions and commands in flight, and the controller's memory. The loop is stable if the spectral radius is below 1. The
margins are computed from the loop transfer function, opened at the input of the arm.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.control_laws import LawController, Measurement
from hilrig_study.linear_model import LinearPlant
from hilrig_study.simulation.timing import LoopTiming

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

STABLE_RADIUS: Final = 1.0 - 1e-9
"""Spectral radius below which a loop is stable; the distance to 1 covers rounding of an integrator's pole."""
_SETTLING_POLLS: Final = 200
_FREQUENCY_POINTS: Final = 1000


@dataclass(frozen=True, slots=True)
class LinearLaw:
    """Linear controller ξ(j+1) = A ξ(j) + B y(j), u(j) = C ξ(j) + D y(j); y = position - pose, u = effort - holding."""

    a: Floats
    """(m, m)."""
    b: Floats
    """(m, 4)."""
    c: Floats
    """(4, m)."""
    d: Floats
    """(4, 4)."""
    period_s: float
    rows: NDArray[np.intp]
    """Rows of the controller's memory that form ξ, (m,)."""

    def response(self, frequency: Floats) -> Complex:
        """Return the frequency response C(e^jωT), (K, 4, 4), at ω, rad/s, (K,)."""
        z = np.exp(1j * frequency * self.period_s)[:, np.newaxis, np.newaxis]
        return np.asarray(self.c @ np.linalg.solve(z * np.eye(len(self.a)) - self.a, self.b) + self.d)


def linearize_law(controller: LawController, plant: LinearPlant, period_s: float, latency_s: float = 0.0) -> LinearLaw:
    """Linearize a control law at rest at the plant's pose, by central differences.

    The result is exact up to rounding if the law is linear.

    Args:
        controller: control law with one set of gains.
        plant: linear model with the pose and its holding effort.
        period_s: poll period, s.
        latency_s: constant loop latency measured by the controller, s.

    Raises:
        InputError: the memory does not converge while the arm is at rest at its set point.
    """
    goal = np.array(plant.pose)[:, np.newaxis]
    at_rest = Measurement(np.zeros(1), goal, goal, np.full(1, latency_s))
    rest = controller.start(1)
    for _ in range(_SETTLING_POLLS):
        _, following = controller.law(rest, at_rest)
        moved, rest = np.abs(following - rest), following
    if not np.nanmax(moved) < 1e-9:
        raise InputError(
            "can't linearize the controller: its memory does not converge while the arm is at rest at its set point"
        )
    rows = len(rest)
    # Each perturbation is one run; all positive perturbations are followed by all negative ones in a single evaluation.
    count = rows + 4
    perturbation = 1e-5 * np.concatenate([np.eye(count), -np.eye(count)], axis=1)
    goals = np.repeat(goal, 2 * count, axis=1)
    perturbed = Measurement(np.zeros(2 * count), goal + perturbation[rows:], goals, np.full(2 * count, latency_s))
    effort, following = controller.law(rest + perturbation[:rows], perturbed)
    c_and_d = (effort[:, :count] - effort[:, count:]) / 2e-5
    a_and_b = (following[:, :count] - following[:, count:]) / 2e-5
    needed = _observable_rows(a_and_b[:, :rows], c_and_d[:, :rows])
    a, b = a_and_b[np.ix_(needed, needed)], a_and_b[needed, rows:]
    return LinearLaw(a, b, c_and_d[:, needed], c_and_d[:, rows:], period_s, needed)


def _observable_rows(a: Floats, c: Floats) -> NDArray[np.intp]:
    """Return the rows of the memory that affect the output; an integral without gain, for example, does not."""
    needed = np.any(c != 0, axis=0)
    while True:
        more = needed | np.any(a[needed] != 0, axis=0)
        if (more == needed).all():
            return np.flatnonzero(needed)
        needed = more


def loop_matrix(
    phi: Floats, gamma: Floats, law: LinearLaw, timing: LoopTiming, state_delay_ns: int = 0, command_delay_ns: int = 0
) -> Floats:
    """Return the transition matrix of the closed loop over one period of its poll pattern, for constant delays.

    The state is (x, the last positions, ξ, the last commands), newest first. The events of a period are applied in the
    order of time.

    Args:
        phi: state matrix of the arm over a step, (8, 8).
        gamma: input matrix of the arm over a step, (8, 4).
        law: linear model of the controller.
        timing: timing of the loop without injected delays; its period must equal the law's.
        state_delay_ns: injected delay of the state link.
        command_delay_ns: injected delay of the command link.
    """
    pattern_ns = math.lcm(timing.step_ns, timing.period_ns)
    ticks = pattern_ns // timing.step_ns

    def tick_of(poll: int) -> int:
        return (timing.phase_ns + poll * timing.period_ns) // timing.step_ns

    def newest(tick: int) -> int:
        """Return the poll whose command acts at a tick; the pattern is periodic in both directions."""
        poll = (tick * timing.step_ns - timing.phase_ns) // timing.period_ns + 1
        while timing.acts(poll, command_delay_ns) > tick:
            poll -= 1
        return poll

    first_tick = tick_of(0)
    polls = range(pattern_ns // timing.period_ns)
    behind = max(tick_of(poll) - timing.basis(poll, state_delay_ns) for poll in polls)
    # The state contains the acting command and the commands that do not act yet at the end of a step.
    waiting = 1 + max(_last_before(timing, tick + 1) - newest(tick) for tick in range(first_tick, first_tick + ticks))
    memory = len(law.a)
    seen, inner, queue = 8, 8 + 4 * behind, 8 + 4 * behind + memory
    size = queue + 4 * waiting
    total = np.eye(size)
    for tick in range(first_tick, first_tick + ticks):
        acting = newest(tick)
        for poll in range(_last_before(timing, tick) + 1, _last_before(timing, tick + 1) + 1):
            age = tick - timing.basis(poll, state_delay_ns)
            column = slice(0, 4) if age == 0 else slice(seen + 4 * (age - 1), seen + 4 * age)
            event = np.eye(size)
            event[inner:queue] = 0
            event[inner:queue, inner:queue] = law.a
            event[inner:queue, column] = law.b
            event[queue:] = 0
            event[queue : queue + 4, inner:queue] = law.c
            event[queue : queue + 4, column] = law.d
            event[queue + 4 :, queue:-4] = np.eye(4 * (waiting - 1))
            total = event @ total
        place = queue + 4 * (_last_before(timing, tick + 1) - acting)
        event = np.eye(size)
        event[:8] = 0
        event[:8, :8] = phi
        event[:8, place : place + 4] = gamma
        if behind:
            event[seen:inner] = 0
            event[seen : seen + 4, :4] = np.eye(4)
            event[seen + 4 : inner, seen : inner - 4] = np.eye(4 * (behind - 1))
        total = event @ total
    return total


def _last_before(timing: LoopTiming, tick: int) -> int:
    """Return the last poll that reads before a tick."""
    return -(-(tick * timing.step_ns - timing.phase_ns) // timing.period_ns) - 1


def spectral_radius(matrix: Floats) -> float:
    """Return the largest modulus of the eigenvalues."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def loop_transfer(phi: Floats, gamma: Floats, law: LinearLaw, latency_steps: int, frequency: Floats) -> Complex:
    """Return the loop transfer function -C(z) P(z) z^-n, opened at the arm's input, (K, 4, 4), at ω, rad/s, (K,).

    The controller polls once per step, and n = `latency_steps` is the loop latency: the torque that acts from step
    k + n on is based on the position of step k.
    """
    z = np.exp(1j * frequency * law.period_s)[:, np.newaxis, np.newaxis]
    output = np.hstack([np.eye(4), np.zeros((4, 4))])
    plant = output @ np.linalg.solve(z * np.eye(8) - phi, gamma)
    return np.asarray(-(law.response(frequency) @ plant) * z**-latency_steps)


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability margins of a loop with one poll per step."""

    stable: bool
    """Whether the loop is stable at the nominal loop latency."""
    radius: float
    """Spectral radius at the nominal loop latency."""
    delay_margin_s: float
    """Largest constant additional delay for which the loop is stable, s; 0: unstable; inf: stable for any delay."""
    crossover: float
    """Crossover frequency of the delay margin, rad/s; NaN: none."""
    jitter_margin_s: float
    """Bound of an additional time-varying delay for which the loop is stable, s; sufficient, not necessary."""


def margins(phi: Floats, gamma: Floats, law: LinearLaw, timing: LoopTiming, latency_steps: int) -> Margins:
    """Return the margins at a nominal, constant loop latency.

    The delay margin is the smallest (π + arg λ)/ω over the eigenloci λ of L(e^jωh) with |λ| = 1; it is exact at whole
    steps, and interpolated by the added phase in between. The jitter margin is theorem 2 of C.-Y. Kao and B. Lincoln,
    "Simple stability criteria for systems with time-varying delays", Automatica 40 (2004) 1429-1434: with delays of 0
    to N steps in any order, the loop is stable if σ(T(e^jω)) N |e^jω - 1| < 1 at all ω, T = L (I + L)^-1, because
    the operator u(k) -> u(k - d(k)) - u(k) is a sum of at most N differences of u.

    Raises:
        InputError: the controller does not poll once per step, so the theorem does not apply.
    """
    if timing.period_ns != timing.step_ns:
        raise InputError(
            f"margins need one poll per step: the poll period must be {timing.step_ns / 1e6:g} ms, "
            f"got {timing.period_ns / 1e6:g} ms"
        )
    step_s = law.period_s
    nominal, delay_ns = constant_latency_timing(timing.step_ns, latency_steps)
    radius = spectral_radius(loop_matrix(phi, gamma, law, nominal, command_delay_ns=delay_ns))
    if radius >= STABLE_RADIUS:
        return Margins(False, radius, 0.0, math.nan, 0.0)
    frequency = np.geomspace(1e-2, math.pi / step_s, _FREQUENCY_POINTS)
    loop = loop_transfer(phi, gamma, law, latency_steps, frequency)
    delay_s, crossover = _delay_margin(loop, frequency)
    closed = np.linalg.solve(np.eye(4) + loop, loop)
    gain = np.linalg.norm(closed, ord=2, axis=(1, 2)) * np.abs(np.exp(1j * frequency * step_s) - 1)
    return Margins(True, radius, delay_s, crossover, step_s / float(gain.max()))


def constant_latency_timing(step_ns: int, latency_steps: int) -> tuple[LoopTiming, int]:
    """Return the timing of a loop with one poll per step and a constant latency, and its command delay, ns.

    Raises:
        InputError: the latency is less than one step.
    """
    if latency_steps < 1:
        raise InputError(f"the loop latency must be at least one step, got {latency_steps}")
    return LoopTiming(step_ns, step_ns, 0, step_ns // 2, 0), (latency_steps - 1) * step_ns


def _delay_margin(loop: Complex, frequency: Floats) -> tuple[float, float]:
    """Return the smallest delay, s, whose phase moves an eigenlocus of modulus 1 to -1, and the frequency, rad/s."""
    loci = np.linalg.eigvals(loop)
    best, where = math.inf, math.nan
    for index in range(len(frequency) - 1):
        # Between two frequencies, each locus is matched with the nearest one.
        here, there = loci[index], loci[index + 1]
        order = np.abs(here[:, np.newaxis] - there[np.newaxis, :]).argmin(axis=1)
        for start, end in zip(here, there[order], strict=True):
            low, high = np.log(abs(start)), np.log(abs(end))
            if not low * high <= 0 or low == high:
                continue
            share = low / (low - high)
            omega = frequency[index] + share * (frequency[index + 1] - frequency[index])
            phase = np.angle(start) + share * np.angle(end / start)
            delay = ((math.pi + phase) % (2 * math.pi)) / omega
            if delay < best:
                best, where = float(delay), float(omega)
    return best, where
