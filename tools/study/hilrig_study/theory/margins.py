"""What theory says of a loop: is it stable, and how much more delay and jitter does it bear?

A controller's law is linearised at the pose (exactly, where it is linear), and the sampled loop with its delays becomes
one matrix over a period of its pattern: the arm's state, the positions that are still on their way, the controller's
memory, the commands that are still on theirs. Stability is that matrix's spectral radius. The margins come from the
loop transfer function at the slots between the controller's output and the arm.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_study.controllers.controllers import LawController, Measured
from hilrig_study.simulation.timing import LoopTiming
from hilrig_study.theory.linear import LinearPlant

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

STABLE: Final = 1.0 - 1e-9
"""Spectral radii below this are stable; what is closer to 1 is the rounding of an integrator's pole."""
_SETTLING_POLLS: Final = 200
_FREQUENCIES: Final = 1000


@dataclass(frozen=True, slots=True)
class LinearLaw:
    """ξ(j+1) = A ξ(j) + B y(j), u(j) = C ξ(j) + D y(j): y position less pose, u effort less holding effort."""

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
    """Which rows of the controller's memory ξ is, (m,)."""

    def response(self, frequency: Floats) -> Complex:
        """C(e^jωT), (K, 4, 4), at ω, rad/s, (K,)."""
        z = np.exp(1j * frequency * self.period_s)[:, np.newaxis, np.newaxis]
        return np.asarray(self.c @ np.linalg.solve(z * np.eye(len(self.a)) - self.a, self.b) + self.d)


def linearise_law(controller: LawController, plant: LinearPlant, period_s: float, latency_s: float = 0.0) -> LinearLaw:
    """A law near rest at the plant's pose, by central differences: exact but for rounding where it is linear.

    Args:
        controller: its law, with one set of gains.
        plant: says the pose and the effort that holds it.
        period_s: of the polls, s.
        latency_s: loop latency that the controller measures, constant, s.

    Raises:
        InputError: its memory does not come to rest with the arm at rest at its goal.
    """
    goal = np.array(plant.pose)[:, np.newaxis]
    still = Measured(np.zeros(1), goal, goal, np.full(1, latency_s))
    rest = controller.start(1)
    for _ in range(_SETTLING_POLLS):
        _, following = controller.law(rest, still)
        moved, rest = np.abs(following - rest), following
    if not np.nanmax(moved) < 1e-9:
        raise InputError("the controller's memory does not come to rest while the arm rests at its goal")
    rows = len(rest)
    # Every difference is a run of its own, and all are one evaluation: first the one side of each, then the other.
    count = rows + 4
    small = 1e-5 * np.concatenate([np.eye(count), -np.eye(count)], axis=1)
    goals = np.repeat(goal, 2 * count, axis=1)
    asked = Measured(np.zeros(2 * count), goal + small[rows:], goals, np.full(2 * count, latency_s))
    effort, following = controller.law(rest + small[:rows], asked)
    c_and_d = (effort[:, :count] - effort[:, count:]) / 2e-5
    a_and_b = (following[:, :count] - following[:, count:]) / 2e-5
    needed = _needed(a_and_b[:, :rows], c_and_d[:, :rows])
    a, b = a_and_b[np.ix_(needed, needed)], a_and_b[needed, rows:]
    return LinearLaw(a, b, c_and_d[:, needed], c_and_d[:, rows:], period_s, needed)


def _needed(a: Floats, c: Floats) -> NDArray[np.intp]:
    """Rows of a memory that sooner or later enter the output: an integral without a gain is no mode of the loop."""
    needed = np.any(c != 0, axis=0)
    while True:
        more = needed | np.any(a[needed] != 0, axis=0)
        if (more == needed).all():
            return np.flatnonzero(needed)
        needed = more


