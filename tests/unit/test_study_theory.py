"""Theory of the loop: linear models against the arm, loop matrices against hand-made ones, margins against trials."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import ArmParameters, RigParameters, StepParameters
from hilrig_sim.plant.plant import Plant
from hilrig_study.controllers.controllers import ComputedTorque, LawController, Measured, Pid
from hilrig_study.controllers.lqr import PredictiveLqr
from hilrig_study.simulation.timing import LoopTiming
from hilrig_study.theory.linear import LinearPlant, linearise
from hilrig_study.theory.margins import (
    LinearLaw,
    is_stable,
    linearise_law,
    loop_matrix,
    loop_of,
    margins,
    spectral_radius,
)

ARM = ArmParameters()
POSES = ((0.3, 0.8, 0.08, 0.2), (-0.6, 1.6, 0.05, -0.4), (0.9, -0.4, 0.12, 1.0))
KP, KD = np.array([23.0, 14.0, 30.0, 0.25]), np.array([4.6, 2.9, 2.0, 0.03])
STEP_S = 0.02


def pd(gain: float = 1.0, period_s: float = STEP_S, filter_s: float = 0.02) -> Pid:
    return Pid(ARM, period_s, KP * gain, KD * gain, filter_s=filter_s)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("integrator", ["rkf45", "rk4"])
def test_the_linear_step_is_the_derivative_of_the_arms_own_step(
    pose: tuple[float, float, float, float], integrator: str
) -> None:
    rig = RigParameters(sim=StepParameters(substeps=2, integrator=integrator))
    plant = linearise(ARM, pose)
    phi, gamma = plant.discretise(STEP_S, integrator, substeps=2)
    small, found = 1e-5, np.empty((8, 12))
    for index in range(12):
        ends = []
        for sign in (1, -1):
            moved = np.zeros(12)
            moved[index] = sign * small
            arm = Plant([rig])
            arm.set_state(0, tuple(np.array(pose) + moved[:4]), tuple(moved[4:8]))
            arm.step((np.array(plant.holding) + moved[8:])[:, np.newaxis], np.zeros(1, dtype=np.bool_))
            ends.append(np.concatenate([arm.position[:, 0], arm.velocity[:, 0]]))
        found[:, index] = (ends[0] - ends[1]) / (2 * small)
    np.testing.assert_allclose(found, np.hstack([phi, gamma]), atol=2e-7)


def test_the_exact_step_is_what_many_short_ones_come_to() -> None:
    plant = linearise(ARM, POSES[0])
    phi, gamma = plant.discretise(STEP_S)
    short_phi, short_gamma = plant.discretise(STEP_S, "rkf45", substeps=50)
    np.testing.assert_allclose(short_phi, phi, atol=1e-9)
    np.testing.assert_allclose(short_gamma, gamma, atol=1e-9)
    np.testing.assert_allclose(phi, expm(plant.a * STEP_S), atol=1e-12)


def test_without_coupling_each_joint_stands_alone() -> None:
    b = linearise(ARM, POSES[0], coupled=False).b[4:]
    assert np.count_nonzero(b - np.diag(np.diag(b))) == 0
    assert linearise(ARM, POSES[0]).b[4, 1] != 0


@pytest.mark.parametrize(
    ("pose", "said"), [((0.0, 0.0, 0.0, 0.0), "d3"), ((9.0, 0.0, 0.1, 0.0), "theta1"), ((0.0, 0.1), "four joints")]
)
def test_a_pose_at_or_beyond_a_stop_is_refused(pose: tuple[float, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        linearise(ARM, pose)


def test_an_unknown_discretisation_is_named() -> None:
    with pytest.raises(InputError, match="tustin"):
        linearise(ARM, POSES[0]).discretise(STEP_S, "tustin")


def test_a_pds_law_is_found_as_it_is_written() -> None:
    """u = -Kp y - Kd v; v = βv + (1-β)/T (y - y_before): by hand, for one joint."""
    law = linearise_law(pd(), linearise(ARM, POSES[0]), STEP_S)
    beta = math.exp(-1)
    take = (1 - beta) / STEP_S
    omega = np.array([3.0, 20.0, 90.0])
    z = np.exp(1j * omega * STEP_S)
    by_hand = -KP[0] - KD[0] * take * (1 - 1 / z) / (1 - beta / z)
    np.testing.assert_allclose(law.response(omega)[:, 0, 0], by_hand, rtol=1e-7)
    np.testing.assert_allclose(law.response(omega)[:, 0, 1], 0, atol=1e-6)


def test_an_integral_is_held_within_its_limit_and_comes_back_at_once() -> None:
    gain = 3.0
    controller = Pid(ARM, STEP_S, (0.0,) * 4, (0.0,) * 4, (gain,) * 4)
    controller.begin(1)

    def efforts(off: float, polls: int) -> np.ndarray:
        for _ in range(polls):
            measured = Measured(np.zeros(1), np.zeros((4, 1)), np.full((4, 1), off), np.zeros(1))
            effort = controller.update(measured)
        return effort[:, 0] - np.array([0, 0, -ARM.masses[2] * 9.81, 0])

    assert efforts(0.5, 10) == pytest.approx([gain * 0.1, gain * 0.1, gain * 0.02, gain * 0.1])
    wound_up = [gain * 0.2, gain * 0.2, gain * 0.02, gain * 0.2]
    assert efforts(0.5, 1000) == pytest.approx(wound_up)
    assert efforts(-0.5, 1) == pytest.approx([effort - gain * 0.5 * STEP_S for effort in wound_up])


def test_an_integral_without_gain_is_no_mode_of_the_loop() -> None:
    plant = linearise(ARM, POSES[0])
    with_integral = Pid(ARM, STEP_S, KP, KD, (3.0, 0.0, 0.0, 0.0))
    assert len(linearise_law(with_integral, plant, STEP_S).a) == len(linearise_law(pd(), plant, STEP_S).a) + 1


def test_the_loop_matrix_is_the_one_made_by_hand() -> None:
    """One step of loop latency and a static law: x(k+1) = Φ x(k) + Γ D y(k-1)."""
    plant = linearise(ARM, POSES[0])
    phi, gamma = plant.discretise(STEP_S)
    gain = -np.diag([5.0, 3.0, 10.0, 0.1])
    law = LinearLaw(np.zeros((0, 0)), np.zeros((0, 4)), np.zeros((4, 0)), gain, STEP_S, np.empty(0, dtype=np.intp))
    see = np.hstack([np.eye(4), np.zeros((4, 4))])
    by_hand = np.block([[phi, gamma @ gain], [see, np.zeros((4, 4))]])
    timing, delay_ns = loop_of(20_000_000, 1)
    found = np.linalg.eigvals(loop_matrix(phi, gamma, law, timing, command_delay_ns=delay_ns))
    expected = np.linalg.eigvals(by_hand)
    assert sorted(np.abs(found[np.abs(found) > 1e-6])) == pytest.approx(
        sorted(np.abs(expected[np.abs(expected) > 1e-6]))
    )


def test_a_delay_counts_the_same_on_either_way() -> None:
    plant = linearise(ARM, POSES[0])
    phi, gamma = plant.discretise(STEP_S)
    law = linearise_law(pd(0.4), plant, STEP_S)
    timing = LoopTiming()
    for delay_ns in (0, 20_000_000, 60_000_000):
        there = spectral_radius(loop_matrix(phi, gamma, law, timing, state_delay_ns=delay_ns))
        back = spectral_radius(loop_matrix(phi, gamma, law, timing, command_delay_ns=delay_ns))
        assert there == pytest.approx(back, abs=1e-9)


def closed_loop_radius(
    plant: LinearPlant, controller: LawController, timing: LoopTiming, delays_ns: tuple[int, int], patterns: int
) -> float:
    """Growth a pattern, by stepping the loop event by event: no matrices of the code under test."""
    phi, gamma = plant.discretise(timing.step_ns * 1e-9)
    law = linearise_law(controller, plant, timing.period_ns * 1e-9)
    pattern_ns = math.lcm(timing.step_ns, timing.period_ns)
    ticks = patterns * pattern_ns // timing.step_ns
    x = np.full(8, 1e-3)
    seen: dict[int, np.ndarray] = {}
    commands: list[tuple[int, np.ndarray]] = []
    memory = np.zeros(len(law.a))
    norms = []
    next_poll = 0
    for tick in range(ticks):
        seen = {k: y for k, y in seen.items() if k > tick - 20} | {tick: x[:4].copy()}
        while timing.phase_ns + next_poll * timing.period_ns < (tick + 1) * timing.step_ns:
            read_ns = timing.phase_ns + next_poll * timing.period_ns
            served = [k for k in seen if k * timing.step_ns + timing.transport_ns + delays_ns[0] <= read_ns]
            if served:
                y = seen[max(served)]
                arrives = read_ns + timing.compute_ns + timing.transport_ns + delays_ns[1]
                commands.append((arrives, law.c @ memory + law.d @ y))
                memory = law.a @ memory + law.b @ y
            next_poll += 1
        acting = [u for arrives, u in commands if arrives <= tick * timing.step_ns]
        x = phi @ x + gamma @ (acting[-1] if acting else np.zeros(4))
        if (tick + 1) * timing.step_ns % pattern_ns == 0:
            norms.append(float(np.linalg.norm(x)))
            x, memory = x / norms[-1], memory / norms[-1]
            seen = {k: y / norms[-1] for k, y in seen.items()}
            commands = [(arrives, u / norms[-1]) for arrives, u in commands[-20:]]
    return float(np.exp(np.mean(np.log(norms[patterns // 2 :]))))


@pytest.mark.parametrize(
    ("period_ms", "phase_ms", "delays_ms"),
    [(20, 5, (0, 0)), (20, 5, (33, 12)), (50, 7, (0, 0)), (50, 7, (31, 45)), (5, 1, (0, 13)), (30, 11, (45, 0))],
)
def test_any_pattern_of_polls_grows_as_its_matrix_says(
    period_ms: int, phase_ms: int, delays_ms: tuple[int, int]
) -> None:
    ms = 1_000_000
    timing = LoopTiming(20 * ms, period_ms * ms, phase_ms * ms, 1 * ms, 400_000)
    plant = linearise(ARM, POSES[0])
    controller = pd(0.9, period_ms / 1e3, 0.05)
    delays_ns = (delays_ms[0] * ms, delays_ms[1] * ms)
    phi, gamma = plant.discretise(0.02)
    law = linearise_law(controller, plant, period_ms / 1e3)
    radius = spectral_radius(loop_matrix(phi, gamma, law, timing, *delays_ns))
    grown = closed_loop_radius(plant, controller, timing, delays_ns, patterns=1500)
    assert grown == pytest.approx(radius, rel=0.01)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("gain", [0.55, 0.6])
def test_the_delay_margin_is_where_the_spectral_radius_passes_one(
    pose: tuple[float, float, float, float], gain: float
) -> None:
    """At a step of 2 ms, the frequency domain and the eigenvalues agree within 2 % of the margin."""
    step_s, step_ns = 2e-3, 2_000_000
    plant = linearise(ARM, pose)
    phi, gamma = plant.discretise(step_s)
    law = linearise_law(pd(gain, step_s), plant, step_s)
    timing = LoopTiming(step_ns, step_ns, 0, step_ns // 2, 0)
    margin = margins(phi, gamma, law, timing, 1)
    assert margin.stable
    assert 0.12 < margin.delay_margin_s < 0.3
    added = round(margin.delay_margin_s / step_s)
    tolerance = 1
    assert tolerance <= 0.02 * added
    assert is_stable(phi, gamma, law, timing, command_delay_ns=(added - tolerance) * step_ns)
    assert not is_stable(phi, gamma, law, timing, command_delay_ns=(added + tolerance) * step_ns)


@pytest.mark.parametrize("gain", [0.6, 1.0])
def test_within_the_jitter_margin_no_sequence_of_delays_makes_the_loop_grow(gain: float) -> None:
    """Periodic sequences of delays up to the margin, random and adversarial: the product of their matrices decays."""
    step_s, step_ns = 2e-3, 2_000_000
    plant = linearise(ARM, POSES[0])
    phi, gamma = plant.discretise(step_s)
    law = linearise_law(pd(gain, step_s), plant, step_s)
    timing = LoopTiming(step_ns, step_ns, 0, step_ns // 2, 0)
    margin = margins(phi, gamma, law, timing, 1)
    most = int(margin.jitter_margin_s / step_s)
    assert most >= 1
    assert margin.jitter_margin_s <= margin.delay_margin_s
    held = len(law.a) + 8
    size = held + 4 * (most + 1)
    see = np.hstack([np.eye(4), np.zeros((4, 4))])

    def turn(delay: int) -> np.ndarray:
        """(x, ξ, last commands) after a step in which the command of `delay` steps ago acts, one step of loop first."""
        matrix = np.zeros((size, size))
        matrix[:8, :8] = phi
        place = held + 4 * delay
        matrix[:8, place : place + 4] = gamma
        matrix[8:held, :8], matrix[8:held, 8:held] = law.b @ see, law.a
        matrix[held : held + 4, :8], matrix[held : held + 4, 8:held] = law.d @ see, law.c
        matrix[held + 4 :, held:-4] = np.eye(4 * most)
        return matrix

    turns = [turn(delay) for delay in range(most + 1)]
    rng = np.random.default_rng(7)
    saw = list(range(most + 1))
    patterns = [saw, saw[::-1], [0, most], [0] * 5 + [most] * 5, *(rng.integers(0, most + 1, 12) for _ in range(60))]
    for pattern in patterns:
        product = np.eye(size)
        for delay in pattern:
            product = turns[int(delay)] @ product
        assert spectral_radius(product) < 1.0, list(pattern)


def test_a_loop_that_is_unstable_has_no_margins_and_says_so() -> None:
    plant = linearise(ARM, POSES[0])
    phi, gamma = plant.discretise(STEP_S)
    margin = margins(phi, gamma, linearise_law(pd(4.0), plant, STEP_S), LoopTiming(), 1)
    assert not margin.stable
    assert margin.radius > 1
    assert margin.delay_margin_s == 0
    assert margin.jitter_margin_s == 0


def test_margins_want_one_poll_a_step() -> None:
    plant = linearise(ARM, POSES[0])
    phi, gamma = plant.discretise(STEP_S)
    with pytest.raises(InputError, match="polls every 50 ms"):
        margins(phi, gamma, linearise_law(pd(), plant, STEP_S), LoopTiming(period_ns=50_000_000), 1)


def test_computed_torque_gives_every_joint_the_same_poles() -> None:
    plant = linearise(ARM, POSES[1])
    phi, gamma = plant.discretise(1e-3)
    law = linearise_law(ComputedTorque(ARM, 1e-3, 8.0, 1.0, filter_s=0.0), plant, 1e-3)
    timing, _ = loop_of(1_000_000, 1)
    slow = np.linalg.eigvals(loop_matrix(phi, gamma, law, timing))
    rates = np.log(np.abs(slow[np.abs(slow) > 0.9])) / 1e-3
    np.testing.assert_allclose(sorted(rates), [-8.0] * 8, rtol=0.15)


def test_prediction_keeps_the_loop_stable_where_plain_feedback_is_not() -> None:
    plant = linearise(ARM, POSES[0])
    phi, gamma = plant.discretise(STEP_S)
    timing, delay_ns = loop_of(20_000_000, 5)
    radius = {}
    for compensate in (True, False):
        law = linearise_law(PredictiveLqr(plant, STEP_S, 0.3, compensate=compensate), plant, STEP_S, 0.1)
        radius[compensate] = spectral_radius(loop_matrix(phi, gamma, law, timing, command_delay_ns=delay_ns))
    assert radius[True] < 0.95
    assert radius[False] > 1.0


def test_with_the_right_delay_the_predictor_leaves_the_undelayed_poles() -> None:
    """Smith's separation: poles of the feedback and of the observer, whatever the delay."""
    plant = linearise(ARM, POSES[0])
    phi, gamma = plant.discretise(STEP_S)
    found = []
    for steps in (1, 4):
        timing, delay_ns = loop_of(20_000_000, steps)
        law = linearise_law(PredictiveLqr(plant, STEP_S), plant, STEP_S, steps * STEP_S)
        found.append(spectral_radius(loop_matrix(phi, gamma, law, timing, command_delay_ns=delay_ns)))
    assert found[0] == pytest.approx(found[1], abs=1e-6)


@pytest.mark.parametrize("weight", [0.0, -1.0, math.nan])
def test_an_effort_that_costs_nothing_is_refused(weight: float) -> None:
    with pytest.raises(InputError, match="weight"):
        PredictiveLqr(linearise(ARM, POSES[0]), STEP_S, weight)
