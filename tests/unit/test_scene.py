"""What is drawn stands where the kinematics say."""

from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilrig_replay.export.urdf_geometry import fixed_joints, solids_of
from hilrig_replay.rerun_view.scene import multiply, parameters_of, reach_outline, read_arm, rotate, tips
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.kinematics import in_reach
from hilrig_sim.arm.model import ArmParameters, RigParameters
from hilrig_sim.arm.urdf import urdf

SEED = 7


class UntestedElement(ElementTree.Element):
    """An element whose truth value must not be asked for: Python deprecates it, from 3.12 on with a warning."""

    def __bool__(self) -> bool:
        raise AssertionError(f"the truth value of <{self.tag}> was asked for")


def random_joints(arm: ArmParameters, count: int) -> np.ndarray:
    return np.random.default_rng(SEED).uniform(arm.lower, arm.upper, (count, 4))


def test_the_chain_of_joints_ends_at_the_tools_tip() -> None:
    parameters = RigParameters()
    picture = read_arm(urdf(parameters))
    q = random_joints(parameters.arm, 200)
    position = np.zeros((len(q), 3))
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (len(q), 1))
    assert picture.joints[0].parent == picture.root
    for joint, above in zip(picture.joints[1:], picture.joints, strict=False):
        assert joint.parent == above.child
    for joint, values in zip(picture.joints, q.T, strict=True):
        translation, rotation = joint.transforms(values)
        position += Rotation.from_quat(turned).apply(translation)
        turned = multiply(turned, rotation)
    assert np.allclose(position, tips(parameters.arm, q), atol=1e-12)
    yaw = Rotation.from_quat(turned).as_euler("ZYX")[:, 0]
    difference = np.angle(np.exp(1j * (yaw - q[:, [0, 1, 3]].sum(axis=1))))
    assert np.allclose(difference, 0, atol=1e-9)


def test_quaternions_turn_as_an_independent_library_does() -> None:
    random = np.random.default_rng(SEED)
    left, right = Rotation.random(50, rng=random), Rotation.random(50, rng=random)
    product = Rotation.from_quat(multiply(left.as_quat(), right.as_quat()))
    assert (product * (left * right).inv()).magnitude().max() < 1e-12
    vector = random.normal(size=3)
    for quaternion, turn in zip(left.as_quat(), left, strict=True):
        assert np.allclose(rotate(quaternion, vector), turn.apply(vector))


def test_a_joints_own_frame_is_respected() -> None:
    robot = ElementTree.fromstring(urdf(RigParameters()))
    origin = robot.find("joint[@name='theta2']/origin")
    assert origin is not None
    origin.set("rpy", "0.3 -0.2 0.5")
    joint = read_arm(ElementTree.tostring(robot, encoding="unicode")).joints[1]
    assert np.allclose(joint.rotation, Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_quat())


def test_no_elements_truth_value_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    text = urdf(RigParameters())
    picture, solids, fixed = read_arm(text), solids_of(text), fixed_joints(text)

    def parsed(text: str) -> ElementTree.Element:
        builder = ElementTree.TreeBuilder(element_factory=UntestedElement)
        return ElementTree.XML(text, parser=ElementTree.XMLParser(target=builder))

    monkeypatch.setattr(ElementTree, "fromstring", parsed)
    assert read_arm(text).solids == picture.solids != ()
    assert len(solids_of(text)) == len(solids) > 0
    assert len(fixed_joints(text)) == len(fixed)


def test_a_visual_without_a_shape_is_no_solid() -> None:
    robot = ElementTree.fromstring(urdf(RigParameters()))
    solids = read_arm(ElementTree.tostring(robot, encoding="unicode")).solids
    link = robot.find("link[visual]")
    assert link is not None
    ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(ElementTree.SubElement(link, "visual"), "geometry")
    assert read_arm(ElementTree.tostring(robot, encoding="unicode")).solids == solids


def test_the_outline_encloses_what_the_tool_reaches() -> None:
    arm = ArmParameters()
    lines = reach_outline(arm, height=-0.05)
    points = np.concatenate(lines)
    assert np.allclose(points[:, 2], -0.05)
    assert np.hypot(points[:, 0], points[:, 1]).max() == pytest.approx(arm.l2 + arm.l3)
    # A hair inside of the outer edge, and outside of the inner one, the arm reaches.
    for line, scale in zip(lines, (0.9999, 1.0001, 1.0001), strict=True):
        assert in_reach(arm, line[:, 0] * scale, line[:, 1] * scale).mean() > 0.9


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("no xml", "the arm's URDF is not understood"),
        ("<robot name='a'><link name='base'/></robot>", "has no joint 'theta1'; it has none"),
        ("<robot name='a'><joint name='slide' type='prismatic'/></robot>", "has no joint 'theta1'; it has slide"),
    ],
)
def test_a_urdf_of_something_else_is_said(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_arm(text)


def test_parameters_come_back_as_they_were() -> None:
    parameters = RigParameters(arm=ArmParameters(l2=0.25))
    assert parameters_of(parameters.to_json()) == parameters
    assert parameters_of("") == RigParameters()
    with pytest.raises(InputError, match="invalid rig parameters"):
        parameters_of("{}")
