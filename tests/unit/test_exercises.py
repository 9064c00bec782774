"""The exercises: each reference solution reaches all goals, and each starter program runs and does not."""

import tomllib
from datetime import UTC, datetime
from pathlib import Path

import pytest

from hilrig_classroom.check import check_assignment
from hilrig_cli.examples import example_names, listed_names, summary
from hilrig_replay.analysis.summary import summarize
from hilrig_replay.grading.grade import Grade
from hilrig_replay.io.run import open_run
from support.long_tests import LONG
from support.virtual_lab import VirtualLab

ROOT = Path(__file__).parents[2]
EXERCISES = sorted((ROOT / "exercises").glob("*/"))
START = datetime(2026, 12, 1, 10, tzinfo=UTC)
STARTER_S = 60.0 if LONG else 2.5
"""Longest time of a starter program, s: its law does not change later."""


def solution_of(exercise: Path) -> Path:
    return ROOT / "tests/exercises" / f"{exercise.name[2:].replace('-', '_')}.py"


def graded(exercise: Path, program: Path, folder: Path, seconds: float) -> tuple[int, Grade]:
    """Run a program in the lab of an exercise, in simulated time; return its exit code and its grade."""
    assignment, lab = check_assignment(exercise)
    with VirtualLab(lab, folder, START) as virtual:
        code = virtual.run(program, seconds=seconds)
        recording = virtual.recording()
    grade = summarize(open_run((recording,)), assignment.task).grade
    assert grade is not None
    return code, grade


def test_listing_of_examples_says_what_each_one_is() -> None:
    assert [name for name in listed_names() if not summary(name)] == []


def test_there_are_eight_exercises_with_solutions() -> None:
    assert [exercise.name[0] for exercise in EXERCISES] == list("12345678")
    names = {"assignment.toml", "handout.md", "lab.toml", "starter.py"}
    assert all({path.name for path in exercise.glob("*.*")} == names for exercise in EXERCISES)
    assert all(solution_of(exercise).is_file() for exercise in EXERCISES)


@pytest.mark.parametrize("exercise", EXERCISES, ids=lambda exercise: exercise.name)
def test_solution_reaches_every_goal(exercise: Path, tmp_path: Path) -> None:
    code, grade = graded(exercise, solution_of(exercise), tmp_path, 60.0)
    assert (code, grade.passed) == (0, True), grade.lines()
    assert grade.time_limit_s > 0


@pytest.mark.parametrize("exercise", EXERCISES, ids=lambda exercise: exercise.name)
def test_starter_runs_and_misses_a_goal(exercise: Path, tmp_path: Path) -> None:
    code, grade = graded(exercise, exercise / "starter.py", tmp_path, STARTER_S)
    assert code == (0 if LONG else 124)
    assert not grade.passed


def test_handouts_fit_on_a_page_and_say_what_to_submit() -> None:
    for exercise in EXERCISES:
        text = (exercise / "handout.md").read_text(encoding="utf-8")
        assert len(text.splitlines()) < 50, exercise.name
        assert f"# {check_assignment(exercise)[0].config.title}\n" in text
        assert {"## Background", "## To do", "## Submit"} <= set(text.splitlines()), exercise.name


def test_exercises_are_part_of_the_package() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    assert build["targets"]["wheel"]["force-include"]["exercises"] == "hilrig_examples/exercises"
    names = example_names()
    for exercise in EXERCISES:
        assert {f"exercises/{exercise.name}/{path.name}" for path in exercise.glob("*.*")} <= set(names)
