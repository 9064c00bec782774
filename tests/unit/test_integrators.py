"""Unit tests of the integration methods: stability limits, orders, trajectories compared with scipy's DOP853."""

import numpy as np
import pytest

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.dynamics import ReducedDynamics, stage_views
from hilrig_sim.arm.integrators import EULER, RK4, RKF45, TABLEAUS, Tableau, reference_solution
from hilrig_sim.arm.model import ArmParameters, RigParameters, StepParameters
from hilrig_sim.arm.stability import base_substeps, check_stable, fastest_mode, largest_safe_step
from hilrig_sim.arm.stepping import FixedStep

PAPER = ArmParameters(masses=(1.0, 0.5, 0.5))
"""In the plane only the sum of m2 and m3 matters: 1 kg as in experiment (44)."""
EFFORT = np.array([1.2, -0.7, -4.5, 0.05])


def stepped(table: Tableau, step_s: float, seconds: float, arm: ArmParameters = PAPER) -> tuple[np.ndarray, np.ndarray]:
    """Return q(t), from rest, and the last embedded error."""
    position, velocity, error = (np.zeros((4, 1)) for _ in range(3))
    stepper = FixedStep(ReducedDynamics([arm]), table, step_s)
    for _ in range(round(seconds / step_s)):
        stepper.advance(position, velocity, EFFORT[:, np.newaxis], error)
    return position[:, 0], error[:, 0]


def exact(seconds: float, arm: ArmParameters = PAPER) -> np.ndarray:
    """Return q(t) by DOP853."""

    dynamics = ReducedDynamics([arm])
    state, rates, drive = np.zeros((5, 1)), np.zeros((5, 1)), np.zeros((4, 1))
    views = stage_views(state, rates)
    dynamics.drive(EFFORT[:, np.newaxis], drive)

    def derivative(_: float, y: np.ndarray) -> np.ndarray:
        state[:4, 0], state[4, 0] = y[4:], y[1]
        dynamics.rates(views, drive)
        return np.concatenate([y[4:], rates[:4, 0]])

    return reference_solution(derivative, np.zeros(8), np.array([0.0, seconds]))[:4, -1]


def test_stability_limits_equal_the_literature() -> None:
    assert EULER.negative_real_limit() == pytest.approx(2.0)
    assert RK4.negative_real_limit() == pytest.approx(2.785, abs=1e-3)
    assert RKF45.negative_real_limit() == pytest.approx(3.678, abs=1e-3)
    assert RKF45.negative_real_limit(RKF45.embedded) == pytest.approx(3.020, abs=1e-3)


def test_fastest_mode_of_the_arm_of_the_paper() -> None:
    assert fastest_mode(PAPER, theta2=0.0) == pytest.approx(129.5, abs=0.05)
    assert fastest_mode(PAPER) == pytest.approx(129.5, abs=0.05)
    assert fastest_mode(PAPER, payload=0.5) < fastest_mode(PAPER)


@pytest.mark.parametrize("table", TABLEAUS.values(), ids=lambda table: table.name)
def test_weights_are_consistent(table: Tableau) -> None:
    assert sum(table.b) == pytest.approx(1.0)
    assert sum(table.error_weights) == pytest.approx(0.0, abs=1e-15)
    assert [len(row) for row in table.a] == list(range(table.stages))


ORDERS = {"euler": 1, "rk4": 4, "rkf45": 5}


@pytest.mark.parametrize("table", TABLEAUS.values(), ids=lambda table: table.name)
def test_each_method_has_its_order(table: Tableau) -> None:
    # Little friction, so that accuracy and not stability limits the steps.
    arm = ArmParameters(friction=(0.3, 0.3, 1.0, 0.005))
    reference = exact(0.8, arm)
    errors = [np.abs(stepped(table, step_s, 0.8, arm)[0] - reference).max() for step_s in (0.02, 0.01)]
    assert np.log2(errors[0] / errors[1]) > ORDERS[table.name] - 0.5


