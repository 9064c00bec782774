"""The paper's experiment gives the numbers that are known of it, and its three figures."""

import json
from pathlib import Path

import pytest

from hilrig_runtime.errors import InputError, OperationError
from hilrig_sim.validation.paper_figures import compute, draw


def test_experiment_44_gives_what_is_known_of_it() -> None:
    figures = compute()
    assert figures.reference.end == pytest.approx((0.05000, 0.19998), abs=5e-6)
    assert abs(figures.reference.velocity).max(axis=1) == pytest.approx((0.02502, 0.05767), abs=5e-6)
    assert figures.euler.diverged_s is not None
    assert 2.0 < figures.euler.diverged_s < 3.0
    assert figures.euler.end is None
    assert figures.deviation is not None
    assert figures.deviation <= 2e-6
    limits = figures.limits_ms
    expected = {"euler": 15.4, "rk4": 21.5, "rkf45, order 4": 23.3, "rkf45": 28.4}
    assert limits == pytest.approx(expected, rel=0.01)
    assert all(holds for *_, holds in figures.checks())
    assert json.loads(json.dumps(figures.as_dict()))["methods"]["euler"]["theta_end_rad"] is None


def test_at_a_short_step_euler_stays_and_the_check_says_that_this_is_not_the_paper() -> None:
    figures = compute(step_ms=10.0)
    assert figures.euler.diverged_s is None
    assert not all(holds for *_, holds in figures.checks())


def test_a_step_that_does_not_meet_the_torques_edges_is_refused() -> None:
    for step_ms in (7.0, 0.0, -1.0, 3000.0):
        with pytest.raises(InputError, match="does not divide a second"):
            compute(step_ms)


def test_three_pictures_are_drawn(tmp_path: Path) -> None:
    files = draw(compute(), tmp_path / "new" / "folder")
    assert [path.name for path in files] == ["figure4_euler.png", "figure5_dop853.png", "figure6_rkf45.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000 for path in files)


def test_a_folder_that_cannot_be_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OperationError, match="can't be written"):
        draw(compute(), tmp_path / "file" / "folder")
