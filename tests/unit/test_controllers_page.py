"""The numbers in `docs/controllers.md` match the rig with default settings."""

import re
from pathlib import Path

import numpy as np

from hilrig_runtime.config.lab import LabConfig, RigSettings
from hilrig_sim.arm.kinematics import forward
from hilrig_sim.parameters import rig_parameters

PAGE = (Path(__file__).parents[2] / "docs/controllers.md").read_text(encoding="utf-8")
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
