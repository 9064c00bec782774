"""Recordings of the client role: every evaluation works on them.

`client-role-echo.mcap`: a program every 30 ms that copies the step number, over an emulated network of 4 and 3 ms.
`client-role.mcap`: a program every 50 ms without an echo register. Both follow slow set points for 12 s.
"""

from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.analysis.compare import compare
from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.analysis.stages import CLIENT_STAGES
from hilrig_replay.analysis.verify import verify
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.rerun_view.view import save_rrd
from hilrig_study.live.from_recording import evaluate_gains
from hilrig_study.study_config import AxisConfig, StudyConfig
from support.rrd_files import RrdFile

DATA = Path(__file__).parents[1] / "data"
ECHO, NO_ECHO = "client-role-echo", "client-role"


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    return {name: open_run(DATA / f"{name}.mcap") for name in (ECHO, NO_ECHO)}


@pytest.fixture(scope="module")
def reports(runs: dict[str, Run]) -> dict[str, LatencyReport]:
    return {name: measure(run) for name, run in runs.items()}


@pytest.mark.parametrize("name", [ECHO, NO_ECHO])
def test_stages_add_up_to_the_nanosecond(reports: dict[str, LatencyReport], name: str) -> None:
    table = reports[name].table
    assert reports[name].client_role
    assert list(reports[name].stages_ms) == [stage.key for stage in CLIENT_STAGES]
    assert np.array_equal(sum(table[stage.key] for stage in CLIENT_STAGES), table["loop"])
    assert all((table[stage.key] >= 0).all() for stage in CLIENT_STAGES)


def test_echo_makes_the_latency_exact(reports: dict[str, LatencyReport]) -> None:
    report = reports[ECHO]
    assert (report.is_lower_bound, report.older_positions, report.qualifier) == (False, None, "")
    assert report.device_scan is not None
    assert report.device_scan.scan_ms == pytest.approx(31.7, abs=0.1)
    assert report.stages_ms["injected"].mean == pytest.approx(7.0)
    assert [finding.code for finding in report.findings if finding.list == "timing"] == ["injected_delay"]
    assert [reason.code for reason in report.reasons] == ["too_few_samples"]


def test_without_echo_the_latency_is_a_bound(reports: dict[str, LatencyReport]) -> None:
    report = reports[NO_ECHO]
    assert report.is_lower_bound
    assert report.older_positions is not None
    # Such a device, whose outputs follow its inputs at once, answers positions that are 16 ms older.
    assert (report.older_positions.low_ms, report.older_positions.high_ms) == pytest.approx((16.1, 76.6), abs=0.1)
    assert report.device_scan is None
    assert [reason.code for reason in report.reasons] == ["no_echo"]
    plain = report.as_dict()
    assert plain["is_lower_bound"]
    assert plain["older_positions"] == {
        "low_ms": report.older_positions.low_ms,
        "high_ms": report.older_positions.high_ms,
    }
    assert any("16 to 77 ms older than those of the loop latency" in note for note in report.notes())


def test_requests_of_the_edge_are_recorded(runs: dict[str, Run]) -> None:
    traffic = runs[ECHO].traffic
    functions, counts = np.unique(traffic["function"], return_counts=True)
    assert functions.tolist() == [1, 3, 16]
    assert counts.min() > 0.9 * counts.max()
    # The network of the device delays each direction by 2 ms: that is no stall of the edge.
    answered_ns, arrived_ns = traffic["answered_ns"], traffic["arrived_ns"]
    assert np.median(answered_ns - arrived_ns) > 4e6


@pytest.mark.parametrize("name", [ECHO, NO_ECHO])
def test_viewer_shows_the_stages_of_the_role(runs: dict[str, Run], name: str, tmp_path: Path) -> None:
    save_rrd(runs[name], tmp_path / "run.rrd")
    shown = RrdFile(tmp_path / "run.rrd")
    ends = shown.column("/stages", "scalars")
    assert ends.shape[1] == 1 + len(CLIENT_STAGES)
    assert (np.diff(ends, axis=1) >= 0).all()
    assert shown.static("/stages", "names") == [
        "state sampled",
        *(f"+ {stage.title}" for stage in CLIENT_STAGES[:-1]),
        f"+ {CLIENT_STAGES[-1].title} = loop",
    ]


def test_simulation_is_reproduced_bit_for_bit() -> None:
    assert verify(DATA / f"{ECHO}.mcap", tolerance=1e-6).same


def test_runs_are_compared(runs: dict[str, Run]) -> None:
    found = compare(list(runs.values()))
    assert len(found.differences) == 1


def test_gains_are_evaluated_under_the_recorded_latency(runs: dict[str, Run]) -> None:
    study = StudyConfig(x=AxisConfig(what="delay_ms", values=(0.0,)), y=AxisConfig(what="gain", values=(0.2, 2.0)))
    report = evaluate_gains(runs[ECHO], study)
    assert report.age_ms.mean == pytest.approx(54.7, abs=0.1)
    assert len(report.gains) > 1
