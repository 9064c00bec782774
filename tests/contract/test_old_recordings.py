"""Compatibility with old recordings: a file of an earlier version gives the same results as when it was recorded.

`before-columns-of-requests.mcap`: two seconds with a controller, one record per Modbus request. The expected values are
those of the version that recorded it.
"""

from pathlib import Path

import pytest

from hilrig_recorder.mcap_format.recover import recover
from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.verify import verify
from hilrig_replay.io.run import open_run
from support.labs import hilrig

OLD = Path(__file__).parents[1] / "data/before-columns-of-requests.mcap"


def test_reads_all_messages() -> None:
    run = open_run(OLD)
    assert (len(run.states), len(run.commands), len(run.events), len(run.traffic)) == (370, 97, 5, 190)
    assert set(run.traffic["function"]) == {3, 16}
    assert set(run.traffic["exception"]) == {0}
    assert (run.traffic["answered_ns"] > run.traffic["arrived_ns"]).all()
    assert run.names[int(run.traffic["controller"][0])] == run.controller


def test_measures_the_same_latencies() -> None:
    report = measure(open_run(OLD))
    assert report.samples == 94
    assert report.loop_ms is not None
    assert (report.loop_ms.p50, report.loop_ms.max) == pytest.approx((39.999632, 60.0488), abs=1e-6)
    assert (report.lost.transport, report.lost.recorder) == (0, 0)
    assert [(reason.code, reason.text) for reason in report.reasons] == [
        (
            "too_few_samples",
            "only 94 samples: 500 are required for a 99th percentile: record 11 s or longer at your 21 ms period",
        )
    ]
    assert report.age_ms is not None
    assert (report.age_ms.p50, report.age_ms.max) == pytest.approx((40.002267, 80.019113), abs=1e-6)


def test_verifies_the_steps() -> None:
    verification = verify(OLD)
    assert verification.same
    assert (verification.steps, verification.gaps) == (357, 0)


def test_is_complete_and_exports_all_tables(tmp_path: Path) -> None:
    assert recover(OLD, tmp_path / "new.mcap").path is None
    exported = hilrig("export", OLD, "--csv", tmp_path / "tables", "--foxglove", tmp_path / "drawn.mcap")
    assert exported.returncode == 0, exported.stderr
    rows = {path.name: len(path.read_text().splitlines()) - 1 for path in (tmp_path / "tables").iterdir()}
    assert sorted(rows.values()) == [5, 97, 190, 370], rows
