"""The table of docs/study-25-100ms.md is that of theory and simulation."""

import re
from pathlib import Path

import numpy as np
import pytest

from hilrig_study.study_config import StudyConfig, load_study
from hilrig_study.sweep import cell_at, run_cells
from hilrig_study.theory.gain_theory import gain_theory
from hilrig_study.theory.margins import STABLE_RADIUS

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"\| (\d+) ms \| (\d+) ms \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|")
"""Loop latency, added delay, stability limit, largest stable gain of the grid, gain of lowest cost, its cost."""


@pytest.fixture(scope="module")
def study() -> StudyConfig:
    return load_study(ROOT / "examples" / "studies" / "pd-25-100ms.toml")


def radius(study: StudyConfig, gain: float, delay_ms: float) -> float:
    found = gain_theory(study, 0, gain, 20.0, 20.0, [delay_ms])
    assert found is not None
    return found[1][delay_ms]


@pytest.mark.parametrize("row", ROW.findall((ROOT / "docs" / "study-25-100ms.md").read_text(encoding="utf-8")))
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


def test_page_has_six_rows() -> None:
    rows = ROW.findall((ROOT / "docs" / "study-25-100ms.md").read_text(encoding="utf-8"))
    assert len(rows) == 6
