"""The visible shapes of a URDF, and points on their surfaces, for viewers that draw points but no solids."""

from dataclasses import dataclass
from typing import Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.rerun_view.scene import multiply
from hilrig_runtime.errors import InputError

Floats = NDArray[np.float64]

_GREY: Final = (0.6, 0.6, 0.65, 1.0)
_SPACING: Final = 0.006
"""Between points, m."""


@dataclass(frozen=True, slots=True)
class Solid:
    """One visual of a link."""

    link: str
    kind: str
    """box, cylinder or sphere."""
    size: tuple[float, float, float]
    """Extent along its own axes, m."""
    translation: Floats
    """In the link's frame, m, (3,)."""
    rotation: Floats
    """In the link's frame, quaternion x, y, z, w, (4,)."""
    color: tuple[float, float, float, float]
    """Red, green, blue, opacity, 0 to 1."""

    def points(self) -> Floats:
        """Points on its surface in the link's frame, m, (n, 3)."""
        local = {"box": _box, "cylinder": _cylinder, "sphere": _sphere}[self.kind](np.array(self.size))
        u, w = self.rotation[:3], self.rotation[3]
        turned = local + 2 * np.cross(u, np.cross(u, local) + w * local)
        return np.asarray(turned + self.translation)


def solids_of(urdf: str) -> list[Solid]:
    """The primitive visuals of a URDF, link by link.

    Raises:
        InputError: it is no URDF.
    """
    try:
        robot = ElementTree.fromstring(urdf)
        named = (material for material in robot.iter("material") if material.find("color") is not None)
        colors = {material.attrib.get("name", ""): _color(material) for material in named}
        return [
            solid
            for link in robot.iter("link")
            for visual in link.findall("visual")
            if (solid := _solid(link.attrib["name"], visual, colors)) is not None
        ]
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise InputError(f"the arm's URDF is not understood: {error}") from error


def fixed_joints(urdf: str) -> list[tuple[str, str, Floats, Floats]]:
    """Joints that don't move: parent, child, translation (3,) m and quaternion x, y, z, w (4,) of the child."""
    found = []
    for joint in ElementTree.fromstring(urdf).iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if joint.attrib.get("type") == "fixed" and parent is not None and child is not None:
            translation, rotation = _origin(joint)
            found.append((parent.attrib["link"], child.attrib["link"], translation, rotation))
    return found


def _solid(link: str, visual: ElementTree.Element, colors: dict[str, tuple[float, ...]]) -> Solid | None:
    geometry = visual.find("geometry")
    if geometry is None:
        return None
    translation, rotation = _origin(visual)
    material = visual.find("material")
    color = colors.get("" if material is None else material.attrib.get("name", ""), _GREY)
    if material is not None and material.find("color") is not None:
        color = _color(material)
    for shape in geometry:
        size = _size(shape)
        if size is not None:
            r, g, b, a = color
            return Solid(link, shape.tag, size, translation, rotation, (r, g, b, a))
    return None


def _size(shape: ElementTree.Element) -> tuple[float, float, float] | None:
    if shape.tag == "box":
        x, y, z = map(float, shape.attrib["size"].split())
        return x, y, z
    if shape.tag == "cylinder":
        width = 2 * float(shape.attrib["radius"])
        return width, width, float(shape.attrib["length"])
    if shape.tag == "sphere":
        width = 2 * float(shape.attrib["radius"])
        return width, width, width
    return None


def _color(material: ElementTree.Element) -> tuple[float, ...]:
    color = material.find("color")
    return _GREY if color is None else tuple(map(float, color.attrib["rgba"].split()))


def _origin(element: ElementTree.Element) -> tuple[Floats, Floats]:
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    xyz = np.array(list(map(float, attributes.get("xyz", "0 0 0").split())))
    roll, pitch, yaw = (float(angle) / 2 for angle in attributes.get("rpy", "0 0 0").split())
    about_x = np.array([np.sin(roll), 0.0, 0.0, np.cos(roll)])
    about_y = np.array([0.0, np.sin(pitch), 0.0, np.cos(pitch)])
    about_z = np.array([0.0, 0.0, np.sin(yaw), np.cos(yaw)])
    return xyz, multiply(about_z, multiply(about_y, about_x))


def _steps(extent: float) -> Floats:
    return np.linspace(-extent / 2, extent / 2, max(2, round(extent / _SPACING)))


def _box(size: Floats) -> Floats:
    faces = []
    for axis in range(3):
        first, second = (other for other in range(3) if other != axis)
        u, v = np.meshgrid(_steps(size[first]), _steps(size[second]))
        for side in (-0.5, 0.5):
            face = np.empty((u.size, 3))
            face[:, axis], face[:, first], face[:, second] = side * size[axis], u.ravel(), v.ravel()
            faces.append(face)
    return np.concatenate(faces)


def _cylinder(size: Floats) -> Floats:
    radius, height = size[0] / 2, size[2]
    angle, z = np.meshgrid(_turn(radius), _steps(height))
    mantle = np.column_stack((radius * np.cos(angle.ravel()), radius * np.sin(angle.ravel()), z.ravel()))
    lids = []
    for r in np.arange(radius, 0, -_SPACING):
        around = _turn(r)
        for side in (-0.5, 0.5):
            lids.append(np.column_stack((r * np.cos(around), r * np.sin(around), np.full_like(around, side * height))))
    return np.concatenate((mantle, *lids))


def _sphere(size: Floats) -> Floats:
    radius = size[0] / 2
    rings = []
    for polar in np.linspace(0, np.pi, max(3, round(np.pi * radius / _SPACING))):
        r = radius * np.sin(polar)
        around = _turn(max(r, _SPACING / 8))
        rings.append(
            np.column_stack((r * np.cos(around), r * np.sin(around), np.full_like(around, radius * np.cos(polar))))
        )
    return np.concatenate(rings)


def _turn(radius: float) -> Floats:
    count = max(6, round(2 * np.pi * radius / _SPACING))
    return np.linspace(0, 2 * np.pi, count, endpoint=False)
