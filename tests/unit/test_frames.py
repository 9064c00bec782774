"""Data frames of a run and of a latency report: columns, values, and the error without the library."""

import sys

import numpy as np
import pytest

from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.samples import SAMPLE_DTYPE
from hilrig_replay.io.run import Run, open_run
from hilrig_runtime.errors import InputError, OperationError
from support.recordings import CONTROLLER, Script, record


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return open_run(record(tmp_path_factory.mktemp("run") / "run.mcap", Script(seconds=2.0)))


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_frames_have_the_recorded_values(run: Run, library: str) -> None:
    pytest.importorskip(library, reason=f"needs {library}: pip install '.[frames]'")
    states = run.frame("state", library)
    assert type(states).__module__.startswith(library)
    assert states.shape[0] == len(run.states)
    np.testing.assert_array_equal(states["position_d3"].to_numpy(), run.states["position"][:, 2])
    np.testing.assert_array_equal(states["time_s"].to_numpy(), run.time_s(run.states))
    assert set(run.frame("command", library)["controller"].to_list()) == {CONTROLLER}
    assert next(iter(run.frame("event", library)["kind"])) == "SESSION_START"
    assert run.frame("traffic", library).shape[0] == len(run.traffic)


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_frame_of_a_report_has_its_samples(run: Run, library: str) -> None:
    pytest.importorskip(library, reason=f"needs {library}: pip install '.[frames]'")
    report = measure(run)
    samples = report.frame(library)
    assert list(samples.columns) == list(SAMPLE_DTYPE.names or ())
    np.testing.assert_array_equal(samples["loop"].to_numpy(), report.table["loop"])


def test_missing_library_names_the_extra(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "polars", None)
    for frame in (lambda: run.frame("state", "polars"), lambda: measure(run).frame("polars")):
        with pytest.raises(OperationError, match=r"polars is not installed: .* install '\.\[frames\]'"):
            frame()


def test_unknown_names_are_refused(run: Run) -> None:
    with pytest.raises(InputError, match="table: expected one of state, command, event, traffic, got 'states'"):
        run.frame("states")
    with pytest.raises(InputError, match="library: expected one of pandas, polars, got 'dask'"):
        run.frame("state", "dask")
