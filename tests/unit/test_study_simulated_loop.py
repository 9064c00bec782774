"""Simulated loop: timing rules, dynamics against theory, reproducibility, expected cost."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hilrig_modbus_edge.impairment.model import Impairment
from hilrig_modbus_edge.registers import codec
from hilrig_runtime.config.impairment import LinkImpairment
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import ArmParameters, RigParameters
from hilrig_study.controllers.control_laws import ComputedTorque, LawController, Measurement, Pid
from hilrig_study.controllers.lqr import PredictiveLqr
from hilrig_study.linear_model import Floats, linearize
from hilrig_study.simulation import quantization
from hilrig_study.simulation.plants import ArmPlant, LinearArms
from hilrig_study.simulation.simulated_loop import Outcome, Scenario, simulate
from hilrig_study.simulation.timing import NO_POLL, LoopTiming, Timeline, poll_count, timeline
from hilrig_study.theory.expected_cost import (
    age_chain,
    expected_cost,
    mean_square_radius,
    transition_matrices,
)
from hilrig_study.theory.margins import STABLE_RADIUS, LinearLaw, linearize_law, loop_matrix, spectral_radius

ARM = ArmParameters()
MS = 1_000_000
POSES = ((0.3, 0.8, 0.08, 0.2), (-0.6, 1.6, 0.05, -0.4), (0.9, -0.4, 0.12, 1.0))
KP, KD = np.array([23.0, 14.0, 30.0, 0.25]), np.array([4.6, 2.9, 2.0, 0.03])
OFFSET = (0.02, -0.02, 0.002, 0.02)


def pd(gain: float = 1.0, period_s: float = 0.02) -> Pid:
    return Pid(ARM, period_s, KP * gain, KD * gain, filter_s=0.02)


def run(
    controller: LawController,
    lines: list[Timeline],
    *,
    pose: tuple[float, float, float, float] = POSES[0],
    ticks: int = 500,
    linear: bool = False,
    quantize: bool = True,
    limit: float = 0.5,
) -> Outcome:
    scenario = Scenario(pose, OFFSET, limit=(limit, limit, limit, limit))
    plant_model = linearize(ARM, pose)
    phi, gamma = plant_model.discretize(lines[0].step_ns * 1e-9)
    plant = (
        LinearArms(plant_model, phi, gamma, scenario.start, len(lines))
        if linear
        else ArmPlant(RigParameters(), scenario.start, pose, len(lines))
    )
    return simulate(plant, controller, scenario, lines, ticks=ticks, holding=plant_model.holding, quantize=quantize)


# -- registers ---------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(-400, 400), min_size=4, max_size=4))
def test_position_quantization_equals_register_codec(values: list[float]) -> None:
    words, _ = codec.words_of_position(values)
    assert quantization.position(np.array(values)[:, np.newaxis])[:, 0].tolist() == list(codec.position_of(words))


@given(st.lists(st.floats(-40, 40), min_size=4, max_size=4))
def test_effort_quantization_equals_register_codec(values: list[float]) -> None:
    words, _ = codec.words_of_effort(values)
    assert quantization.effort(np.array(values)[:, np.newaxis])[:, 0].tolist() == list(codec.effort_of(words))


# -- timing ------------------------------------------------------------------------------------------------------------


@settings(max_examples=150)
@given(
    period_ms=st.integers(3, 60),
    phase_us=st.integers(0, 40_000),
    compute_us=st.integers(0, 2_900),
    delays_us=st.tuples(st.integers(0, 120_000), st.integers(0, 120_000)),
)
def test_constant_delays_match_pattern_of_theory(
    period_ms: int, phase_us: int, compute_us: int, delays_us: tuple[int, int]
) -> None:
    timing = LoopTiming(20 * MS, period_ms * MS, phase_us * 1000, compute_us * 1000, 400_000)
    state_ns, command_ns = (us * 1000 for us in delays_us)
    line = timeline(timing, 60, state_ns, command_ns)
    for poll, basis in enumerate(line.basis.tolist()):
        assert basis == max(-1, min(timing.basis(poll, state_ns), 59))
    writing = [poll for poll, basis in enumerate(line.basis.tolist()) if basis >= 0]
    for tick, poll in enumerate(line.in_force.tolist()):
        arrived = [p for p in writing if timing.acts(p, command_ns) <= tick]
        assert poll == (max(arrived) if arrived else NO_POLL)


@settings(max_examples=100)
@given(seed=st.integers(0, 10_000), jitter_ms=st.integers(1, 120), loss=st.floats(0, 0.5))
def test_newest_command_acts_under_jitter_and_loss(seed: int, jitter_ms: int, loss: float) -> None:
    timing, ticks = LoopTiming(), 80
    link = LinkImpairment.model_validate({"delay": f"uniform:0,{jitter_ms}", "loss": f"bernoulli:{loss}"})
    states, commands = Impairment(link, seed), Impairment(link, seed + 1)
    (state_ns, state_lost), (command_ns, command_lost) = states.draw(ticks), commands.draw(poll_count(timing, ticks))
    line = timeline(timing, ticks, state_ns, command_ns, state_lost, command_lost)
    assert (np.diff(line.basis) >= 0).all()
    assert (np.diff(line.in_force) >= 0).all()
    for tick, poll in enumerate(line.in_force.tolist()):
        arrived = [
            p
            for p in range(len(line.poll_ns))
            if not command_lost[p]
            and line.basis[p] >= 0
            and line.poll_ns[p] + timing.compute_ns + timing.transport_ns + command_ns[p] <= tick * timing.step_ns
        ]
        assert poll == (max(arrived) if arrived else NO_POLL)
    new = np.flatnonzero(line.latency)
    np.testing.assert_array_equal(line.latency[new], new - line.basis[line.in_force[new]])
    assert (line.samples_ns >= timing.step_ns).all()


def test_arrival_exactly_at_deadline_is_in_time() -> None:
    # The state is released at the time of the read, and the command arrives at the time of its tick.
    line = timeline(LoopTiming(20 * MS, 20 * MS, 5 * MS, MS, 0), 10, 5 * MS, 14 * MS)
    assert line.basis.tolist() == list(range(10))
    assert line.in_force.tolist() == [NO_POLL, *range(9)]
    assert line.latency.tolist() == [0] + [1] * 9


def test_state_repeats_latest_loop_latency() -> None:
    line = timeline(LoopTiming(20 * MS, 40 * MS, 5 * MS, MS, 0), 10)
    assert line.basis.tolist() == [0, 2, 4, 6, 8]
    assert line.latency.tolist() == [0, 1, 0, 1, 0, 1, 0, 1, 0, 1]
    assert line.shown_latency.tolist() == [0, 1, 1, 1, 1]


def test_rejects_negative_delay() -> None:
    with pytest.raises(InputError, match="must be ≥ 0 ns, got -1"):
        timeline(LoopTiming(), 10, command_delay_ns=-1)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"period_ns": 0}, "period_ns"),
        ({"phase_ns": -1}, "phase_ns"),
        ({"compute_ns": 30 * MS}, "poll period must be longer"),
    ],
)
def test_rejects_invalid_timing(arguments: dict[str, int], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        LoopTiming(**arguments)


def test_loop_latency_is_rounded_up_to_steps() -> None:
    timing = LoopTiming()
    assert set(timeline(timing, 50).samples_ns.tolist()) == {20 * MS}
    assert set(timeline(timing, 50, command_delay_ns=13 * MS).samples_ns.tolist()) == {20 * MS}
    assert set(timeline(timing, 50, command_delay_ns=14 * MS).samples_ns.tolist()) == {40 * MS}
    assert set(timeline(timing, 50, state_delay_ns=5 * MS).samples_ns.tolist()) == {40 * MS}


# -- dynamics ----------------------------------------------------------------------------------------------------------


def jittered(seed: int, ticks: int = 500, high_ms: int = 60) -> Timeline:
    link = LinkImpairment.model_validate(f"uniform:0,{high_ms}")
    delay_ns, _ = Impairment(link, seed).draw(poll_count(LoopTiming(), ticks))
    return timeline(LoopTiming(), ticks, command_delay_ns=delay_ns)


@pytest.mark.parametrize(
    "make", [pd, lambda: ComputedTorque(ARM, 0.02, 6.0), lambda: PredictiveLqr(linearize(ARM, POSES[0]), 0.02)]
)
def test_run_is_bit_identical_alone_and_in_batch(make: object) -> None:
    lines = [jittered(seed, 150) for seed in range(9)]
    together = run(make(), lines, ticks=150)  # type: ignore[operator]
    for number in (0, 4, 8):
        alone = run(make(), [lines[number]], ticks=150)  # type: ignore[operator]
        np.testing.assert_array_equal(together.positions[:, :, number], alone.positions[:, :, 0])
        assert together.cost[number] == alone.cost[0]


def test_runs_of_different_phase_equal_single_runs() -> None:
    lines = [timeline(LoopTiming(period_ns=15 * MS, phase_ns=phase * MS), 200) for phase in (0, 4, 13, 22)]
    together = run(pd(0.5, 0.015), lines, ticks=200)
    for number, line in enumerate(lines):
        alone = run(pd(0.5, 0.015), [line], ticks=200)
        np.testing.assert_array_equal(together.positions[:, :, number], alone.positions[:, :, 0])


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_run_without_poll_reads_initialized_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(np, "empty", lambda shape, dtype=np.float64: np.full(shape, np.finfo(np.float64).max, dtype))
    lines = [timeline(LoopTiming(period_ns=15 * MS, phase_ns=phase * MS), 200) for phase in (0, 13)]
    assert run(pd(0.5, 0.015), lines, ticks=200, linear=True).settled.all()


def is_stable(phi: Floats, gamma: Floats, law: LinearLaw, timing: LoopTiming, command_delay_ns: int) -> bool:
    return spectral_radius(loop_matrix(phi, gamma, law, timing, 0, command_delay_ns)) < STABLE_RADIUS


def ages_by_tick(line: Timeline) -> NDArray[np.int64]:
    """Return the age of the acting command at every tick, steps; 0: no command acts."""
    ages = np.arange(len(line.in_force)) - line.basis[np.maximum(line.in_force, 0)]
    return np.where(line.in_force != NO_POLL, ages, 0)


def growth(outcome: Outcome, number: int, pose: tuple[float, float, float, float]) -> float:
    """Return the ratio of the largest distance from the pose in the last third and in the middle third."""
    distance = np.linalg.norm((outcome.positions[:, :, number] - np.array(pose)) / [1, 1, 0.1, 1], axis=1)
    if distance[-1] < 1e-9:
        return 0.0
    third = len(distance) // 3
    return float(distance[-third:].max() / distance[-2 * third : -third].max())


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("gain", [0.6, 1.3])
def test_simulation_and_theory_agree_on_stable_delays(pose: tuple[float, float, float, float], gain: float) -> None:
    """The same constant delays from 0 to 120 ms are stable in simulation and theory."""
    plant_model = linearize(ARM, pose)
    phi, gamma = plant_model.discretize(0.02)
    law = linearize_law(pd(gain), plant_model, 0.02)
    timing = LoopTiming()
    delays_ms = range(0, 121)
    steps = [timing.latency_steps(0, ms * MS)[0] for ms in delays_ms]
    theory = {n: is_stable(phi, gamma, law, timing, ms * MS) for ms, n in zip(delays_ms, steps, strict=True)}
    lines = [timeline(timing, 3000, command_delay_ns=ms * MS) for ms in delays_ms]
    outcome = run(pd(gain), lines, pose=pose, ticks=3000, linear=True, quantize=False, limit=1e9)
    simulated = [
        math.isnan(outcome.failed_s[number]) and growth(outcome, number, pose) < 1 for number in range(len(lines))
    ]
    boundary = next((ms for ms in delays_ms if not simulated[ms]), 121)
    expected = next((ms for ms in delays_ms if not theory[steps[ms]]), 121)
    assert abs(boundary - expected) <= 1
    assert simulated == [theory[n] for n in steps]


def test_nonlinear_arm_settles_if_theory_is_stable() -> None:
    """The arm with stops, registers and quadratic terms settles exactly for the delays that theory calls stable."""
    plant_model = linearize(ARM, POSES[0])
    phi, gamma = plant_model.discretize(0.02, "rkf45")
    timing = LoopTiming()
    for gain in (0.5, 0.8, 1.1):
        law = linearize_law(pd(gain), plant_model, 0.02)
        delays_ms = [0, 10, 20, 40, 60, 80, 100, 150, 200, 300]
        outcome = run(pd(gain), [timeline(timing, 1500, 0, ms * MS) for ms in delays_ms], ticks=1500)
        expected = [is_stable(phi, gamma, law, timing, ms * MS) for ms in delays_ms]
        assert outcome.settled.tolist() == expected


def test_failed_run_does_not_affect_other_runs() -> None:
    plant_model = linearize(ARM, POSES[0])
    both = simulate(
        ArmPlant(RigParameters(), Scenario(POSES[0], OFFSET).start, POSES[0], 2),
        pd(1.3),
        Scenario(POSES[0], OFFSET, limit=(0.1, 0.1, 0.1, 0.1)),
        [timeline(LoopTiming(), 400, 0, 200 * MS), timeline(LoopTiming(), 400, 0, 0)],
        ticks=400,
        holding=plant_model.holding,
    )
    assert np.isfinite(both.failed_s[0])
    assert both.cost[0] == np.inf
    assert not both.settled[0]
    low = run(pd(0.5), [timeline(LoopTiming(), 400)], ticks=400)
    assert low.settled[0]
    assert np.isnan(low.failed_s[0])


class NanAfterOneSecond(Pid):
    """PD that returns NaN after 1 s."""

    def law(self, memory: np.ndarray, measured: Measurement) -> tuple[np.ndarray, np.ndarray]:
        effort, kept = super().law(memory, measured)
        return np.where(measured.time_s > 1.0, np.nan, effort), kept


def test_reports_time_of_invalid_effort() -> None:
    with pytest.raises(InputError, match=r"not finite at t = 1\.0"):
        run(NanAfterOneSecond(ARM, 0.02, KP, KD), [timeline(LoopTiming(), 100)], ticks=100)


# -- expected cost -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_ms", [0, 30, 55])
def test_expected_cost_equals_cost_at_constant_latency(delay_ms: int) -> None:
    plant_model = linearize(ARM, POSES[0])
    phi, gamma = plant_model.discretize(0.02)
    controller = pd(0.7)
    law = linearize_law(controller, plant_model, 0.02)
    line = timeline(LoopTiming(), 300, command_delay_ns=delay_ms * MS)
    expected = expected_cost(plant_model, phi, gamma, controller, law, age_chain([ages_by_tick(line)]), OFFSET, 300)
    outcome = run(pd(0.7), [line], ticks=300, linear=True, quantize=False, limit=math.inf)
    assert expected == pytest.approx(outcome.cost[0], rel=1e-6)


def test_expected_cost_equals_mean_cost_under_jitter() -> None:
    plant_model = linearize(ARM, POSES[0])
    phi, gamma = plant_model.discretize(0.02)
    controller = pd(0.6)
    law = linearize_law(controller, plant_model, 0.02)
    lines = [jittered(seed, 300, 33) for seed in range(400)]
    chain = age_chain([ages_by_tick(line) for line in lines])
    expected = expected_cost(plant_model, phi, gamma, controller, law, chain, OFFSET, 300)
    outcome = run(pd(0.6), lines, ticks=300, linear=True, quantize=False, limit=math.inf)
    assert expected == pytest.approx(float(outcome.cost.mean()), rel=0.02)


def test_mean_square_radius_separates_stable_and_unstable() -> None:
    plant_model = linearize(ARM, POSES[0])
    phi, gamma = plant_model.discretize(0.02)
    chain = age_chain([ages_by_tick(jittered(seed, 300, 60)) for seed in range(50)])
    radius = {}
    for gain in (0.3, 1.5):
        law = linearize_law(pd(gain), plant_model, 0.02)
        radius[gain] = mean_square_radius(chain, transition_matrices(phi, gamma, law, chain.max_age))
    assert radius[0.3] < 1.0 < radius[1.5]


def test_mean_square_radius_is_squared_spectral_radius() -> None:
    plant_model = linearize(ARM, POSES[0])
    phi, gamma = plant_model.discretize(0.02)
    law = linearize_law(pd(1.0), plant_model, 0.02)
    chain = age_chain([ages_by_tick(timeline(LoopTiming(), 300, command_delay_ns=30 * MS))])
    matrices = transition_matrices(phi, gamma, law, chain.max_age)
    radius = float(np.abs(np.linalg.eigvals(matrices[-1])).max())
    assert mean_square_radius(chain, matrices) == pytest.approx(radius**2, rel=1e-3)


def test_mean_square_radius_without_feedback_is_one() -> None:
    plant_model = linearize(ARM, POSES[0])
    phi, gamma = plant_model.discretize(0.02)
    chain = age_chain([ages_by_tick(timeline(LoopTiming(), 300))])
    matrices = transition_matrices(phi, gamma, linearize_law(pd(0.0), plant_model, 0.02), chain.max_age)
    assert mean_square_radius(chain, matrices) == pytest.approx(1.0, abs=1e-6)


def test_rejects_runs_without_acting_command() -> None:
    with pytest.raises(InputError, match="no command acts"):
        age_chain([np.zeros(10, dtype=np.int64)])
