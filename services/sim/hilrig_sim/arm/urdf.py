"""URDF of the arm and its cell, generated from the parameters of the simulation; all visualizations use it.

Each moving link has its point mass at the position of the reduced model, (17)–(19). Physics engines reject a zero
inertia tensor, so it is `POINT_INERTIA`. The inertia of joint 4 belongs to its drive and rotates with θ4 only
(docs/model-decisions.md, decision 2). URDF has no element for that: set it as the armature of the joint in the engine
(MuJoCo `dof_armature`, Pinocchio `armature`). Visuals are primitives, and there is no collision geometry.
"""

import math
from typing import Final
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from hilrig_sim.arm.joints import JOINT_NAMES
from hilrig_sim.arm.model import ArmParameters, RigParameters, SceneParameters, TrayParameters

POINT_INERTIA: Final = 1e-12
"""Replaces the zero inertia of a point mass, kg·m²."""
POINT_MASS: Final = 1e-9
"""Replaces the zero mass of the magnet, kg."""

LINKS: Final = ("base", "link1", "link2", "quill", "tool")
"""Names of the links, from the base to the tool; the origin of `tool` is the tip."""

_COLORS: Final = {
    "graphite": "0.16 0.18 0.21 1",
    "steel": "0.74 0.76 0.79 1",
    "orange": "0.95 0.45 0.13 1",
    "white": "0.93 0.94 0.95 1",
    "red": "0.78 0.13 0.15 1",
    "wood": "0.82 0.75 0.64 1",
    "place": "0.92 0.93 0.94 1",
}
_DOWN: Final = -1


def urdf(parameters: RigParameters, name: str = "hilrig_scara") -> str:
    """Return the rig as URDF text."""
    arm, scene = parameters.arm, parameters.scene
    robot = Element("robot", name=name)
    robot.append(
        ElementTree.Comment(
            f" SI units, z up. Give joint theta4 an armature of {arm.j4!r} kg m2: the inertia of its drive. "
        )
    )
    for color, rgba in _COLORS.items():
        SubElement(SubElement(robot, "material", name=color), "color", rgba=rgba)
    for tray in scene.trays:
        SubElement(SubElement(robot, "material", name=f"tray {tray.name}"), "color", rgba=_rgba(tray.colour))
    _base(robot, arm, scene)
    _link1(robot, arm)
    _link2(robot, arm)
    _quill(robot, arm)
    _tool(robot)
    z_down = (0, 0, _DOWN)
    _joint(robot, arm, 0, "revolute", (0, 0, arm.l1), (0, 0, 1))
    _joint(robot, arm, 1, "revolute", (arm.l2, 0, 0), (0, 0, 1))
    _joint(robot, arm, 2, "prismatic", (arm.l3, 0, 0), z_down)
    _joint(robot, arm, 3, "revolute", (0, 0, 0), (0, 0, 1))
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _base(robot: Element, arm: ArmParameters, scene: SceneParameters) -> None:
    link = SubElement(robot, "link", name=LINKS[0])
    top = scene.table_height
    width, depth = scene.table_size
    x, y = scene.table_centre
    _box(link, (width, depth, 0.03), (x, y, top - 0.015), "wood")
    _box(link, (width - 0.08, depth - 0.08, 0.05), (x, y, top - 0.055), "graphite")
    if top < 0:
        _box(link, (0.20, 0.20, -top), (0, 0, top / 2), "graphite")
    for u in (-0.075, 0.075):
        for v in (-0.075, 0.075):
            _cylinder(link, 0.008, 0.008, (u, v, 0.004), "steel")
    _cylinder(link, 0.088, 0.012, (0, 0, 0.006), "steel")
    _cylinder(link, 0.058, arm.l1 - 0.012, (0, 0, (arm.l1 + 0.012) / 2), "white")
    _cylinder(link, 0.062, 0.014, (0, 0, arm.l1 - 0.007), "graphite")
    for tray in scene.trays:
        _tray(link, tray)


def _tray(link: Element, tray: TrayParameters) -> None:
    x, y, z = tray.position
    length, width, height = tray.size
    material = f"tray {tray.name}"
    _box(link, tray.size, (x, y, z + height / 2), material, yaw=tray.yaw)
    c, s = math.cos(tray.yaw), math.sin(tray.yaw)
    rim = 0.006
    for u, v, size in (
        (length / 2 + rim / 2, 0.0, (rim, width + 2 * rim, height + rim)),
        (-length / 2 - rim / 2, 0.0, (rim, width + 2 * rim, height + rim)),
        (0.0, width / 2 + rim / 2, (length, rim, height + rim)),
        (0.0, -width / 2 - rim / 2, (length, rim, height + rim)),
    ):
        _box(link, size, (x + c * u - s * v, y + s * u + c * v, z + (height + rim) / 2), material, yaw=tray.yaw)
    for place in tray.places:
        _cylinder(link, 0.024, 0.0008, (place[0], place[1], place[2] + 0.0004), "place")
        _cylinder(link, 0.021, 0.0012, (place[0], place[1], place[2] + 0.0006), material)


