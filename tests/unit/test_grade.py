"""Grades of known motions: a step response, a path with a known distance, parts placed in time and late."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import draw_grading
from hilrig_replay.analysis.summary import summarize
from hilrig_replay.grading.grade import Grade, Grader
from hilrig_replay.grading.placement import PartPlacement, PlacementReport
from hilrig_replay.grading.task_loading import load_task, recorded_task
from hilrig_replay.io.run import open_run
from hilrig_replay.report.report import build_report
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import InputError
from hilrig_schemas import JointState
from hilrig_sim.arm.kinematics import inverse
from hilrig_sim.parameters import lab_parameters
from support.recordings import PARAMETERS, Script, make, write

STEP_S = 0.02
STEP_RESPONSE = {"poses": [{"name": "a", "position_mm": [400, 0, 0], "tolerance_mm": 4, "hold_s": 0.3}]}


def graded(
    task: dict[str, Any],
    tip: np.ndarray,
    *,
    velocity: np.ndarray | None = None,
    pieces: int = 1,
    quiet: int = 0,
    drops: dict[str, float] | None = None,
) -> Grade:
    """Grade a tool path, m, (n, 3), one state per step; the first `quiet` states are before the first command.

    Without velocities, m/s, (n, 3), they are differences of the positions.
    """
    grader = Grader(TaskConfig.model_validate(task), PARAMETERS)
    time_s = STEP_S * np.arange(len(tip), dtype=np.float64)
    pose = np.column_stack((tip, np.zeros(len(tip))))
    speed = np.zeros_like(pose) if velocity is None else np.column_stack((velocity, np.zeros(len(tip))))
    if velocity is None and len(tip) > 1:
        speed[1:-1] = (pose[2:] - pose[:-2]) / (2 * STEP_S)
    commanded = np.arange(len(tip)) >= quiet
    for rows in np.array_split(np.arange(len(tip)), pieces):
        grader.add_states(time_s[rows], pose[rows], speed[rows], commanded[rows])
    for part, at_s in (drops or {}).items():
        grader.add_drop(part, at_s)
    placement = PlacementReport(
        (PartPlacement("red", 0, 0.5), PartPlacement("blue", 1, 3.0), PartPlacement("green", None, None))
    )
    return grader.grade(placement)


def response(
    damping: float, rate: float, t: np.ndarray, goal: float = 0.4, start: float = 0.2
) -> tuple[np.ndarray, np.ndarray]:
    """Position, m, and speed, m/s, of the step response of a second-order system from rest."""
    damped = rate * math.sqrt(1 - damping**2)
    decay = np.exp(-damping * rate * t)
    x = goal + (start - goal) * decay * (np.cos(damped * t) + damping * rate / damped * np.sin(damped * t))
    return x, (goal - start) * decay * rate**2 / damped * np.sin(damped * t)


def along_x(x: np.ndarray) -> np.ndarray:
    return np.column_stack((x, np.zeros_like(x), np.zeros_like(x)))


def second_order(damping: float, rate: float, seconds: float, goal: float = 0.4, start: float = 0.2) -> np.ndarray:
    """Step response along x from `start` to `goal`, m."""
    return along_x(response(damping, rate, np.arange(0, seconds, STEP_S), goal, start)[0])


@pytest.mark.parametrize("rate", [5.0, 15.0, 30.0])
@pytest.mark.parametrize("damping", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("phase", [0.0, 0.33, 0.77])
def test_figures_of_a_step_response_are_those_of_theory(rate: float, damping: float, phase: float) -> None:
    # The arm is at rest, and the step begins within a sampling interval.
    t = np.arange(-5, 400) * STEP_S + phase * STEP_S
    x, speed = (
        np.where(t < 0, rest, values) for rest, values in zip((0.2, 0.0), response(damping, rate, t), strict=True)
    )
    (pose,) = graded(STEP_RESPONSE, along_x(x), velocity=along_x(speed)).poses
    overshoot = math.exp(-math.pi * damping / math.sqrt(1 - damping**2))
    assert pose.overshoot_mm == pytest.approx(200 * overshoot, abs=0.5)
    # The first hold of 0.3 s within 4 mm.
    fine_s = np.arange(0, 8, 1e-4)
    outside = np.abs(response(damping, rate, fine_s)[0] - 0.4) > 0.004
    ends = np.flatnonzero(outside[:-1] & ~outside[1:])
    begins = np.append(np.flatnonzero(~outside[:-1] & outside[1:]), len(fine_s))
    held = next(end for end in ends.tolist() if begins[begins > end].min() - end >= 3000)
    settling_s = 0.1 - phase * STEP_S + fine_s[held]
    assert pose.settling_s == pytest.approx(settling_s, abs=0.003)
    inside = np.abs(response(damping, rate, fine_s[held + 1 : held + 3001])[0] - 0.4)
    # The tool may enter at 0.3 m/s, and the interpolated motion has a resolution of 1 ms.
    assert pose.error_mm == pytest.approx(1000 * inside.max(), abs=0.35)


@pytest.mark.parametrize("damping", [0.3, 0.5, 0.7])
def test_overshoot_and_settling_time_match_theory(damping: float) -> None:
    rate = 5.0
    (pose,) = graded(STEP_RESPONSE, second_order(damping, rate, 8.0)).poses
    overshoot = math.exp(-math.pi * damping / math.sqrt(1 - damping**2))
    assert pose.overshoot_share == pytest.approx(overshoot, abs=0.01)
    assert pose.overshoot_mm == pytest.approx(200 * overshoot, abs=2)
    assert pose.settling_s is not None
    assert pose.reached_s == pytest.approx(pose.settling_s + 0.3, abs=STEP_S + 1e-9)
    # The response stays within 2 % (4 mm of 200 mm) from the settling time on, but not a millisecond earlier.
    fine_s = np.arange(0, 8.0, 1e-4)
    apart = np.abs(response(damping, rate, fine_s)[0] - 0.4)
    assert (apart[round((pose.settling_s + 1e-3) / 1e-4) :] <= 0.004).all()
    assert apart[round((pose.settling_s - 2e-3) / 1e-4)] > 0.004


def test_time_counts_from_the_first_command() -> None:
    way = np.concatenate((np.tile([0.2, 0, 0], (100, 1)), second_order(0.7, 5.0, 6.0)))
    late, prompt = graded(STEP_RESPONSE, way, quiet=100), graded(STEP_RESPONSE, second_order(0.7, 5.0, 6.0))
    assert late.done_s == pytest.approx(prompt.done_s)
    assert graded(STEP_RESPONSE, way, quiet=len(way)).poses[0].turn_s is None


def test_poses_are_targets_in_sequence() -> None:
    poses = [
        {"name": name, "position_mm": [x, 0, 0], "hold_s": 0.2} for name, x in (("a", 300), ("b", 200), ("c", 250))
    ]
    way = np.zeros((150, 3))
    way[:, 0] = np.repeat([0.2, 0.3, 0.2], 50)
    grade = graded({"poses": poses}, way)
    # The tool jumps between two states.
    assert [pose.reached_s for pose in grade.poses] == [
        pytest.approx(1.2, abs=0.02),
        pytest.approx(2.2, abs=0.02),
        None,
    ]
    assert grade.score == pytest.approx(2 / 3)
    assert grade.poses[2].closest_mm == pytest.approx(50)
    assert not grade.passed
    assert grade.done_s is None


def test_checks_yaw_modulo_a_full_turn() -> None:
    task = {"poses": [{"name": "a", "position_mm": [200, 0, 0], "yaw_deg": 370, "hold_s": 0.1}]}
    grader = Grader(TaskConfig.model_validate(task), PARAMETERS)
    pose = np.tile([0.2, 0, 0, math.radians(-180.0)], (50, 1))
    pose[20:, 3] = math.radians(11.0)
    grader.add_states(STEP_S * np.arange(50.0), pose, np.zeros_like(pose), np.ones(50, np.bool_))
    (found,) = grader.grade(None).poses
    assert found.settling_s == pytest.approx(0.4, abs=0.002)


SQUARE = [[200, 0, 0], [300, 0, 0], [300, 100, 0], [200, 100, 0], [200, 0, 0]]


def along(points_mm: Sequence[Sequence[float]], speed: float, aside_mm: float = 0.0) -> np.ndarray:
    """A tool path along a polyline, `aside_mm` above it."""
    points = np.array(points_mm) / 1000
    from_start = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    at = np.append(np.arange(0, from_start[-1], speed * STEP_S), from_start[-1])
    way = np.column_stack([np.interp(at, from_start, column) for column in points.T])
    return np.asarray(way + np.array([0, 0, aside_mm / 1000]))


def test_tracking_error_is_the_distance_from_the_path() -> None:
    grade = graded({"path": {"points_mm": SQUARE}}, along(SQUARE, 0.1, aside_mm=2.0))
    assert grade.path is not None
    assert grade.path.length_m == pytest.approx(0.4)
    assert (grade.path.covered, grade.passed) == (1.0, True)
    assert (grade.path.rms_mm, grade.path.largest_mm) == pytest.approx((2.0, 2.0), abs=0.01)
    assert grade.path.done_s == pytest.approx(4.0, abs=0.1)


def test_unfinished_path_counts_by_its_covered_share() -> None:
    half = along(SQUARE[:3], 0.1)
    grade = graded({"path": {"points_mm": SQUARE}}, half)
    assert grade.path is not None
    assert grade.path.covered == pytest.approx(0.5, abs=0.02)
    assert (grade.path.done_s, grade.score) == (None, grade.path.covered)
    # Back to the start across the middle: at the last point, but half of the path is not covered.
    across = np.concatenate((half, np.linspace(half[-1], half[0], 20)))
    back = graded({"path": {"points_mm": SQUARE}}, across).path
    assert back is not None
    assert back.done_s is None
    never = graded({"path": {"points_mm": SQUARE}}, half + np.array([0, 0, 0.05])).path
    assert never is not None
    assert (never.began_s, never.rms_mm) == (None, None)


def test_waiting_at_a_closed_path_covers_nothing() -> None:
    corner = np.array(SQUARE[0]) / 1000
    # Close to the start, the nearest point is on the first side or on the last side.
    sides = [(np.array(SQUARE[1]) / 1000 - corner) * 0.01, (np.array(SQUARE[-2]) / 1000 - corner) * 0.01]
    standing = np.array([corner + sides[state % 2] for state in range(40)])
    path = graded({"path": {"points_mm": SQUARE}}, standing).path
    assert path is not None
    assert path.began_s is not None
    assert path.covered < 0.1
    assert path.done_s is None


THERE_AND_BACK = [[200, 0, 0], [300, 0, 0], [200, 0, 0]]
TWICE = [*SQUARE, *SQUARE[1:]]
EIGHT = [[200, 0, 0], [300, 100, 0], [300, 0, 0], [200, 100, 0], [200, 0, 0]]
ZIGZAG = [[200, 0, 0], [300, 0, 0], [250, 0, 0], [350, 0, 0]]


@pytest.mark.parametrize("speed", [0.05, 0.2, 0.8])
@pytest.mark.parametrize("noise_mm", [0.0, 0.5])
@pytest.mark.parametrize("points", [THERE_AND_BACK, TWICE, EIGHT, ZIGZAG], ids=["A-B-A", "twice", "eight", "zigzag"])
def test_stretch_that_a_path_passes_twice_counts_twice(points: list[list[int]], speed: float, noise_mm: float) -> None:
    tip = along(points, speed)
    # One axis only: the noise of the others would turn a slow motion around.
    tip[:, 2] += np.random.default_rng(7).normal(size=len(tip)) * noise_mm / 1000
    task = {"path": {"points_mm": points}}
    path = graded(task, tip).path
    assert path is not None
    assert (path.covered, path.done_s is not None) == (1.0, True)
    assert path.rms_mm == pytest.approx(noise_mm, abs=0.2 + 2.0 * speed)
    # A part of the way is that part, although the tool was at every point of A-B-A.
    half = graded(task, tip[: len(tip) // 2]).path
    assert half is not None
    assert half.covered == pytest.approx(0.5, abs=0.06)
    assert half.done_s is None


def test_moving_back_on_a_path_is_no_progress_and_no_loss() -> None:
    there, back = along([[200, 0, 0], [280, 0, 0]], 0.1), along([[280, 0, 0], [230, 0, 0]], 0.1)
    dip = np.concatenate((there, back, along([[230, 0, 0], [300, 0, 0]], 0.1)))
    task = {"path": {"points_mm": [[200, 0, 0], [300, 0, 0]]}}
    path = graded(task, dip).path
    assert path is not None
    assert path.done_s == pytest.approx(0.8 + 0.5 + 0.7, abs=0.15)
    path = graded(task, np.concatenate((there, back))).path
    assert path is not None
    assert path.covered == pytest.approx(0.85, abs=0.02)


def test_offset_path_has_the_offset_as_its_error() -> None:
    for offset_mm in (0.5, 3.0):
        path = graded({"path": {"points_mm": TWICE}}, along(TWICE, 0.1, aside_mm=offset_mm)).path
        assert path is not None
        assert (path.rms_mm, path.largest_mm) == pytest.approx((offset_mm, offset_mm), abs=0.02)


def test_tracking_error_ignores_motion_after_the_path() -> None:
    away = np.linspace([0.3, 0.1, 0.002], [0.3, 0.5, 0.3], 40)
    way = np.concatenate((along(SQUARE[:3], 0.1, aside_mm=2.0), away))
    path = graded({"path": {"points_mm": SQUARE}}, way).path
    assert path is not None
    assert path.rms_mm == pytest.approx(2.0, abs=0.2)
    assert path.largest_mm is not None
    assert path.largest_mm < 6.0


def test_covers_a_short_path_in_a_few_states() -> None:
    short = [[376, 137, 25], [376, 137, -28]]
    way = along(short, 0.7)
    assert len(way) < 6
    path = graded({"path": {"points_mm": short, "tolerance_mm": 3}}, way).path
    assert path is not None
    assert path.done_s is not None


def test_only_a_complete_task_is_100_percent() -> None:
    poses = [{"name": f"p{number}", "position_mm": [200 + number, 0, 0], "hold_s": 0.02} for number in range(99)]
    grade = graded({"poses": poses, "path": {"points_mm": SQUARE}}, np.tile([0.2, 0.0, 0.0], (30, 1)))
    assert grade.percent < 100
    assert graded({"poses": poses[:1]}, np.tile([0.2, 0.0, 0.0], (30, 1))).percent == 100


def test_grade_does_not_depend_on_the_block_size() -> None:
    task = {
        "poses": [
            {"name": "a", "position_mm": [300, 0, 0]},
            {"name": "b", "position_mm": [200, 0, 0], "tolerance_mm": 5},
        ],
        "path": {"points_mm": SQUARE},
    }
    noise = np.random.default_rng(5).normal(size=(400, 3)) * 0.001
    way = np.concatenate((along(SQUARE, 0.05), second_order(0.5, 6.0, 4.0, 0.3), second_order(0.5, 6.0, 4.0, 0.2, 0.3)))
    way[:400] += noise[:400] * 0.3
    whole = graded(task, way)
    assert whole.passed
    for pieces in (2, 7, 61, len(way)):
        parts = graded(task, way, pieces=pieces)
        assert parts.lines() == whole.lines()
        assert parts.rank == pytest.approx(whole.rank)


def test_parts_count_if_placed_correctly_in_time() -> None:
    way, task = np.zeros((10, 3)), {"place": {"parts": ["red", "blue", "green"]}, "time_limit_s": 10}
    in_time = graded(task, way, drops={"red": 4.0, "blue": 5.0, "green": 6.0})
    assert [part.placed for part in in_time.parts] == [True, False, False]
    assert in_time.score == pytest.approx(1 / 3)
    assert [part.placed for part in graded(task, way, drops={"red": 14.0}).parts] == [False, False, False]
    only = graded({"place": {"parts": ["red"]}, "time_limit_s": 10}, way, drops={"red": 4.0})
    assert (only.passed, only.done_s, only.error_mm) == (True, 4.0, 0.5)
    assert only.headline() == "passed in 4.0 s of 10 s"


def test_motion_after_the_time_limit_does_not_count() -> None:
    task = STEP_RESPONSE | {"time_limit_s": 0.5}
    grade = graded(task, second_order(0.7, 5.0, 6.0))
    assert (grade.score, grade.headline()) == (0.0, "0 of 1 goals within 0.5 s")


TASK = """
[task]
title = "Two corners"
[[task.poses]]
name = "a"
position_mm = [{x}, {y}, {z}]
tolerance_mm = 300
[task.place]
parts = ["red"]
"""


def test_grades_by_the_recorded_task(tmp_path: Path) -> None:
    script = Script(seconds=6.0)
    made = make(script)
    text = TASK.format(x=400, y=100, z=50)
    path = write(tmp_path / "run.mcap", made, script=script, lab_toml=text)
    summary = summarize(open_run(path))
    assert summary.grade is not None
    assert summary.grade.poses[0].reached_s is not None
    assert summary.grade.score == 0.5
    plain = summary.as_dict()["grade"]
    assert (plain["title"], plain["parts"][0]["placed"]) == ("Two corners", False)
    page = build_report([path]).html
    assert "Two corners" in page
    assert "1 of 2 goals" in page
    # Another task, given later.
    lab = tmp_path / "other.toml"
    lab.write_text("[[task.poses]]\nname = 'far'\nposition_mm = [-300, 0, 0]\n")
    other = summarize(open_run(path), load_task(lab)).grade
    assert other is not None
    assert other.score == 0.0


def test_ranks_runs_by_grade(tmp_path: Path) -> None:
    script = Script(seconds=4.0)
    paths = []
    for name, x in (("never", -400), ("first", 400)):
        made = make(script, session=name)
        for one in made:
            if isinstance(one.message, JointState) and one.message.command_seq:
                one.message.position[:] = inverse(PARAMETERS.arm, (x / 1000, 0.1, 0.0, 0.0))[0]
        text = TASK.format(x=400, y=100, z=0).replace("300", "2")
        paths.append(write(tmp_path / f"{name}.mcap", made, script=script, session=name, lab_toml=text))
    found = build_report(paths)
    assert [run["session"] for run in found.runs] == ["first", "never"]
    assert [run["grade"]["score"] for run in found.runs] == [0.5, 0.0]
    assert found.html.index("1. first") < found.html.index("2. never")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[task]\ntitle = 'x'", "task: a task needs poses, a path or parts to place"),
        ("[[task.poses]]\nname = 'a'", "task.poses[0].position_mm: is missing"),
        ("[[task.poses]]\nname = 'a'\nposition_mm = [1, 2, 3]\n" * 2, "duplicate pose name 'a'"),
        ("[task.path]\npoints_mm = [[1, 2, 3]]", "task.path.points_mm"),
        ("[task.path]\npoints_mm = [[1, 2, 3], [1, 2, 3]]", "points 1 and 2 of the path are the same"),
        ("[task.place]\ntolerance_mm = 0", "task.place.tolerance_mm: must be > 0, got 0"),
        ("[task]\nlimit = 3\n[task.place]", "task.limit: unknown key"),
        ("[[task.poses]]\nname = 'a'\nposition_mm = [900, 0, 0]", "task: pose 'a' is out of reach: "),
        ("[task.path]\npoints_mm = [[300, 0, 0], [700, 0, 0]]", "point 2 of the path, (700, 0, 0) mm, is out of reach"),
        ("[task.path]\npoints_mm = [[300, 0, 0], [300, 0, 400]]", "point 2 of the path, (300, 0, 400) mm, is out of"),
        (
            "[task.place]\nparts = ['pink']",
            "no ferromagnetic part 'pink' in the scene; its ferromagnetic parts: red",
        ),
    ],
)
def test_rejects_an_invalid_task_with_its_key(text: str, says: str) -> None:
    def check() -> None:
        lab_parameters(parse_lab(text), "lab.toml")

    with pytest.raises(InputError) as refused:
        check()
    assert says in str(refused.value)


def test_reports_an_invalid_recorded_task(tmp_path: Path) -> None:
    script = Script(seconds=1.0)
    path = write(tmp_path / "run.mcap", make(script), script=script, lab_toml="[task]\nshade = 'red'\n[task.place]\n")
    with pytest.raises(InputError, match=r"recorded lab\.toml: invalid task: shade: unknown key"):
        recorded_task(open_run(path))


def test_report_skips_an_unreadable_run(tmp_path: Path) -> None:
    script, silent = Script(seconds=1.0), Script(seconds=1.0, controllers=False)
    good = write(tmp_path / "good.mcap", make(script), script=script)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(good.read_bytes()[:5000])
    alone = write(tmp_path / "alone.mcap", make(silent), script=silent)
    found = build_report([torn, good, alone])
    assert [run["latency"]["samples"] > 0 for run in found.runs].count(False) == 1
    assert len(found.runs) == 2
    assert ["torn" in reason for reason in found.left_out] == [True]
    assert "Skipped recordings" in found.html
    with pytest.raises(InputError, match="no readable recording"):
        build_report([torn, torn])


def test_no_goal_is_reached_without_commands(tmp_path: Path) -> None:
    silent = Script(seconds=1.0, controllers=False)
    path = write(tmp_path / "alone.mcap", make(silent), script=silent)
    task = parse_lab("[[task.poses]]\nname = 'a'\nposition_mm = [300, 0, 0]\n").task
    (found,) = build_report([path], task=task).runs
    assert found["grade"]["score"] == 0


def test_drawings_of_the_page_are_those_of_the_script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    committed = draw_grading.IMAGES
    monkeypatch.setattr(draw_grading, "IMAGES", tmp_path)
    draw_grading.main()
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["grade-path.svg", "grade-pose.svg"]
    for path in tmp_path.iterdir():
        assert (committed / path.name).read_text() == path.read_text(), "run: make gen"
        assert f"(images/{path.name})" in (committed.parent / "review.md").read_text()
