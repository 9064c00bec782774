"""Visual geometry of a URDF: primitive shapes, fixed joints, and point clouds of the shapes' surfaces."""

from dataclasses import dataclass
from typing import Final
from xml.etree import ElementTree

import numpy as np

from hilrig_replay.geometry.quaternion import Floats, from_rpy, rotate
from hilrig_runtime.errors import InputError

_DEFAULT_COLOR: Final = (0.6, 0.6, 0.65, 1.0)
_POINT_SPACING_M: Final = 0.006


@dataclass(frozen=True, slots=True)
class VisualShape:
    """A primitive shape of a link's visual."""

    link: str
    kind: str
    """box, cylinder or sphere."""
    size: tuple[float, float, float]
    """Extent along the shape's axes, m."""
    translation: Floats
    """In the link's frame, m, (3,)."""
    rotation: Floats
    """In the link's frame, quaternion x, y, z, w, (4,)."""
    color: tuple[float, float, float, float]
    """Red, green, blue, opacity, 0 to 1."""

    def points(self) -> Floats:
        """Points on the surface in the link's frame, m, (n, 3)."""
        local = {"box": _box, "cylinder": _cylinder, "sphere": _sphere}[self.kind](np.array(self.size))
        return np.asarray(rotate(self.rotation, local) + self.translation)


def visual_shapes(urdf: str) -> list[VisualShape]:
    """Primitive shapes of all visuals of a URDF, link by link.

    Raises:
        InputError: it is not a URDF.
    """
    try:
        robot = ElementTree.fromstring(urdf)
        named = (material for material in robot.iter("material") if material.find("color") is not None)
        colors = {material.attrib.get("name", ""): _color(material) for material in named}
        return [
            shape
            for link in robot.iter("link")
            for visual in link.findall("visual")
            if (shape := _visual_shape(link.attrib["name"], visual, colors)) is not None
        ]
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise InputError(f"the arm's URDF is invalid: {error}") from error


def fixed_joints(urdf: str) -> list[tuple[str, str, Floats, Floats]]:
    """Fixed joints: parent link, child link, and the child frame's translation, m, (3,), and quaternion, (4,)."""
    found = []
    for joint in ElementTree.fromstring(urdf).iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if joint.attrib.get("type") == "fixed" and parent is not None and child is not None:
            translation, rotation = read_origin(joint)
            found.append((parent.attrib["link"], child.attrib["link"], translation, rotation))
    return found


def _visual_shape(link: str, visual: ElementTree.Element, colors: dict[str, tuple[float, ...]]) -> VisualShape | None:
    geometry = visual.find("geometry")
    if geometry is None:
        return None
    translation, rotation = read_origin(visual)
    material = visual.find("material")
    color = colors.get("" if material is None else material.attrib.get("name", ""), _DEFAULT_COLOR)
    if material is not None and material.find("color") is not None:
        color = _color(material)
    for shape in geometry:
        size = _size(shape)
        if size is not None:
            r, g, b, a = color
            return VisualShape(link, shape.tag, size, translation, rotation, (r, g, b, a))
    return None


def _size(shape: ElementTree.Element) -> tuple[float, float, float] | None:
    if shape.tag == "box":
        x, y, z = map(float, shape.attrib["size"].split())
        return x, y, z
    if shape.tag == "cylinder":
        diameter = 2 * float(shape.attrib["radius"])
        return diameter, diameter, float(shape.attrib["length"])
    if shape.tag == "sphere":
        diameter = 2 * float(shape.attrib["radius"])
        return diameter, diameter, diameter
    return None


def _color(material: ElementTree.Element) -> tuple[float, ...]:
    color = material.find("color")
    return _DEFAULT_COLOR if color is None else tuple(map(float, color.attrib["rgba"].split()))


def read_origin(element: ElementTree.Element) -> tuple[Floats, Floats]:
    """The `origin` of a joint or visual: translation, m, (3,), and quaternion x, y, z, w, (4,); identity if missing."""
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    translation = np.array([float(number) for number in attributes.get("xyz", "0 0 0").split()])
    roll, pitch, yaw = (float(angle) for angle in attributes.get("rpy", "0 0 0").split())
    return translation, from_rpy(roll, pitch, yaw)


def _steps(extent: float) -> Floats:
    return np.linspace(-extent / 2, extent / 2, max(2, round(extent / _POINT_SPACING_M)))


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
    angle, z = np.meshgrid(_angles(radius), _steps(height))
    side_surface = np.column_stack((radius * np.cos(angle.ravel()), radius * np.sin(angle.ravel()), z.ravel()))
    caps = []
    for r in np.arange(radius, 0, -_POINT_SPACING_M):
        around = _angles(r)
        for side in (-0.5, 0.5):
            caps.append(np.column_stack((r * np.cos(around), r * np.sin(around), np.full_like(around, side * height))))
    return np.concatenate((side_surface, *caps))


def _sphere(size: Floats) -> Floats:
    radius = size[0] / 2
    rings = []
    for polar in np.linspace(0, np.pi, max(3, round(np.pi * radius / _POINT_SPACING_M))):
        r = radius * np.sin(polar)
        around = _angles(max(r, _POINT_SPACING_M / 8))
        rings.append(
            np.column_stack((r * np.cos(around), r * np.sin(around), np.full_like(around, radius * np.cos(polar))))
        )
    return np.concatenate(rings)


def _angles(radius: float) -> Floats:
    count = max(6, round(2 * np.pi * radius / _POINT_SPACING_M))
    return np.linspace(0, 2 * np.pi, count, endpoint=False)
