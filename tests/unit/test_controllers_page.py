"""The numbers in `docs/controllers.md` match the rig with default settings, and the guides match the examples."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from hilrig_runtime.config.lab import LabConfig, RigSettings
from hilrig_sim.arm.kinematics import forward
from hilrig_sim.parameters import rig_parameters

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/controllers.md").read_text(encoding="utf-8")
PARAMETERS = rig_parameters(LabConfig(), RigSettings())


def test_documented_joints_reach_the_red_part() -> None:
    found = re.search(r"θ1 = (\S+)°, θ2 = (\S+)°, d3 = (\S+) mm are (\d+) mm above", PAGE)
    assert found is not None
    theta1, theta2, d3, above_mm = map(float, found.groups())
    x, y, z, _ = forward(PARAMETERS.arm, [np.radians(theta1), np.radians(theta2), d3 / 1000, 0.0])
    red = next(part for part in PARAMETERS.scene.parts if part.name == "red")
    top = red.position[2] + red.size[2] / 2
    assert np.hypot(x - red.position[0], y - red.position[1]) < 0.0002
    assert abs(z - top - above_mm / 1000) < 1e-9
    stated = re.search(r"at most (\d+) mm beside and (\d+) mm below", PAGE)
    assert stated is not None
    magnet = LabConfig().scene.magnet
    assert tuple(map(float, stated.groups())) == (magnet.reach_mm, magnet.gap_mm)


def test_documented_weights_match_quill_and_part() -> None:
    stated = re.search(r"(\S+) kg require (\S+) N more upwards, τ3 = -(\S+) N in total", PAGE)
    assert stated is not None
    mass, more, whole = map(float, stated.groups())
    red = next(part for part in PARAMETERS.scene.parts if part.name == "red")
    assert mass == red.mass
    assert abs(more - 9.81 * mass) < 5e-4
    assert abs(whole - 9.81 * (PARAMETERS.arm.masses[2] + mass)) < 5e-4


@pytest.mark.parametrize("guide", sorted((ROOT / "docs/controllers").glob("*.md")), ids=lambda guide: guide.stem)
def test_examples_of_a_guide_exist(guide: Path) -> None:
    named = set(re.findall(r"examples/[\w./-]*\w/?", guide.read_text(encoding="utf-8")))
    assert all((ROOT / name).exists() for name in named), named
    assert named or guide.stem == "other-devices"


PLC_OPEN = "{http://www.plcopen.org/xml/tc6_0201}"


def bodies_of_st(text: str) -> list[str]:
    """Statements of function block and program, without their declarations."""
    return [unit.rpartition("END_VAR\n")[2].strip() for unit in re.split(r"END_FUNCTION_BLOCK|END_PROGRAM", text)[:2]]


def test_beremiz_runs_the_program_of_openplc() -> None:
    structured_text = (ROOT / "examples/openplc/hold_position.st").read_text(encoding="utf-8")
    project = ElementTree.parse(ROOT / "examples/beremiz/plc.xml").getroot()
    bodies = ["".join(unit.itertext()).strip() for unit in project.iter(f"{PLC_OPEN}ST")]
    assert bodies == bodies_of_st(structured_text)
    declared = dict(re.findall(r"(\w+) +AT (%\S+) :", structured_text))
    located = {
        variable.get("name"): variable.get("address")
        for variable in project.iter(f"{PLC_OPEN}variable")
        if variable.get("address")
    }
    # The addresses in the guide: absolute register numbers, from 0.
    guide = (ROOT / "docs/controllers/beremiz.md").read_text(encoding="utf-8")
    (first_position, last_position), (first_torque, last_torque), magnet = (
        re.findall(r"`(%IW\S+)` to `(%IW\S+)`", guide)[0],
        re.findall(r"`(%QW\S+)` to `(%QW\S+)`", guide)[0],
        re.findall(r"`(%QX\S+)`", guide)[0],
    )
    addresses = dict(zip(declared.values(), located.values(), strict=True))
    assert (addresses["%IW100"], addresses["%IW103"]) == (first_position, last_position)
    assert (addresses["%QW100"], addresses["%QW103"]) == (first_torque, last_torque)
    assert addresses["%QX100.0"] == magnet
    assert located.keys() == declared.keys()


def test_forte_guide_has_the_connection_of_the_boot_file() -> None:
    boot = (ROOT / "examples/4diac/hold_joint1.fboot").read_text(encoding="utf-8")
    (connection,) = re.findall(r'Source="(modbus\[\S+\])" Destination="RIG.ID"', boot)
    assert f"`{connection}`" in (ROOT / "docs/controllers/forte.md").read_text(encoding="utf-8")
    assert boot.rstrip().endswith('Action="START"/>')