def test_ten_seconds_agree_with_dop853() -> None:
    reference = exact(10.0)
    position, _ = stepped(RKF45, 0.0025, 10.0)
    np.testing.assert_allclose(position, reference, rtol=0, atol=1e-8)
    at_20_ms, _ = stepped(RKF45, 0.020, 10.0)
    np.testing.assert_allclose(at_20_ms, reference, rtol=0, atol=2e-4)


def test_embedded_error_estimates_the_true_error() -> None:
    _, coarse = stepped(RKF45, 0.02, 0.02)
    _, fine = stepped(RKF45, 0.01, 0.01)
    assert np.all(np.abs(coarse[:2]) > 8 * np.abs(fine[:2]))
    true = np.abs(stepped(RKF45, 0.02, 0.02)[0] - exact(0.02))
    assert np.all(np.abs(coarse[:2]) < 100 * true[:2] + 1e-6)
    assert np.all(np.abs(coarse[:2]) > 0.1 * true[:2])


@pytest.mark.parametrize(("table", "limit_s"), [(EULER, 0.01544), (RK4, 0.02150), (RKF45, 0.02839)])
def test_mode_grows_just_beyond_the_stability_limit(table: Tableau, limit_s: float) -> None:
    def speed_after(step_s: float) -> float:
        stepper = FixedStep(ReducedDynamics([PAPER]), table, step_s)
        position, velocity = np.zeros((4, 1)), np.zeros((4, 1))
        velocity[:2, 0] = 1e-9, -3e-9
        effort = np.array([[0.0], [0.0], [-0.5 * 9.81], [0.0]])
        for _ in range(300):
            stepper.advance(position, velocity, effort)
        return float(np.abs(velocity[:2]).max())

    assert speed_after(0.98 * limit_s) < 1e-9
    assert speed_after(1.02 * limit_s) > 1e-8


def test_unstable_step_is_rejected_with_the_fix() -> None:
    unstable = RigParameters(arm=PAPER, sim=StepParameters(step_ns=25_000_000, substeps=1))
    with pytest.raises(InputError, match=r"the largest safe step is 22\.7 ms \(20% margin\); set sim.substeps = 2"):
        check_stable(unstable)
    check_stable(RigParameters(arm=PAPER, sim=StepParameters(step_ns=25_000_000, substeps=2)))
    check_stable(RigParameters(arm=PAPER, sim=StepParameters(step_ns=20_000_000, substeps=1)))
    with pytest.raises(InputError, match="unstable with euler"):
        check_stable(RigParameters(arm=PAPER, sim=StepParameters(substeps=1, integrator="euler")))


def test_arm_without_friction_has_no_step_limit() -> None:
    assert largest_safe_step(ArmParameters(friction=(0.0, 0.0, 0.0, 0.0)), "rkf45") == float("inf")


def test_automatic_substeps_resolve_the_fastest_mode() -> None:
    for step_ns, expected in ((1_000_000, 1), (10_000_000, 1), (20_000_000, 2), (40_000_000, 4)):
        assert base_substeps(PAPER, StepParameters(step_ns=step_ns)) == expected


STIFF = ArmParameters(masses=(0.0001, 0.0001, 0.0001))
"""Its fastest mode is 10,000 times as fast."""


@pytest.mark.parametrize(
    ("sim", "text"),
    [
        (StepParameters(), r"set sim\.step_ms to 0\.0\d+ or less, or a heavier arm"),
        (StepParameters(substeps=1), r"largest safe step is 0\.00\d+ ms .* set sim\.step_ms to 0\.\d+ or less with"),
        (StepParameters(integrator="rk4"), r"needs an integrator with an error estimate \(rkf45\), and rk4 has none"),
    ],
    ids=["automatic", "fixed", "no estimate"],
)
def test_stiff_arm_is_rejected_with_the_remedy(sim: StepParameters, text: str) -> None:
    with pytest.raises(InputError, match=text):
        check_stable(RigParameters(arm=STIFF, sim=sim))
