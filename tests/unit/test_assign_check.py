"""`hilrig assign check`: all mistakes of an assignment at once, and a reference solution in a running lab."""

import json
import os
import shutil
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from hilrig_classroom.assignment import SETTINGS_FILE
from hilrig_classroom.check import check_assignment, warnings
from hilrig_runtime.errors import InputError
from support.labs import hilrig

ROOT = Path(__file__).parents[2]
FIRST = ROOT / "exercises/1-hold-joint-1"


def test_copy_of_an_exercise_is_a_valid_assignment(tmp_path: Path) -> None:
    done = hilrig("example", "exercises/4-inverse-kinematics", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    checked = hilrig("assign", "check", tmp_path / "4-inverse-kinematics", "--json")
    assert json.loads(checked.stdout) == {
        "schema": "hilrig.assign-check/1",
        "assignment": "Inverse kinematics",
        "points": 10.0,
        "warnings": ["no deadline: attempts are never late"],
        "solution": None,
    }


def test_all_mistakes_are_named_at_once(tmp_path: Path) -> None:
    folder = shutil.copytree(FIRST, tmp_path / "a")
    settings = 'title = "Final Score"\ngrace_minutes = 5\n[late]\npercent_per_day = 10\n'
    (folder / SETTINGS_FILE).write_text(settings)
    (folder / "handout.md").write_text(" \n")
    (folder / "starter.py").write_text("def (\n")
    lab = '[[task.poses]]\nname = "far"\nposition_mm = [700, 0, 100]\n[task.place]\nparts = ["cube"]\n'
    (folder / "lab.toml").write_text(lab)
    with pytest.raises(InputError) as failed:
        check_assignment(folder)
    lines = str(failed.value).splitlines()
    assert "task: pose 'far' is out of reach" in lines[0]
    assert "no ferromagnetic part 'cube' in the scene" in lines[1]
    assert "Canvas drops columns" in lines[2]
    assert "no effect without a deadline" in lines[3]
    assert "set late.last_day" in lines[4]
    assert "handout.md: empty" in lines[5]
    assert "starter.py: no valid Python program" in lines[6]
    assert len(lines) == 7


def test_passed_deadline_is_a_warning(tmp_path: Path) -> None:
    folder = shutil.copytree(FIRST, tmp_path / "a")
    deadline = datetime(2026, 12, 4, 12, tzinfo=UTC)
    settings = (FIRST / SETTINGS_FILE).read_text().replace("# deadline", f"deadline = {deadline.isoformat()} #")
    (folder / SETTINGS_FILE).write_text(settings)
    assignment, _ = check_assignment(folder)
    assert warnings(assignment, deadline - timedelta(seconds=1)) == []
    assert warnings(assignment, deadline + timedelta(seconds=1)) == [
        "the deadline 2026-12-04T12:00:00+00:00 has passed"
    ]


@pytest.mark.rig
def test_solution_runs_in_a_lab_and_is_graded(tmp_path: Path) -> None:
    folder = shutil.copytree(FIRST, tmp_path / "a")
    # One goal that is reached within half a second, one that is missed.
    goal = '[[task.poses]]\nname = "{}"\nposition_mm = [{}, 0, 139]\ntolerance_mm = 5\nhold_s = 0.2\n'
    extra = '[edge]\nfirst_port = 5020\n[recorder]\nfolder = "elsewhere"\n'
    (folder / "lab.toml").write_text(extra + goal.format("start", 600) + goal.format("other", 300))
    solution = tmp_path / "solution.py"
    solution.write_text((FIRST / "starter.py").read_text().replace("DURATION = 6.0", "DURATION = 1.0"))
    out = tmp_path / "kept"
    done = hilrig("assign", "check", folder, "--solution", solution, "--out", out, "--json", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    attempt = json.loads(done.stdout)["solution"]
    assert [goal["reached"] for goal in attempt["goals"]] == [True, False]
    assert attempt["raw"] == 5.0
    assert [path.name for path in out.iterdir()] == [attempt["file"]]
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.rig
@pytest.mark.skipif(not os.environ.get("HILRIG_LONG"), reason="starts one more lab; set HILRIG_LONG=1 to run it")
def test_program_without_torques_is_an_error_with_its_output(tmp_path: Path) -> None:
    solution = tmp_path / "solution"
    solution.write_text(f"#!{sys.executable}\nimport sys\nprint('nothing to do', sys.argv[1])\n")
    solution.chmod(0o755)
    done = hilrig("assign", "check", FIRST, "--solution", solution)
    assert done.returncode == 3
    assert "nothing was recorded: did it write torques? Its output: nothing to do --host" in done.stderr


@pytest.mark.rig
@pytest.mark.skipif(not os.environ.get("HILRIG_LONG"), reason="takes two minutes; set HILRIG_LONG=1 to run it")
@pytest.mark.parametrize("exercise", sorted((ROOT / "exercises").glob("*/")), ids=lambda exercise: exercise.name)
def test_solution_of_each_exercise_passes_in_real_time(exercise: Path) -> None:
    solution = ROOT / "tests/exercises" / f"{exercise.name[2:].replace('-', '_')}.py"
    done = hilrig("assign", "check", exercise, "--solution", solution)
    assert done.returncode == 0, done.stdout + done.stderr
