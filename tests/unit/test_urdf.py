"""Unit tests of the URDF: primitives only, consistent with the parameters, with the cell of the arm."""

from dataclasses import replace
from xml.etree import ElementTree

import pytest

from hilrig_sim.arm.joints import JOINT_NAMES
from hilrig_sim.arm.model import ArmParameters, RigParameters, SceneParameters
from hilrig_sim.arm.urdf import LINKS, urdf
from support.recordings import PARAMETERS

ROBOT = ElementTree.fromstring(urdf(PARAMETERS, "rig1"))


def test_links_and_joints_are_a_chain_from_base_to_tip() -> None:
    assert ROBOT.get("name") == "rig1"
    assert tuple(link.get("name") for link in ROBOT.findall("link")) == LINKS
    chain = []
    for joint in ROBOT.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        assert parent is not None
        assert child is not None
        chain.append((joint.get("name"), parent.get("link"), child.get("link")))
    assert chain == list(zip(JOINT_NAMES, LINKS, LINKS[1:], strict=False))


def test_visuals_are_primitives_with_defined_colors() -> None:
    colors = {material.get("name") for material in ROBOT.findall("material")}
    visuals = ROBOT.findall("link/visual")
    assert len(visuals) > 40
    for visual in visuals:
        (shape,) = list(visual.find("geometry"))  # type: ignore[arg-type]
        assert shape.tag in {"box", "cylinder"}
        assert all(float(number) > 0 for value in shape.attrib.values() for number in value.split())
        assert visual.find("material").get("name") in colors  # type: ignore[union-attr]
    for link in ROBOT.findall("link"):
        assert link.find("visual") is not None


def test_quill_and_magnet_are_not_below_the_tip() -> None:
    for name in ("quill", "tool"):
        for visual in ROBOT.findall(f"link[@name='{name}']/visual"):
            height = float(visual.find("origin").get("xyz").split()[2])  # type: ignore[union-attr]
            (shape,) = list(visual.find("geometry"))  # type: ignore[arg-type]
            extent = float(shape.get("length") or shape.get("size").split()[2])  # type: ignore[union-attr]
            assert height - extent / 2 >= -1e-9


def test_urdf_depends_on_the_parameters() -> None:
    arm = ArmParameters(l2=0.42, upper=(1.0, 1.0, 0.3, 1.0))
    other = ElementTree.fromstring(urdf(RigParameters(arm=arm)))
    origins = {joint.get("name"): joint.find("origin").get("xyz") for joint in other.findall("joint")}  # type: ignore[union-attr]
    assert origins["theta2"] == "0.42 0 0"
    limit = other.find("joint[@name='d3']/limit")
    assert limit is not None
    assert float(limit.get("upper", "")) == 0.3


def test_tray_has_its_configured_color() -> None:
    tray = replace(PARAMETERS.scene.trays[0], name="a tray & more", colour="#ff8000")
    text = urdf(RigParameters(scene=SceneParameters(trays=(tray,))))
    material = ElementTree.fromstring(text).find("material[@name='tray a tray & more']/color")
    assert material is not None
    assert material.get("rgba") == "1.000 0.502 0.000 1"


def test_text_is_reproducible() -> None:
    assert urdf(PARAMETERS) == urdf(PARAMETERS)
    assert pytest.approx(len(urdf(PARAMETERS)), rel=0.5) == 13_000
