"""Theory of the loop: linear model against the arm, loop matrix against direct construction, margins against trials."""

import math
from collections.abc import Iterable

import numpy as np
import pytest
from scipy.linalg import expm

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import ArmParameters, RigParameters, StepParameters
from hilrig_sim.plant.plant import Plant
from hilrig_study.controllers.control_laws import ComputedTorque, LawController, Measurement, Pid
from hilrig_study.controllers.lqr import PredictiveLqr
from hilrig_study.linear_model import LinearPlant, linearize
from hilrig_study.simulation.timing import LoopTiming
from hilrig_study.theory.margins import (
    STABLE_RADIUS,
    LinearLaw,
    constant_latency_timing,
    linearize_law,
    loop_matrix,
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
def test_linear_step_equals_derivative_of_arm_step(pose: tuple[float, float, float, float], integrator: str) -> None:
    rig = RigParameters(sim=StepParameters(substeps=2, integrator=integrator))
    plant = linearize(ARM, pose)
    phi, gamma = plant.discretize(STEP_S, integrator, substeps=2)
    small, found = 1e-5, np.empty((8, 12))
    for index in range(12):
        ends = []
        for sign in (1, -1):
            offset = np.zeros(12)
            offset[index] = sign * small
            arm = Plant([rig])
            arm.set_state(0, tuple(np.array(pose) + offset[:4]), tuple(offset[4:8]))
            arm.step((np.array(plant.holding) + offset[8:])[:, np.newaxis], np.zeros(1, dtype=np.bool_))
            ends.append(np.concatenate([arm.position[:, 0], arm.velocity[:, 0]]))
        found[:, index] = (ends[0] - ends[1]) / (2 * small)
    np.testing.assert_allclose(found, np.hstack([phi, gamma]), atol=2e-7)


def test_exact_discretization_equals_limit_of_substeps() -> None:
    plant = linearize(ARM, POSES[0])
    phi, gamma = plant.discretize(STEP_S)
    short_phi, short_gamma = plant.discretize(STEP_S, "rkf45", substeps=50)
    np.testing.assert_allclose(short_phi, phi, atol=1e-9)
    np.testing.assert_allclose(short_gamma, gamma, atol=1e-9)
    np.testing.assert_allclose(phi, expm(plant.a * STEP_S), atol=1e-12)


def test_only_joints_1_and_2_are_coupled() -> None:
    b = linearize(ARM, POSES[0]).b[4:]
    assert np.argwhere(b - np.diag(np.diag(b))).tolist() == [[0, 1], [1, 0]]


@pytest.mark.parametrize(
    ("pose", "expected"),
    [((0.0, 0.0, 0.0, 0.0), "d3"), ((9.0, 0.0, 0.1, 0.0), "theta1"), ((0.0, 0.1), "four joint")],
)
def test_rejects_pose_at_or_beyond_stop(pose: tuple[float, ...], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        linearize(ARM, pose)


def test_rejects_unknown_discretization() -> None:
    with pytest.raises(InputError, match="tustin"):
        linearize(ARM, POSES[0]).discretize(STEP_S, "tustin")


def test_linearized_pd_equals_analytic_response() -> None:
    """Analytic response of one joint: u = -Kp y - Kd v; v = βv + (1-β)/T (y - y_before)."""
    law = linearize_law(pd(), linearize(ARM, POSES[0]), STEP_S)
    beta = math.exp(-1)
    input_gain = (1 - beta) / STEP_S
    omega = np.array([3.0, 20.0, 90.0])
    z = np.exp(1j * omega * STEP_S)
    analytic = -KP[0] - KD[0] * input_gain * (1 - 1 / z) / (1 - beta / z)
    np.testing.assert_allclose(law.response(omega)[:, 0, 0], analytic, rtol=1e-7)
    np.testing.assert_allclose(law.response(omega)[:, 0, 1], 0, atol=1e-6)


def test_integral_has_anti_windup_limit() -> None:
    gain = 3.0
    controller = Pid(ARM, STEP_S, (0.0,) * 4, (0.0,) * 4, (gain,) * 4)
    controller.reset(1)

    def efforts(error: float, polls: int) -> np.ndarray:
        for _ in range(polls):
            measured = Measurement(np.zeros(1), np.zeros((4, 1)), np.full((4, 1), error), np.zeros(1))
            effort = controller.update(measured)
        return effort[:, 0] - np.array([0, 0, -ARM.masses[2] * 9.81, 0])

    assert efforts(0.5, 10) == pytest.approx([gain * 0.1, gain * 0.1, gain * 0.02, gain * 0.1])
    wound_up = [gain * 0.2, gain * 0.2, gain * 0.02, gain * 0.2]
    assert efforts(0.5, 1000) == pytest.approx(wound_up)
    assert efforts(-0.5, 1) == pytest.approx([effort - gain * 0.5 * STEP_S for effort in wound_up])


def test_integral_without_gain_adds_no_mode() -> None:
    plant = linearize(ARM, POSES[0])
    with_integral = Pid(ARM, STEP_S, KP, KD, (3.0, 0.0, 0.0, 0.0))
    assert len(linearize_law(with_integral, plant, STEP_S).a) == len(linearize_law(pd(), plant, STEP_S).a) + 1


def test_loop_matrix_equals_direct_construction() -> None:
    """One step of loop latency and a static control law: x(k+1) = Φ x(k) + Γ D y(k-1)."""
    plant = linearize(ARM, POSES[0])
    phi, gamma = plant.discretize(STEP_S)
    gain = -np.diag([5.0, 3.0, 10.0, 0.1])
    law = LinearLaw(np.zeros((0, 0)), np.zeros((0, 4)), np.zeros((4, 0)), gain, STEP_S, np.empty(0, dtype=np.intp))
    output = np.hstack([np.eye(4), np.zeros((4, 4))])
    analytic = np.block([[phi, gamma @ gain], [output, np.zeros((4, 4))]])
    timing, delay_ns = constant_latency_timing(20_000_000, 1)
    found = np.linalg.eigvals(loop_matrix(phi, gamma, law, timing, command_delay_ns=delay_ns))
    expected = np.linalg.eigvals(analytic)
    assert sorted(np.abs(found[np.abs(found) > 1e-6])) == pytest.approx(
        sorted(np.abs(expected[np.abs(expected) > 1e-6]))
    )


def test_state_and_command_delay_are_equivalent() -> None:
    plant = linearize(ARM, POSES[0])
    phi, gamma = plant.discretize(STEP_S)
    law = linearize_law(pd(0.4), plant, STEP_S)
    timing = LoopTiming()
    for delay_ns in (0, 20_000_000, 60_000_000):
        state_radius = spectral_radius(loop_matrix(phi, gamma, law, timing, state_delay_ns=delay_ns))
        command_radius = spectral_radius(loop_matrix(phi, gamma, law, timing, command_delay_ns=delay_ns))
        assert state_radius == pytest.approx(command_radius, abs=1e-9)


def closed_loop_radius(
    plant: LinearPlant, controller: LawController, timing: LoopTiming, delays_ns: tuple[int, int], patterns: int
) -> float:
    """Return the growth per pattern from an event-by-event simulation that does not use the code under test."""
    phi, gamma = plant.discretize(timing.step_ns * 1e-9)
    law = linearize_law(controller, plant, timing.period_ns * 1e-9)
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
def test_growth_of_poll_pattern_equals_spectral_radius(
    period_ms: int, phase_ms: int, delays_ms: tuple[int, int]
) -> None:
    ms = 1_000_000
    timing = LoopTiming(20 * ms, period_ms * ms, phase_ms * ms, 1 * ms, 400_000)
    plant = linearize(ARM, POSES[0])
    controller = pd(0.9, period_ms / 1e3, 0.05)
    delays_ns = (delays_ms[0] * ms, delays_ms[1] * ms)
    phi, gamma = plant.discretize(0.02)
    law = linearize_law(controller, plant, period_ms / 1e3)
    radius = spectral_radius(loop_matrix(phi, gamma, law, timing, *delays_ns))
    grown = closed_loop_radius(plant, controller, timing, delays_ns, patterns=1500)
    assert grown == pytest.approx(radius, rel=0.01)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("gain", [0.55, 0.6])
def test_delay_margin_equals_spectral_radius_limit(pose: tuple[float, float, float, float], gain: float) -> None:
    """At a step of 2 ms, the frequency domain and the eigenvalues agree within 2 % of the margin."""
    step_s, step_ns = 2e-3, 2_000_000
    plant = linearize(ARM, pose)
    phi, gamma = plant.discretize(step_s)
    law = linearize_law(pd(gain, step_s), plant, step_s)
    timing = LoopTiming(step_ns, step_ns, 0, step_ns // 2, 0)
    margin = margins(phi, gamma, law, timing, 1)
    assert margin.stable
    assert 0.12 < margin.delay_margin_s < 0.3
    added = round(margin.delay_margin_s / step_s)
    tolerance = 1
    assert tolerance <= 0.02 * added
    stable, unstable = (
        spectral_radius(loop_matrix(phi, gamma, law, timing, command_delay_ns=steps * step_ns))
        for steps in (added - tolerance, added + tolerance)
    )
    assert stable < STABLE_RADIUS <= unstable


@pytest.mark.parametrize("gain", [0.6, 1.0])
def test_loop_is_stable_within_jitter_margin(gain: float) -> None:
    """Periodic sequences of delays up to the margin, random and adversarial: the product of their matrices decays."""
    step_s, step_ns = 2e-3, 2_000_000
    plant = linearize(ARM, POSES[0])
    phi, gamma = plant.discretize(step_s)
    law = linearize_law(pd(gain, step_s), plant, step_s)
    timing = LoopTiming(step_ns, step_ns, 0, step_ns // 2, 0)
    margin = margins(phi, gamma, law, timing, 1)
    max_delay = int(margin.jitter_margin_s / step_s)
    assert max_delay >= 1
    assert margin.jitter_margin_s <= margin.delay_margin_s
    held = len(law.a) + 8
    size = held + 4 * (max_delay + 1)
    output = np.hstack([np.eye(4), np.zeros((4, 4))])

    def step_matrix(delay: int) -> np.ndarray:
        """Return the transition matrix of (x, ξ, last commands) for a command that is `delay` steps late."""
        matrix = np.zeros((size, size))
        matrix[:8, :8] = phi
        place = held + 4 * delay
        matrix[:8, place : place + 4] = gamma
        matrix[8:held, :8], matrix[8:held, 8:held] = law.b @ output, law.a
        matrix[held : held + 4, :8], matrix[held : held + 4, 8:held] = law.d @ output, law.c
        matrix[held + 4 :, held:-4] = np.eye(4 * max_delay)
        return matrix

    steps = [step_matrix(delay) for delay in range(max_delay + 1)]
    rng = np.random.default_rng(7)
    ascending = list(range(max_delay + 1))
    patterns: list[Iterable[int]] = [
        ascending,
        ascending[::-1],
        [0, max_delay],
        [0] * 5 + [max_delay] * 5,
        *(rng.integers(0, max_delay + 1, 12) for _ in range(60)),
    ]
    for pattern in patterns:
        product = np.eye(size)
        for delay in pattern:
            product = steps[int(delay)] @ product
        assert spectral_radius(product) < 1.0, list(pattern)


def test_unstable_loop_has_zero_margins() -> None:
    plant = linearize(ARM, POSES[0])
    phi, gamma = plant.discretize(STEP_S)
    margin = margins(phi, gamma, linearize_law(pd(4.0), plant, STEP_S), LoopTiming(), 1)
    assert not margin.stable
    assert margin.radius > 1
    assert margin.delay_margin_s == 0
    assert margin.jitter_margin_s == 0


def test_margins_require_one_poll_per_step() -> None:
    plant = linearize(ARM, POSES[0])
    phi, gamma = plant.discretize(STEP_S)
    with pytest.raises(InputError, match="got 50 ms"):
        margins(phi, gamma, linearize_law(pd(), plant, STEP_S), LoopTiming(period_ns=50_000_000), 1)


def test_computed_torque_gives_all_joints_equal_poles() -> None:
    plant = linearize(ARM, POSES[1])
    phi, gamma = plant.discretize(1e-3)
    law = linearize_law(ComputedTorque(ARM, 1e-3, 8.0, 1.0, filter_s=0.0), plant, 1e-3)
    timing, _ = constant_latency_timing(1_000_000, 1)
    slow = np.linalg.eigvals(loop_matrix(phi, gamma, law, timing))
    rates = np.log(np.abs(slow[np.abs(slow) > 0.9])) / 1e-3
    np.testing.assert_allclose(sorted(rates), [-8.0] * 8, rtol=0.15)


def test_prediction_stabilizes_delayed_loop() -> None:
    plant = linearize(ARM, POSES[0])
    phi, gamma = plant.discretize(STEP_S)
    timing, delay_ns = constant_latency_timing(20_000_000, 5)
    radius = {}
    for compensate in (True, False):
        law = linearize_law(PredictiveLqr(plant, STEP_S, 0.3, compensate=compensate), plant, STEP_S, 0.1)
        radius[compensate] = spectral_radius(loop_matrix(phi, gamma, law, timing, command_delay_ns=delay_ns))
    assert radius[True] < 0.95
    assert radius[False] > 1.0


def test_predictor_keeps_poles_of_undelayed_loop() -> None:
    """Separation principle: the poles are those of feedback and observer, independent of the delay."""
    plant = linearize(ARM, POSES[0])
    phi, gamma = plant.discretize(STEP_S)
    found = []
    for steps in (1, 4):
        timing, delay_ns = constant_latency_timing(20_000_000, steps)
        law = linearize_law(PredictiveLqr(plant, STEP_S), plant, STEP_S, steps * STEP_S)
        found.append(spectral_radius(loop_matrix(phi, gamma, law, timing, command_delay_ns=delay_ns)))
    assert found[0] == pytest.approx(found[1], abs=1e-6)


@pytest.mark.parametrize("weight", [0.0, -1.0, math.nan])
def test_rejects_effort_weight_that_is_not_positive(weight: float) -> None:
    with pytest.raises(InputError, match="weight"):
        PredictiveLqr(linearize(ARM, POSES[0]), STEP_S, weight)