def _link1(robot: Element, arm: ArmParameters) -> None:
    link = SubElement(robot, "link", name=LINKS[1])
    _point_mass(link, arm.masses[0], (arm.l2, 0, 0))
    _cylinder(link, 0.060, 0.060, (0, 0, 0.032), "orange")
    _box(link, (arm.l2, 0.092, 0.046), (arm.l2 / 2, 0, 0.032), "orange")
    _cylinder(link, 0.050, 0.052, (arm.l2, 0, 0.032), "orange")
    _cylinder(link, 0.042, 0.010, (0, 0, 0.066), "graphite")
    _cylinder(link, 0.044, 0.008, (arm.l2, 0, 0.062), "graphite")


def _link2(robot: Element, arm: ArmParameters) -> None:
    link = SubElement(robot, "link", name=LINKS[2])
    _point_mass(link, arm.masses[1], (arm.l3, 0, 0))
    _cylinder(link, 0.050, 0.052, (0, 0, 0.092), "white")
    _box(link, (arm.l3, 0.080, 0.044), (arm.l3 / 2, 0, 0.090), "white")
    _cylinder(link, 0.044, 0.056, (arm.l3, 0, 0.090), "white")
    _box(link, (0.13, 0.066, 0.060), (arm.l3 * 0.42, 0, 0.140), "white")
    _cylinder(link, 0.033, 0.060, (arm.l3 * 0.42 + 0.065, 0, 0.140), "white")
    _cylinder(link, 0.036, 0.010, (0, 0, 0.122), "graphite")
    _cylinder(link, 0.026, 0.034, (arm.l3, 0, 0.133), "graphite")
    _cylinder(link, 0.024, 0.012, (arm.l3, 0, 0.056), "graphite")


def _quill(robot: Element, arm: ArmParameters) -> None:
    """Add the quill: a spline shaft, long enough for the whole stroke."""
    link = SubElement(robot, "link", name=LINKS[3])
    _point_mass(link, arm.masses[2], (0, 0, 0))
    length = arm.upper[2] - arm.lower[2] + 0.145
    _cylinder(link, 0.0095, length, (0, 0, 0.026 + length / 2), "steel")
    for k in range(4):
        _box(link, (0.0215, 0.0035, length - 0.02), (0, 0, 0.026 + length / 2), "graphite", yaw=k * math.pi / 4)
    _cylinder(link, 0.015, 0.012, (0, 0, 0.026 + length), "graphite")


def _tool(robot: Element) -> None:
    """Add the magnet; a mark on its side shows θ4."""
    link = SubElement(robot, "link", name=LINKS[4])
    _point_mass(link, POINT_MASS, (0, 0, 0))
    _cylinder(link, 0.013, 0.010, (0, 0, 0.027), "steel")
    _cylinder(link, 0.017, 0.018, (0, 0, 0.013), "red")
    _cylinder(link, 0.017, 0.004, (0, 0, 0.002), "steel")
    _box(link, (0.010, 0.006, 0.012), (0.019, 0, 0.013), "white")


def _joint(
    robot: Element,
    arm: ArmParameters,
    index: int,
    kind: str,
    origin: tuple[float, float, float],
    axis: tuple[float, float, float],
) -> None:
    joint = SubElement(robot, "joint", name=JOINT_NAMES[index], type=kind)
    SubElement(joint, "parent", link=LINKS[index])
    SubElement(joint, "child", link=LINKS[index + 1])
    SubElement(joint, "origin", xyz=_numbers(origin), rpy="0 0 0")
    SubElement(joint, "axis", xyz=_numbers(axis))
    # URDF requires limits of effort and speed; the model has only the limit of the torque register.
    SubElement(
        joint,
        "limit",
        lower=repr(float(arm.lower[index])),
        upper=repr(float(arm.upper[index])),
        effort="32.767",
        velocity="100",
    )
    SubElement(joint, "dynamics", damping=repr(float(arm.friction[index])), friction="0")


def _point_mass(link: Element, mass: float, at: tuple[float, float, float]) -> None:
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=_numbers(at), rpy="0 0 0")
    SubElement(inertial, "mass", value=repr(float(mass)))
    tiny = repr(POINT_INERTIA)
    SubElement(inertial, "inertia", ixx=tiny, iyy=tiny, izz=tiny, ixy="0", ixz="0", iyz="0")


def _box(
    link: Element,
    size: tuple[float, float, float],
    at: tuple[float, float, float],
    material: str,
    yaw: float = 0.0,
) -> None:
    SubElement(_visual(link, at, material, yaw), "box", size=_numbers(size))


def _cylinder(link: Element, radius: float, length: float, at: tuple[float, float, float], material: str) -> None:
    SubElement(_visual(link, at, material, 0.0), "cylinder", radius=f"{radius:g}", length=f"{length:.9g}")


def _visual(link: Element, at: tuple[float, float, float], material: str, yaw: float) -> Element:
    visual = SubElement(link, "visual", name=f"{link.get('name')}_{len(link.findall('visual'))}")
    SubElement(visual, "origin", xyz=_numbers(at), rpy=f"0 0 {yaw:.9g}")
    geometry = SubElement(visual, "geometry")
    SubElement(visual, "material", name=material)
    return geometry


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def _rgba(color: str) -> str:
    red, green, blue = (int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return f"{red:.3f} {green:.3f} {blue:.3f} 1"
