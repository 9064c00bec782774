"""Unit tests of forward and inverse kinematics: solutions are correct and complete, failures have a cause."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilrig_runtime.errors import InputError
from hilrig_sim.arm import kinematics
from hilrig_sim.arm.kinematics import UnreachableError
from hilrig_sim.arm.model import ArmParameters

ARM = ArmParameters()


def inside(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


joints = st.tuples(*(inside(low, high) for low, high in zip(ARM.lower, ARM.upper, strict=True)))


def same_pose(one: np.ndarray, other: np.ndarray, tolerance: float = 1e-9) -> bool:
    turned = math.remainder(one[3] - other[3], 2 * math.pi)
    return bool(np.all(np.abs(one[:3] - other[:3]) <= tolerance) and abs(turned) <= tolerance)


@given(joints)
def test_every_solution_reaches_pose_within_limits(q: tuple[float, ...]) -> None:
    pose = kinematics.forward(ARM, q)
    for solution in kinematics.inverse(ARM, pose):
        assert np.all(solution >= ARM.lower)
        assert np.all(solution <= ARM.upper)
        assert same_pose(kinematics.forward(ARM, solution), pose)


@given(joints.filter(lambda q: abs(math.sin(q[1])) > 1e-3))
def test_solutions_include_the_original_joints(q: tuple[float, ...]) -> None:
    solutions = kinematics.inverse(ARM, kinematics.forward(ARM, q))
    assert np.abs(solutions - np.array(q)).max(axis=1).min() < 1e-6


@given(joints.filter(lambda q: abs(math.sin(q[1])) > 1e-3))
def test_solutions_include_both_elbows_and_all_theta4(q: tuple[float, ...]) -> None:
    pose = kinematics.forward(ARM, q)
    solutions = kinematics.inverse(ARM, pose)
    for theta2 in (q[1], -q[1]):
        bend = math.atan2(ARM.l3 * math.sin(theta2), ARM.l2 + ARM.l3 * math.cos(theta2))
        theta1 = math.remainder(math.atan2(pose[1], pose[0]) - bend, 2 * math.pi)
        theta4 = math.remainder(pose[3] - theta1 - theta2, 2 * math.pi)
        turns = [theta4 + k * 2 * math.pi for k in (-1, 0, 1)]
        margin = 1e-6
        if abs(theta1) < ARM.upper[0] - margin:
            for turn in turns:
                if abs(turn) < ARM.upper[3] - margin:
                    expected = (theta1, theta2, q[2], turn)
                    assert np.abs(solutions - expected).max(axis=1).min() < 1e-6


def test_solutions_are_unique() -> None:
    straight = kinematics.inverse(ARM, (ARM.l2 + ARM.l3, 0.0, 0.1, 0.0))
    assert len({tuple(np.round(solution, 9)) for solution in straight}) == len(straight)


@pytest.mark.parametrize(
    ("pose", "why"),
    [
        ((0.61, 0.0, 0.1, 0.0), "too far: 610.0 mm from joint 1, must be at most 600.0 mm"),
        ((0.05, 0.0, 0.1, 0.0), "in reach, but theta2 would be"),
        ((0.4, 0.0, 0.2, 0.0), "too high: must be -61.0 to 139.0 mm"),
        ((0.4, 0.0, -0.1, 0.0), "too low"),
        ((-0.55, 0.0, 0.1, 0.0), "theta1 would be"),
        ((float("nan"), 0.0, 0.1, 0.0), "must be finite"),
    ],
)
def test_unreachable_pose_has_a_cause(pose: tuple[float, ...], why: str) -> None:
    with pytest.raises(UnreachableError, match=why):
        kinematics.inverse(ARM, pose)
    assert issubclass(UnreachableError, InputError)


def test_pose_nearer_than_link_difference_is_too_near() -> None:
    arm = ArmParameters(l2=0.4, l3=0.2)
    with pytest.raises(UnreachableError, match=r"too near: 100\.0 mm from joint 1, must be at least 200\.0 mm"):
        kinematics.inverse(arm, (0.1, 0.0, 0.1, 0.0))


def test_limit_of_joint_4_is_reported() -> None:
    arm = ArmParameters(lower=(*ARM.lower[:3], -0.1), upper=(*ARM.upper[:3], 0.1))
    with pytest.raises(UnreachableError, match="theta4 would be"):
        kinematics.inverse(arm, (0.4, 0.0, 0.1, math.pi))


@given(joints)
def test_jacobian_is_the_derivative_of_the_pose(q: tuple[float, ...]) -> None:
    step = 1e-6
    columns = []
    for axis in np.eye(4):
        ahead, behind = (kinematics.forward(ARM, np.array(q) + sign * step * axis) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    np.testing.assert_allclose(kinematics.jacobian(ARM, q), np.array(columns).T, atol=1e-8)


@given(joints)
def test_determinant_is_zero_where_arm_is_straight(q: tuple[float, ...]) -> None:
    determinant = abs(np.linalg.det(kinematics.jacobian(ARM, q)))
    assert determinant == pytest.approx(float(kinematics.manipulability(ARM, q)), abs=1e-12)
    assert kinematics.is_singular(ARM, (q[0], 0.0, q[2], q[3]))
    assert not kinematics.is_singular(ARM, (q[0], 1.0, q[2], q[3]))


def test_many_poses_equal_single_poses() -> None:
    rng = np.random.default_rng(1)
    many = rng.uniform(np.array(ARM.lower)[:, None], np.array(ARM.upper)[:, None], (4, 50))
    poses, jacobians = kinematics.forward(ARM, many), kinematics.jacobian(ARM, many)
    for index in range(50):
        np.testing.assert_array_equal(poses[:, index], kinematics.forward(ARM, many[:, index]))
        np.testing.assert_array_equal(jacobians[:, :, index], kinematics.jacobian(ARM, many[:, index]))


def test_inverse_of_many_poses_equals_single_inverses() -> None:
    rng = np.random.default_rng(2)
    poses = np.stack([*rng.uniform(-0.65, 0.65, (2, 300)), rng.uniform(-0.08, 0.15, 300), rng.uniform(-7, 7, 300)])
    # Includes the limit of the workspace, where the arm is straight.
    poses[:, 0] = 0.6, 0.0, 0.1, 0.0
    many = kinematics.inverse_many(ARM, poses)
    found = 0
    for index in range(300):
        mine = many[~np.isnan(many[:, 0, index]), :, index]
        try:
            one_by_one = kinematics.inverse(ARM, poses[:, index])
        except UnreachableError:
            one_by_one = np.empty((0, 4))
        assert sorted(map(tuple, mine)) == sorted(map(tuple, one_by_one))
        found += len(mine)
    assert found > 300


def test_reach_is_a_ring_reduced_by_joint_limits() -> None:
    reach = kinematics.reach(ARM)
    assert reach.outer == pytest.approx(0.6)
    assert reach.inner == pytest.approx(2 * 0.3 * math.cos(math.radians(153 / 2)))
    assert (reach.bottom, reach.top) == pytest.approx((0.139 - 0.2, 0.139))
    ring = math.pi * (reach.outer**2 - reach.inner**2)
    assert 0.75 * ring < reach.area < ring
    assert kinematics.in_reach(ARM, 0.3, 0.2)
    assert not kinematics.in_reach(ARM, -0.55, 0.0)


@given(st.floats(-0.65, 0.65), st.floats(-0.65, 0.65))
def test_exactly_points_in_reach_have_a_solution(x: float, y: float) -> None:
    try:
        found = len(kinematics.inverse(ARM, (x, y, 0.1, 0.0))) > 0
    except UnreachableError:
        found = False
    on_an_edge = abs(math.hypot(x, y) - 0.6) < 1e-6
    assert on_an_edge or found == bool(kinematics.in_reach(ARM, x, y))
