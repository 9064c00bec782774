"""What is drawn of a rig in three dimensions, as plain geometry: no viewer in here.

World frame as everywhere: x forwards, y to the left, z up from the arm's base plane, metres and radians.
"""

from dataclasses import dataclass
from typing import Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError
from hilrig_sim.arm.kinematics import forward
from hilrig_sim.arm.model import JOINT_NAMES, ArmParameters, RigParameters

Floats = NDArray[np.float64]

_ARC_STEP_RAD: Final = np.radians(2.0)


@dataclass(frozen=True, slots=True)
class JointFrames:
    """A joint of the URDF, ready to be moved by arrays of joint values."""

    name: str
    parent: str
    """Link above."""
    child: str
    """Link that moves."""
    prismatic: bool
    translation: Floats
    """Of the joint's frame in its parent's, m, (3,)."""
    rotation: Floats
    """The same as a quaternion x, y, z, w, (4,)."""
    axis: Floats
    """In the joint's frame, (3,)."""

    def transforms(self, values: Floats) -> tuple[Floats, Floats]:
        """Child's frame in its parent's for joint values, rad or m, (n,): translations (n, 3), quaternions (n, 4)."""
        count = len(values)
        if self.prismatic:
            along = rotate(self.rotation, self.axis)
            return self.translation + values[:, None] * along, np.tile(self.rotation, (count, 1))
        half = values / 2
        turn = np.concatenate((np.sin(half)[:, None] * self.axis, np.cos(half)[:, None]), axis=1)
        return np.tile(self.translation, (count, 1)), multiply(self.rotation[None, :], turn)


@dataclass(frozen=True, slots=True)
class ArmPicture:
    """The arm as its URDF describes it."""

    urdf: str
    root: str
    """Link that stands in the world's origin."""
    joints: tuple[JointFrames, ...]
    """The four that move, in joint order."""
    solids: tuple[tuple[str, int, str], ...]
    """(link, number of its visual, shape: box, cylinder or sphere) of each primitive."""


def read_arm(urdf: str) -> ArmPicture:
    """Understand a URDF whose moving joints have the arm's names, `hilrig_sim.arm.model.JOINT_NAMES`.

    Raises:
        InputError: it is no such description.
    """
    try:
        robot = ElementTree.fromstring(urdf)
        joints = {joint.attrib["name"]: joint for joint in robot.iter("joint") if joint.attrib.get("type") != "fixed"}
        missing = [name for name in JOINT_NAMES if name not in joints]
        if missing:
            raise InputError(f"the arm's URDF has no joint {missing[0]!r}; it has {', '.join(joints) or 'none'}")
        children = {_link(joint, "child") for joint in robot.iter("joint")}
        root = next(link.attrib["name"] for link in robot.iter("link") if link.attrib["name"] not in children)
        solids = tuple(
            (link.attrib["name"], number, shape.tag)
            for link in robot.iter("link")
            for number, visual in enumerate(link.findall("visual"))
            for shape in visual.iterfind("geometry/*")
            if shape.tag in ("box", "cylinder", "sphere")
        )
        return ArmPicture(urdf, root, tuple(_frames(joints[name]) for name in JOINT_NAMES), solids)
    except (ElementTree.ParseError, KeyError, ValueError, StopIteration) as error:
        raise InputError(f"the arm's URDF is not understood: {error}") from error


def _frames(joint: ElementTree.Element) -> JointFrames:
    origin, axis = joint.find("origin"), joint.find("axis")
    xyz = _numbers(origin, "xyz", "0 0 0")
    roll, pitch, yaw = _numbers(origin, "rpy", "0 0 0") / 2
    rotation = multiply(
        np.array([0.0, 0.0, np.sin(yaw), np.cos(yaw)]),
        multiply(np.array([0.0, np.sin(pitch), 0.0, np.cos(pitch)]), np.array([np.sin(roll), 0.0, 0.0, np.cos(roll)])),
    )
    direction = _numbers(axis, "xyz", "1 0 0")
    return JointFrames(
        name=joint.attrib["name"],
        parent=_link(joint, "parent"),
        child=_link(joint, "child"),
        prismatic=joint.attrib["type"] == "prismatic",
        translation=xyz,
        rotation=rotation,
        axis=direction / np.linalg.norm(direction),
    )


def _link(joint: ElementTree.Element, end: str) -> str:
    found = joint.find(end)
    if found is None:
        raise ValueError(f"joint {joint.attrib['name']!r} has no {end}")
    return found.attrib["link"]


def _numbers(element: ElementTree.Element | None, key: str, default: str) -> Floats:
    text = default if element is None else element.attrib.get(key, default)
    return np.array([float(number) for number in text.split()])


def multiply(left: Floats, right: Floats) -> Floats:
    """Product of quaternions x, y, z, w, (…, 4): first turn by `right`, then by `left`."""
    x1, y1, z1, w1 = np.moveaxis(left, -1, 0)
    x2, y2, z2, w2 = np.moveaxis(right, -1, 0)
    return np.stack(
        (
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        ),
        axis=-1,
    )


def rotate(quaternion: Floats, vector: Floats) -> Floats:
    """A vector, (3,), turned by a quaternion x, y, z, w, (4,)."""
    u, w = quaternion[:3], quaternion[3]
    return np.asarray(vector + 2 * np.cross(u, np.cross(u, vector) + w * vector))


def parameters_of(text: str) -> RigParameters:
    """A rig's parameters out of a recording's `parameters_json`; the defaults, without parts, where it has none.

    Raises:
        InputError: it has some, and they are not understood.
    """
    return RigParameters.from_json(text) if text else RigParameters()


def tips(arm: ArmParameters, positions: Floats) -> Floats:
    """Where the tool's tip is, world, m, (n, 3), for joint vectors (n, 4), rad and m."""
    return np.ascontiguousarray(forward(arm, positions.T)[:3].T)


def reach_outline(arm: ArmParameters, height: float) -> list[Floats]:
    """Outline of the area that the tool reaches, at a height: lines, each (n, 3), world, m.

    Outside: the arm straight, turned from stop to stop, and beyond each stop of joint 1 its second link folding on.
    Inside: the arm folded to the stop of joint 2.
    """
    low1, high1, low2, high2 = arm.lower[0], arm.upper[0], arm.lower[1], arm.upper[1]
    straight = float(np.clip(0.0, low2, high2))
    outside = np.concatenate(
        (
            _sweep(arm, (low1, low1), (low2, straight), height),
            _sweep(arm, (low1, high1), (straight, straight), height),
            _sweep(arm, (high1, high1), (straight, high2), height),
        )
    )
    inside = [_sweep(arm, (low1, high1), (folded, folded), height) for folded in (low2, high2) if abs(folded) < np.pi]
    return [outside, *inside]


def _sweep(arm: ArmParameters, theta1: tuple[float, float], theta2: tuple[float, float], height: float) -> Floats:
    turn = max(abs(theta1[1] - theta1[0]), abs(theta2[1] - theta2[0]))
    count = max(2, int(np.ceil(turn / _ARC_STEP_RAD)))
    joints = np.zeros((count, 4))
    joints[:, 0] = np.linspace(*theta1, count)
    joints[:, 1] = np.linspace(*theta2, count)
    points = tips(arm, joints)
    points[:, 2] = height
    return points
