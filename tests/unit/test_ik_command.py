"""`hilrig ik`: solutions, reasons, and negative coordinates."""

import json
import math

import pytest
from typer.testing import CliRunner

from hilrig_cli.main import app
from hilrig_runtime.errors import InputError
from hilrig_sim import ArmParameters, forward
from support.in_process import hilrig_in_process


def test_each_solution_reaches_the_pose() -> None:
    done = hilrig_in_process("ik", "-150", "-200", "50.5", "-90", "--json")
    assert done.returncode == 0, done.stderr
    solutions = json.loads(done.stdout)["joints_deg_deg_mm_deg"]
    assert len(solutions) >= 2
    for theta1, theta2, d3, theta4 in solutions:
        joints = (math.radians(theta1), math.radians(theta2), d3 / 1e3, math.radians(theta4))
        x, y, z, yaw = forward(ArmParameters(), joints).tolist()
        assert (x, y, z) == pytest.approx((-0.15, -0.2, 0.0505))
        assert math.degrees(yaw) % 360 == pytest.approx(270)


def test_table_has_both_elbows() -> None:
    done = CliRunner().invoke(app, ["ik", "300", "100", "50"])
    assert done.exit_code == 0, done.output
    assert "left" in done.stdout
    assert "right" in done.stdout


def test_unreachable_pose_has_its_reason_and_exit_code_1() -> None:
    done = CliRunner().invoke(app, ["ik", "700", "0", "0", "0"])
    assert done.exit_code == 1
    assert "no solution: pose x 700.0 mm, y 0.0 mm, z 0.0 mm is too far" in done.stdout
    as_json = hilrig_in_process("ik", "-590", "0", "0", "0", "--json")
    assert as_json.returncode == 1
    assert "is in reach, but" in json.loads(as_json.stdout)["reason"]


def test_unknown_rig_is_reported() -> None:
    done = CliRunner().invoke(app, ["ik", "300", "0", "0", "0", "--rig", "x"])
    assert isinstance(done.exception, InputError)
    assert "unknown rig 'x'; this lab has rig1" in str(done.exception)