def loop_matrix(
    phi: Floats, gamma: Floats, law: LinearLaw, timing: LoopTiming, state_delay_ns: int = 0, command_delay_ns: int = 0
) -> Floats:
    """Transition matrix of the closed loop over one period of its pattern, under constant delays.

    The state is (x, the last positions, ξ, the last commands), newest first; events are taken in the order of time.

    Args:
        phi: of the arm over a step, (8, 8).
        gamma: the same, (8, 4).
        law: of the controller.
        timing: the loop's own times; its period must be the law's.
        state_delay_ns: injected on the state's way.
        command_delay_ns: injected on the command's way.
    """
    pattern_ns = math.lcm(timing.step_ns, timing.period_ns)
    ticks = pattern_ns // timing.step_ns

    def tick_of(poll: int) -> int:
        return (timing.phase_ns + poll * timing.period_ns) // timing.step_ns

    def newest(tick: int) -> int:
        """Poll whose command acts at a tick; the pattern repeats in both directions."""
        poll = (tick * timing.step_ns - timing.phase_ns) // timing.period_ns + 1
        while timing.acts(poll, command_delay_ns) > tick:
            poll -= 1
        return poll

    first_tick = tick_of(0)
    polls = range(pattern_ns // timing.period_ns)
    behind = max(tick_of(poll) - timing.basis(poll, state_delay_ns) for poll in polls)
    # Commands that are not yet in force at the end of a tick's step must be remembered, and the one in force.
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
            turn = np.eye(size)
            turn[inner:queue] = 0
            turn[inner:queue, inner:queue] = law.a
            turn[inner:queue, column] = law.b
            turn[queue:] = 0
            turn[queue : queue + 4, inner:queue] = law.c
            turn[queue : queue + 4, column] = law.d
            turn[queue + 4 :, queue:-4] = np.eye(4 * (waiting - 1))
            total = turn @ total
        place = queue + 4 * (_last_before(timing, tick + 1) - acting)
        turn = np.eye(size)
        turn[:8] = 0
        turn[:8, :8] = phi
        turn[:8, place : place + 4] = gamma
        if behind:
            turn[seen:inner] = 0
            turn[seen : seen + 4, :4] = np.eye(4)
            turn[seen + 4 : inner, seen : inner - 4] = np.eye(4 * (behind - 1))
        total = turn @ total
    return total


def _last_before(timing: LoopTiming, tick: int) -> int:
    """Last poll that reads before a tick."""
    return -(-(tick * timing.step_ns - timing.phase_ns) // timing.period_ns) - 1


def spectral_radius(matrix: Floats) -> float:
    """Largest modulus of the eigenvalues."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def is_stable(
    phi: Floats, gamma: Floats, law: LinearLaw, timing: LoopTiming, state_delay_ns: int = 0, command_delay_ns: int = 0
) -> bool:
    """Whether the loop is stable under constant delays; arguments as `loop_matrix`."""
    return spectral_radius(loop_matrix(phi, gamma, law, timing, state_delay_ns, command_delay_ns)) < STABLE


def loop_transfer(phi: Floats, gamma: Floats, law: LinearLaw, latency_steps: int, frequency: Floats) -> Complex:
    """Loop transfer function -C(z) P(z) z^-n, cut at the arm's input, (K, 4, 4), at ω, rad/s, (K,).

    The controller polls once a step, and n = `latency_steps` is the loop latency: the position of step k enters the
    torque that acts from step k + n on.
    """
    z = np.exp(1j * frequency * law.period_s)[:, np.newaxis, np.newaxis]
    see = np.hstack([np.eye(4), np.zeros((4, 4))])
    plant = see @ np.linalg.solve(z * np.eye(8) - phi, gamma)
    return np.asarray(-(law.response(frequency) @ plant) * z**-latency_steps)


@dataclass(frozen=True, slots=True)
class Margins:
    """What a loop with one poll a step bears."""

    stable: bool
    """At the nominal loop latency."""
    radius: float
    """Spectral radius there."""
    delay_margin_s: float
    """Constant delay that may be added before the loop becomes unstable, s; 0: it is unstable, inf: any."""
    crossover: float
    """Frequency at which the delay margin is lost, rad/s; NaN: there is none."""
    jitter_margin_s: float
    """Time-varying delay between 0 and this may be added, in any order, s; sufficient, not necessary."""


def margins(phi: Floats, gamma: Floats, law: LinearLaw, timing: LoopTiming, latency_steps: int) -> Margins:
    """Margins at a nominal, constant loop latency.

    The delay margin is the smallest (π + arg λ)/ω over the eigenloci λ of L(e^jωh) with |λ| = 1: exact at whole steps,
    and between them what the added phase says. The jitter margin is theorem 2 of C.-Y. Kao and B. Lincoln, "Simple
    stability criteria for systems with time-varying delays", Automatica 40 (2004) 1429-1434: with delays of 0 to N
    steps in any order the loop is stable if σ(T(e^jω)) N |e^jω - 1| < 1 at all frequencies, T = L (I + L)^-1, for the
    operator u(k) -> u(k - d(k)) - u(k) is a sum of at most N differences of u.

    Raises:
        InputError: the controller does not poll once a step, where the theorem does not apply.
    """
    if timing.period_ns != timing.step_ns:
        raise InputError(
            f"margins are defined for one poll a step: the step is {timing.step_ns / 1e6:g} ms, "
            f"the controller polls every {timing.period_ns / 1e6:g} ms"
        )
    step_s = law.period_s
    nominal, delay_ns = loop_of(timing.step_ns, latency_steps)
    radius = spectral_radius(loop_matrix(phi, gamma, law, nominal, command_delay_ns=delay_ns))
    if radius >= STABLE:
        return Margins(False, radius, 0.0, math.nan, 0.0)
    frequency = np.geomspace(1e-2, math.pi / step_s, _FREQUENCIES)
    loop = loop_transfer(phi, gamma, law, latency_steps, frequency)
    delay_s, crossover = _delay_margin(loop, frequency)
    closed = np.linalg.solve(np.eye(4) + loop, loop)
    gain = np.linalg.norm(closed, ord=2, axis=(1, 2)) * np.abs(np.exp(1j * frequency * step_s) - 1)
    return Margins(True, radius, delay_s, crossover, step_s / float(gain.max()))


def loop_of(step_ns: int, latency_steps: int) -> tuple[LoopTiming, int]:
    """A loop of one poll a step with this constant latency: its timing, and the delay of the command's way, ns.

    Raises:
        InputError: less than a step, which no loop takes: a state can't be answered within its own step.
    """
    if latency_steps < 1:
        raise InputError(f"a loop takes at least one step, found {latency_steps}")
    return LoopTiming(step_ns, step_ns, 0, step_ns // 2, 0), (latency_steps - 1) * step_ns


def _delay_margin(loop: Complex, frequency: Floats) -> tuple[float, float]:
    """Smallest delay, s, whose phase brings an eigenlocus that has modulus 1 to -1, and its frequency, rad/s."""
    loci = np.linalg.eigvals(loop)
    best, where = math.inf, math.nan
    for index in range(len(frequency) - 1):
        # From one frequency to the next each locus goes to the nearest.
        here, there = loci[index], loci[index + 1]
        order = np.abs(here[:, np.newaxis] - there[np.newaxis, :]).argmin(axis=1)
        for start, end in zip(here, there[order], strict=True):
            low, high = np.log(abs(start)), np.log(abs(end))
            if not low * high <= 0 or low == high:
                continue
            share = low / (low - high)
            omega = frequency[index] + share * (frequency[index + 1] - frequency[index])
            turned = np.angle(start) + share * np.angle(end / start)
            delay = ((math.pi + turned) % (2 * math.pi)) / omega
            if delay < best:
                best, where = float(delay), float(omega)
    return best, where
