"""The drawn geometry agrees with the kinematics."""

from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilrig_replay.geometry.quaternion import multiply, rotate
from hilrig_replay.geometry.scene import parameters_of, parse_arm, tool_positions, workspace_outline
from hilrig_replay.geometry.urdf_geometry import fixed_joints, visual_shapes
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.kinematics import in_reach
from hilrig_sim.arm.model import ArmParameters, RigParameters
from hilrig_sim.arm.urdf import urdf

SEED = 7


class UntestedElement(ElementTree.Element):
    """An element that fails when its truth value is used: deprecated in Python, with a warning since 3.12."""

    def __bool__(self) -> bool:
        raise AssertionError(f"the truth value of <{self.tag}> was used")


def random_joints(arm: ArmParameters, count: int) -> np.ndarray:
    return np.random.default_rng(SEED).uniform(arm.lower, arm.upper, (count, 4))


def test_joint_chain_ends_at_the_tool_tip() -> None:
    parameters = RigParameters()
    geometry = parse_arm(urdf(parameters))
    q = random_joints(parameters.arm, 200)
    position = np.zeros((len(q), 3))
    orientation = np.tile([0.0, 0.0, 0.0, 1.0], (len(q), 1))
    assert geometry.joints[0].parent == geometry.root
    for joint, above in zip(geometry.joints[1:], geometry.joints, strict=False):
        assert joint.parent == above.child
    for joint, values in zip(geometry.joints, q.T, strict=True):
        translation, rotation = joint.transforms(values)
        position += Rotation.from_quat(orientation).apply(translation)
        orientation = multiply(orientation, rotation)
    assert np.allclose(position, tool_positions(parameters.arm, q), atol=1e-12)
    yaw = Rotation.from_quat(orientation).as_euler("ZYX")[:, 0]
    difference = np.angle(np.exp(1j * (yaw - q[:, [0, 1, 3]].sum(axis=1))))
    assert np.allclose(difference, 0, atol=1e-9)


def test_quaternion_operations_match_scipy() -> None:
    random = np.random.default_rng(SEED)
    left, right = Rotation.random(50, rng=random), Rotation.random(50, rng=random)
    product = Rotation.from_quat(multiply(left.as_quat(), right.as_quat()))
    assert (product * (left * right).inv()).magnitude().max() < 1e-12
    vector = random.normal(size=3)
    for quaternion, turn in zip(left.as_quat(), left, strict=True):
        assert np.allclose(rotate(quaternion, vector), turn.apply(vector))
        assert np.allclose(rotate(quaternion, np.stack((vector, -vector))), turn.apply(np.stack((vector, -vector))))


def test_joint_origin_rotation_is_applied() -> None:
    robot = ElementTree.fromstring(urdf(RigParameters()))
    origin = robot.find("joint[@name='theta2']/origin")
    assert origin is not None
    origin.set("rpy", "0.3 -0.2 0.5")
    joint = parse_arm(ElementTree.tostring(robot, encoding="unicode")).joints[1]
    assert np.allclose(joint.rotation, Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_quat())


def test_element_truth_values_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    text = urdf(RigParameters())
    geometry, shapes, fixed = parse_arm(text), visual_shapes(text), fixed_joints(text)

    def parsed(text: str) -> ElementTree.Element:
        builder = ElementTree.TreeBuilder(element_factory=UntestedElement)
        return ElementTree.XML(text, parser=ElementTree.XMLParser(target=builder))

    monkeypatch.setattr(ElementTree, "fromstring", parsed)
    assert parse_arm(text).primitives == geometry.primitives != ()
    assert len(visual_shapes(text)) == len(shapes) > 0
    assert len(fixed_joints(text)) == len(fixed)


def test_visual_without_shape_is_ignored() -> None:
    robot = ElementTree.fromstring(urdf(RigParameters()))
    primitives = parse_arm(ElementTree.tostring(robot, encoding="unicode")).primitives
    link = robot.find("link[visual]")
    assert link is not None
    ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(ElementTree.SubElement(link, "visual"), "geometry")
    assert parse_arm(ElementTree.tostring(robot, encoding="unicode")).primitives == primitives


def test_workspace_outline_encloses_the_workspace() -> None:
    arm = ArmParameters()
    lines = workspace_outline(arm, height=-0.05)
    points = np.concatenate(lines)
    assert np.allclose(points[:, 2], -0.05)
    assert np.hypot(points[:, 0], points[:, 1]).max() == pytest.approx(arm.l2 + arm.l3)
    # Points just inside of the outer boundary and just outside of the inner boundary are reachable.
    for line, scale in zip(lines, (0.9999, 1.0001, 1.0001), strict=True):
        assert in_reach(arm, line[:, 0] * scale, line[:, 1] * scale).mean() > 0.9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no xml", "the arm's URDF is invalid"),
        ("<robot name='a'><link name='base'/></robot>", "has no joint 'theta1'; it has none"),
        ("<robot name='a'><joint name='slide' type='prismatic'/></robot>", "has no joint 'theta1'; it has slide"),
    ],
)
def test_unsuitable_urdf_is_rejected(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_arm(text)


def test_parameters_round_trip() -> None:
    parameters = RigParameters(arm=ArmParameters(l2=0.25))
    assert parameters_of(parameters.to_json()) == parameters
    assert parameters_of("") == RigParameters()
    with pytest.raises(InputError, match="invalid rig parameters"):
        parameters_of("{}")
