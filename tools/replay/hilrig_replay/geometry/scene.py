"""Geometry of a rig in three dimensions, independent of any viewer: the arm's joint frames, tool positions, workspace.

World frame: x forward, y to the left, z up from the arm's base plane; meters and radians.
"""

from dataclasses import dataclass
from typing import Final
from xml.etree import ElementTree

import numpy as np

from hilrig_replay.geometry.quaternion import Floats, multiply, rotate
from hilrig_replay.geometry.urdf_geometry import read_origin
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.joints import JOINT_NAMES
from hilrig_sim.arm.kinematics import forward
from hilrig_sim.arm.model import ArmParameters, RigParameters

_ARC_STEP_RAD: Final = np.radians(2.0)


@dataclass(frozen=True, slots=True)
class JointFrames:
    """A movable joint of the URDF: computes the child link's frames for arrays of joint values."""

    name: str
    parent: str
    """Parent link."""
    child: str
    """Child link."""
    prismatic: bool
    translation: Floats
    """Of the joint frame in the parent's frame, m, (3,)."""
    rotation: Floats
    """Of the joint frame in the parent's frame, quaternion x, y, z, w, (4,)."""
    axis: Floats
    """In the joint frame, (3,)."""

    def transforms(self, values: Floats) -> tuple[Floats, Floats]:
        """Child frames in the parent's frame, translations (n, 3) and quaternions (n, 4), for values (n,), rad or m."""
        count = len(values)
        if self.prismatic:
            direction = rotate(self.rotation, self.axis)
            return self.translation + values[:, None] * direction, np.tile(self.rotation, (count, 1))
        half = values / 2
        turn = np.concatenate((np.sin(half)[:, None] * self.axis, np.cos(half)[:, None]), axis=1)
        return np.tile(self.translation, (count, 1)), multiply(self.rotation[None, :], turn)


@dataclass(frozen=True, slots=True)
class ArmGeometry:
    """The arm as described by its URDF."""

    urdf: str
    root: str
    """Root link; its frame is the world frame."""
    joints: tuple[JointFrames, ...]
    """The four movable joints, in joint order."""
    primitives: tuple[tuple[str, int, str], ...]
    """(link, index of the visual within the link, shape: box, cylinder or sphere) of each primitive."""


def parse_arm(urdf: str) -> ArmGeometry:
    """Parse a URDF whose movable joints are named as in `hilrig_sim.arm.joints.JOINT_NAMES`.

    Raises:
        InputError: it is not a URDF, or a joint is missing.
    """
    try:
        robot = ElementTree.fromstring(urdf)
        joints = {joint.attrib["name"]: joint for joint in robot.iter("joint") if joint.attrib.get("type") != "fixed"}
        missing = [name for name in JOINT_NAMES if name not in joints]
        if missing:
            raise InputError(f"the arm's URDF has no joint {missing[0]!r}; it has {', '.join(joints) or 'none'}")
        children = {_link(joint, "child") for joint in robot.iter("joint")}
        root = next(link.attrib["name"] for link in robot.iter("link") if link.attrib["name"] not in children)
        primitives = tuple(
            (link.attrib["name"], number, shape.tag)
            for link in robot.iter("link")
            for number, visual in enumerate(link.findall("visual"))
            for shape in visual.iterfind("geometry/*")
            if shape.tag in ("box", "cylinder", "sphere")
        )
        return ArmGeometry(urdf, root, tuple(_frames(joints[name]) for name in JOINT_NAMES), primitives)
    except (ElementTree.ParseError, KeyError, ValueError, StopIteration) as error:
        raise InputError(f"the arm's URDF is invalid: {error}") from error


def _frames(joint: ElementTree.Element) -> JointFrames:
    translation, rotation = read_origin(joint)
    axis = joint.find("axis")
    text = "1 0 0" if axis is None else axis.attrib.get("xyz", "1 0 0")
    direction = np.array([float(number) for number in text.split()])
    return JointFrames(
        name=joint.attrib["name"],
        parent=_link(joint, "parent"),
        child=_link(joint, "child"),
        prismatic=joint.attrib["type"] == "prismatic",
        translation=translation,
        rotation=rotation,
        axis=direction / np.linalg.norm(direction),
    )


def _link(joint: ElementTree.Element, end: str) -> str:
    found = joint.find(end)
    if found is None:
        raise ValueError(f"joint {joint.attrib['name']!r} has no {end}")
    return found.attrib["link"]


def parameters_of(text: str) -> RigParameters:
    """Parse a rig's parameters from a recording's `parameters_json`; an empty text gives the defaults, without parts.

    Raises:
        InputError: the text is invalid.
    """
    return RigParameters.from_json(text) if text else RigParameters()


def tool_positions(arm: ArmParameters, positions: Floats) -> Floats:
    """Tool tip positions in the world frame, m, (n, 3), for joint positions (n, 4), rad and m."""
    return np.ascontiguousarray(forward(arm, positions.T)[:3].T)


def workspace_outline(arm: ArmParameters, height: float) -> list[Floats]:
    """Outline of the tool's workspace at a height: polylines, each (n, 3), world frame, m.

    Outer boundary: the arm stretched, with joint 1 swept from limit to limit, and joint 2 folded at each limit of
    joint 1. Inner boundary: joint 2 at its limits.
    """
    low1, high1, low2, high2 = arm.lower[0], arm.upper[0], arm.lower[1], arm.upper[1]
    straight = float(np.clip(0.0, low2, high2))
    outer = np.concatenate(
        (
            _sweep(arm, (low1, low1), (low2, straight), height),
            _sweep(arm, (low1, high1), (straight, straight), height),
            _sweep(arm, (high1, high1), (straight, high2), height),
        )
    )
    inner = [_sweep(arm, (low1, high1), (folded, folded), height) for folded in (low2, high2) if abs(folded) < np.pi]
    return [outer, *inner]


def _sweep(arm: ArmParameters, theta1: tuple[float, float], theta2: tuple[float, float], height: float) -> Floats:
    turn = max(abs(theta1[1] - theta1[0]), abs(theta2[1] - theta2[0]))
    count = max(2, int(np.ceil(turn / _ARC_STEP_RAD)))
    joints = np.zeros((count, 4))
    joints[:, 0] = np.linspace(*theta1, count)
    joints[:, 1] = np.linspace(*theta2, count)
    points = tool_positions(arm, joints)
    points[:, 2] = height
    return points
