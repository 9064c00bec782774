"""`hilrig verify` and examples/paper_figures.py: exit codes, JSON on standard output, error messages."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from hilrig_replay.analysis.index import read_verdict
from hilrig_schemas import JointState
from support.labs import hilrig
from support.recordings import TimedMessage, write
from support.virtual_rig import VirtualRig

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.rig


@pytest.fixture(scope="module")
def made() -> list[TimedMessage]:
    with VirtualRig() as rig:
        rig.command((1.0, -0.5, -5.2, 0.01))
        rig.tick(120)
        return rig.recorded()


def test_verify_reports_the_first_diverging_step(made: list[TimedMessage], tmp_path: Path) -> None:
    valid, modified = tmp_path / "valid.mcap", tmp_path / "modified.mcap"
    write(valid, made)
    done = hilrig("verify", valid, "--json", "--tolerance", "0")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["same"], found["exact"], found["first_diverging_step"]) == (True, True, None)
    assert found["steps"] == 119
    assert read_verdict(valid) is True

    state = [one.message for one in made if isinstance(one.message, JointState)][70]
    state.effort[0] += 0.01
    try:
        write(modified, made)
    finally:
        state.effort[0] -= 0.01
    done = hilrig("verify", modified, "--json", "--tolerance", "0")
    assert done.returncode == 1
    assert json.loads(done.stdout)["first_diverging_step"] == state.step
    assert read_verdict(modified) is False
    both = hilrig("verify", tmp_path, "--json")
    assert both.returncode == 1
    assert {each["same"] for each in json.loads(both.stdout)["runs"]} == {True, False}
    both = hilrig("verify", tmp_path)
    assert both.returncode == 1
    assert "valid.mcap: 119 steps re-simulated" in both.stdout
    assert f"step {state.step} does not lead" in both.stdout


def test_example_of_the_paper_prints_and_plots_its_numbers(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "examples/paper_figures.py"), "--out", str(tmp_path / "figures")]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    plots = [Path(line) for line in done.stdout.splitlines() if line.endswith(".png")]
    assert [path.stat().st_size > 10_000 for path in plots] == [True] * 3
    assert "agrees: θ(10 s), reference: expected 0.05000, 0.19998 rad, computed 0.05000, 0.19998 rad" in done.stdout
    assert "DIFFERS" not in done.stdout


def test_error_is_reported_in_one_line(tmp_path: Path) -> None:
    done = hilrig("verify", "nothing.mcap", cwd=tmp_path)
    assert done.returncode == 2
    assert "no such file" in done.stderr
    assert "Traceback" not in done.stderr
