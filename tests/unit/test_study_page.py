"""The table of docs/study-25-100ms.md is that of theory and simulation."""

import re
from pathlib import Path

import numpy as np
import pytest

from hilrig_study.results import cost_interval
from hilrig_study.study_config import AxisConfig, StudyConfig, load_study
from hilrig_study.sweep import SweepResult, cell_at, run_cells, sweep
from hilrig_study.theory.gain_theory import gain_theory
from hilrig_study.theory.margins import STABLE_RADIUS

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"\| (\d+) ms \| (\d+) ms \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|")
"""Loop latency, added delay, stability limit, largest stable gain of the grid, gain of lowest cost, its cost."""
JITTER_ROW = re.compile(r"\| (\d+) ms \| (\d+), (\d+) ms \| up to ([\d.]+) \| ([\d.]+) ± ([\d.]+) \| ([\d.]+) \|")
"""Added delay, loop latency p50 and p99, largest gain that settles in all runs, cost at gain 0.5, without jitter."""
PAGE = (ROOT / "docs" / "study-25-100ms.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def study() -> StudyConfig:
    return load_study(ROOT / "examples" / "studies" / "pd-25-100ms.toml")


def radius(study: StudyConfig, gain: float, delay_ms: float) -> float:
    found = gain_theory(study, 0, gain, 20.0, 20.0, [delay_ms])
    assert found is not None
    return found[1][delay_ms]


@pytest.mark.parametrize("row", ROW.findall(PAGE))
def test_row_of_the_page_is_recomputed(study: StudyConfig, row: tuple[str, ...]) -> None:
    latency_ms, delay_ms, limit, stable, best, cost = map(float, row)
    assert radius(study, limit - 0.001, delay_ms) < STABLE_RADIUS <= radius(study, limit + 0.001, delay_ms)
    grid = study.y.points
    assert stable == pytest.approx(max(gain for gain in grid if gain < limit))
    cells = np.concatenate([cell_at(study, delay_ms, gain) for gain in (stable, best)])
    results, _ = run_cells(study, cells)
    assert results["settled"].all()
    assert results["loop_p50_ms"][0] == latency_ms
    assert results["cost"][1] == pytest.approx(cost, abs=0.006)


def test_page_has_six_rows_and_five_with_jitter() -> None:
    assert (len(ROW.findall(PAGE)), len(JITTER_ROW.findall(PAGE))) == (6, 5)


@pytest.fixture(scope="module")
def jitter(study: StudyConfig) -> tuple[StudyConfig, SweepResult]:
    """The PD without and with jitter, at the delays of the table and at all gains."""
    delays = tuple(float(row[0]) for row in JITTER_ROW.findall(PAGE))
    chosen = {"x": AxisConfig(what="delay_ms", values=delays), "controllers": study.controllers[:2]}
    some = study.model_copy(update=chosen)
    return some, sweep(some, ROOT, lambda _: None, workers=1, theory=False)


@pytest.mark.parametrize("column", range(5))
def test_row_with_jitter_is_recomputed(jitter: tuple[StudyConfig, SweepResult], column: int) -> None:
    study, swept = jitter
    _, p50, p99, stable, mean, half_width, constant = map(float, JITTER_ROW.findall(PAGE)[column])
    gains, cells, results = np.array(study.y.points), swept.cells, swept.results
    half, rows = int(np.argmin(np.abs(gains - 0.5))), (cells["controller"] == 1) & (cells["ix"] == column)
    at_half = rows & (cells["iy"] == half)
    assert at_half.sum() == 3
    p50_ms, p99_ms = results["loop_p50_ms"][at_half], results["loop_p99_ms"][at_half]
    assert (np.median(p50_ms), np.median(p99_ms)) == (p50, p99)
    settled = np.array([results["settled"][rows & (cells["iy"] == row)].all() for row in range(len(gains))])
    assert gains[1:][~settled[1:]].min() == pytest.approx(stable + 0.05)
    found = cost_interval(study, swept, 1)
    assert found is not None
    assert found["mean"][half, column] == pytest.approx(mean, abs=0.006)
    assert found["half_width"][half, column] == pytest.approx(half_width, abs=0.006)
    # Student's quantile for three runs is 4.303.
    costs = results["cost"][at_half]
    assert found["half_width"][half, column] == pytest.approx(4.303 * costs.std(ddof=1) / np.sqrt(3), rel=1e-3)
    alone = (cells["controller"] == 0) & (cells["ix"] == column) & (cells["iy"] == half)
    assert results["cost"][alone] == pytest.approx(constant, abs=0.006)
    assert cost_interval(study, swept, 0) is None
