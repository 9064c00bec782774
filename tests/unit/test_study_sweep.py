"""Study: file validation, sweep, user-written controllers, results and plots."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from hilrig_cli.main import app
from hilrig_runtime.errors import InputError
from hilrig_study.controllers import user_controller
from hilrig_study.plots import Marker, plane_figure, traces
from hilrig_study.results import PROVENANCE, provenance, settled_interval
from hilrig_study.study_config import StudyConfig, load_study
from hilrig_study.sweep import all_cells, cell_at, run_cells, sweep
from support.in_process import hilrig_in_process
from support.rrd_files import RrdFile

ROOT = Path(__file__).parents[2]
SMALL = """
title = "Small"
[loop]
duration_s = 3
[x]
what = "delay_ms"
values = [0, 40, 150]
[y]
what = "gain"
values = [0.3, 0.9]
"""


def write(folder: Path, text: str = SMALL) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


def load(folder: Path, text: str = SMALL) -> StudyConfig:
    return load_study(write(folder, text))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            '[x]\nwhat = "delay_ms"\nvalues = [-5]\n[y]\nwhat = "gain"\nvalues = [1]',
            "delay_ms must be ≥ 0, got -5",
        ),
        ('[x]\nwhat = "loss"\nvalues = [2]\n[y]\nwhat = "gain"\nvalues = [1]', "loss must be between 0 and 1, got 2"),
        ('[x]\nwhat = "gain"\nvalues = [1]\n[y]\nwhat = "gain"\nvalues = [1]', "x and y sweep the same parameter gain"),
        ('[x]\nwhat = "gain"\nvalues = [0]\n[y]\nwhat = "loss"\nvalues = [0]', "gain must be > 0, got 0"),
        ('[x]\nwhat = "gain"\n[y]\nwhat = "loss"\nvalues = [0]', "exactly one of values and range"),
        (SMALL + '[[controllers]]\nkind = "file"', 'kind = "file" requires the key file'),
        (SMALL + '[[traces]]\nx = 1\ny = 1\ncontroller = "X"', "unknown controller 'X': expected one of PD"),
        (SMALL + "[task]\npose = [0, 0, 0, 0]", "d3"),
        (
            SMALL + "[task]\npose = [132, 0, 80, 0]\noffset = [3, 0, 0, 0]",
            r"task: theta1 must start between its stops -133 and 133, got 135 \(pose 132 \+ offset 3\)",
        ),
        (SMALL.replace("duration_s = 3", "compute_ms = 30"), "poll period must be longer"),
        (SMALL + '[impairment]\ncommand = "uniform:40,10"', "low_ms must be ≤ high_ms, got 40 and 10"),
        (SMALL + "[task]\noffset = [200, 0, 0, 0]", "theta1"),
        ("x = 3 =", "invalid TOML"),
    ],
)
def test_reports_invalid_study_file(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        load(tmp_path, text)


def test_reports_line_of_gap_in_delay_trace(tmp_path: Path) -> None:
    trace = tmp_path / "trace.txt"
    trace.write_text("20\n30\n\n25\n")
    with pytest.raises(InputError, match="line 3"):
        load(tmp_path, SMALL + f"[impairment]\ncommand = 'trace:{trace}'")


def test_example_studies_are_valid() -> None:
    for path in sorted((ROOT / "examples" / "studies").glob("*.toml")):
        assert load_study(path).title


def test_sweep_does_not_depend_on_number_of_cores(tmp_path: Path) -> None:
    study = load(
        tmp_path, 'runs = 2\nimpairment = { command = "uniform:0,50" }\n' + SMALL.replace("title", "\ntitle", 1)
    )
    fractions: list[float] = []
    two = sweep(study, tmp_path, fractions.append, workers=2, theory=False)
    cells = all_cells(study)
    alone, _ = run_cells(study, cells[3:4])
    assert two.results[3].tobytes() == alone[0].tobytes()
    together, _ = run_cells(study, cells)
    assert two.results.tobytes() == together.tobytes()
    assert fractions[-1] == 1.0
    # Runs of a cell differ in their random draws.
    assert together["cost"][0] != together["cost"][1]


def test_theory_agrees_with_simulated_runs(tmp_path: Path) -> None:
    study = load(tmp_path)
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    radius = swept.plane(study, 0, swept.radius)
    settled = swept.plane(study, 0, swept.results["settled"])
    assert (radius[0] < 1).all()
    assert settled[0].all()
    assert radius[1, 0] < 1 < radius[1, 2]
    assert not settled[1, 2]
    low, high = swept.theory
    assert low.stable_until_ms == np.inf
    # The limit is at a tick: phase, computation and transport leave 13.6 ms of the first step.
    assert (high.stable_until_ms - 13.6) % 20 == pytest.approx(0, abs=0.05) or high.stable_until_ms == pytest.approx(
        13.6, abs=0.05
    )
    assert low.nominal is not None
    assert low.nominal.jitter_margin_s < low.nominal.delay_margin_s


def test_random_delays_have_mean_square_limit(tmp_path: Path) -> None:
    delays = [0.0, 30.0, 60.0, 90.0, 120.0]
    text = SMALL.replace("[0, 40, 150]", str(delays)) + '[impairment]\ncommand = "uniform:0,75"\n'
    study = load(tmp_path, text.replace("[0.3, 0.9]", "[0.3, 0.65, 1.5]"))
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    slack, middle, stiff = swept.theory
    assert (slack.mean_square_until, stiff.mean_square_until) == (np.inf, -1)
    assert middle.mean_square_until in delays
    # Long run of the same loop on the linear plant: it decays below the limit and grows well above it.
    assert 0 < middle.mean_square_until < 100
    for delay_ms, settles in ((middle.mean_square_until - 20, True), (middle.mean_square_until + 50, False)):
        plane = {
            "x": study.x.model_copy(update={"values": (delay_ms,)}),
            "y": study.y.model_copy(update={"values": (0.65,)}),
        }
        long = study.model_copy(
            update={**plane, "plant": "linear", "loop": study.loop.model_copy(update={"duration_s": 40.0})}
        )
        results, _ = run_cells(long, all_cells(long)[:1], tmp_path)
        assert bool(results["settled"][0]) is settles
    figure = plane_figure(study, swept, 0)
    assert "mean-square stability limit" in {text.get_text() for text in figure.legends[0].get_texts()}


def test_no_mean_square_limit_for_constant_delay_or_lqr(tmp_path: Path) -> None:
    predictor = '[[controllers]]\nname = "LQR"\nkind = "lqr"\nimpairment = { command = "uniform:0,40" }\n'
    study = load(tmp_path, SMALL + predictor + '[[controllers]]\nkind = "pd"\n')
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    assert np.isnan([one.mean_square_until for one in swept.theory]).all()


def test_loop_unstable_without_delay_has_limit_minus_one(tmp_path: Path) -> None:
    study = load(tmp_path, SMALL.replace("values = [0.3, 0.9]", "values = [3.0]"))
    (theory,) = sweep(study, tmp_path, lambda _: None, workers=1).theory
    assert theory.stable_until_ms == -1
    assert theory.nominal is not None
    assert not theory.nominal.stable


def test_sweeps_step_and_poll_period(tmp_path: Path) -> None:
    text = SMALL.replace('what = "gain"', 'what = "step_ms"').replace("[0.3, 0.9]", "[10, 20]")
    study = load(tmp_path, text)
    cells = all_cells(study)
    assert set(zip(cells["step_ms"].tolist(), cells["poll_ms"].tolist(), strict=True)) == {(10, 10), (20, 20)}
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    loop_ms, undelayed = swept.results["loop_p50_ms"], cells["delay_ms"] == 0
    assert set(loop_ms[undelayed].tolist()) == {10.0, 20.0}


# -- user-written controller ------------------------------------------------------------------------------------------


def user_study(folder: Path, body: str, head: str = "") -> StudyConfig:
    text = f"{head}\nclass Controller:\n    def __init__(self, period_s, gain):\n        self.gain = gain\n"
    text += f"    def update(self, time_s, position, goal, latency_s):\n        {body}\n"
    (folder / "mine.py").write_text(text)
    return load(folder, SMALL + '[[controllers]]\nname = "mine"\nkind = "file"\nfile = "mine.py"')


def run_first(study: StudyConfig, folder: Path) -> np.ndarray:
    return run_cells(study, cell_at(study, 0.0, 0.3), folder)[0]


def test_example_controller_settles(tmp_path: Path) -> None:
    (tmp_path / "pd.py").write_text((ROOT / "examples" / "controllers" / "pd.py").read_text())
    text = SMALL.replace("duration_s = 3", "duration_s = 6")
    study = load(tmp_path, text + '[[controllers]]\nname = "mine"\nkind = "file"\nfile = "pd.py"')
    results, _ = run_cells(study, cell_at(study, 0.0, 0.5), tmp_path)
    assert results["settled"][0]


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("return [1 / 0] * 4", r"mine\.py, line 6: Controller.update raised ZeroDivisionError.* at t = 0.005 s"),
        ("return [float('nan')] * 4", "must return four finite numbers"),
        ("return [0, 0]", r"got \[0, 0\]"),
        ("return None", "got None"),
        ("return 'torque'", "got 'torque'"),
        ("raise SystemExit(0)", r"mine\.py, line 6: Controller.update ended the process \(exit code 0\).* at t ="),
        ("__import__('sys').exit()", r"mine\.py, line 6: Controller.update ended the process \(exit code None\)"),
        ("__import__('os')._exit(0)", r"mine\.py, line 6: Controller.update ended the process \(exit code 0\)"),
    ],
)
def test_reports_controller_error_with_line_and_time(tmp_path: Path, body: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        run_first(user_study(tmp_path, body), tmp_path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import no_such_module", "import failed: ModuleNotFoundError"),
        ("x = 1", "no class Controller"),
        ("class Controller: pass", "no class Controller with a method update"),
        ("class Controller:\n    def update(self): pass", "__init__ raised TypeError"),
    ],
)
def test_rejects_file_without_controller(tmp_path: Path, text: str, expected: str) -> None:
    study = user_study(tmp_path, "return [0] * 4")
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(InputError, match=expected):
        run_first(study, tmp_path)


@pytest.mark.parametrize("text", ["while True: pass", "import time; time.sleep(60)", "import os; os._exit(0)"])
def test_file_that_does_not_load_is_reported(tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(user_controller, "TIME_LIMIT_S", 0.2)
    study = user_study(tmp_path, "return [0] * 4")
    (tmp_path / "mine.py").write_text(f"\n{text}\n")
    with pytest.raises(InputError, match=r"mine\.py, line 2: import failed: (did not return within|ended the process)"):
        run_first(study, tmp_path)


def test_endless_update_is_reported_with_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(user_controller, "TIME_LIMIT_S", 0.2)
    before = os._exit, signal.getsignal(signal.SIGALRM)
    body = "\n        ".join(("while True:", "    try: pass", "    except Exception: pass"))
    with pytest.raises(InputError, match=r"mine\.py, line [678]: Controller.update did not return within 0\.2 s"):
        run_first(user_study(tmp_path, body), tmp_path)
    assert (os._exit, signal.getsignal(signal.SIGALRM)) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_code_that_no_exception_ends_ends_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import itertools\nsum(itertools.repeat(0))\n")
    load = "controller.TIME_LIMIT_S = 0.5; controller.UserController(pathlib.Path('mine.py'), 0.02)"
    code = f"import pathlib; from hilrig_study.controllers import user_controller as controller; {load}"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=False, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert 'mine.py", line 2 in <module>' in done.stderr


def test_reports_missing_controller_file(tmp_path: Path) -> None:
    study = user_study(tmp_path, "return [0] * 4")
    (tmp_path / "mine.py").unlink()
    with pytest.raises(InputError, match=r"mine\.py: not a readable Python file"):
        run_first(study, tmp_path)


def test_each_run_has_its_own_controller_instance(tmp_path: Path) -> None:
    body = "self.n = getattr(self, 'n', 0) + 1; return [self.n * 1e-3 * self.gain, 0, -4.905, 0]"
    study = user_study(tmp_path, body)
    cells = all_cells(study)
    _, outcome = run_cells(study, cells, tmp_path, keep=True)
    first, last = outcome.efforts[20, 0, 0], outcome.efforts[20, 0, 3]
    assert last == pytest.approx(first * 3, abs=0.002)


# -- results and plots ------------------------------------------------------------------------------------------------


def test_plot_has_theory_traces_and_markers(tmp_path: Path) -> None:
    study = load(tmp_path, SMALL + "[[traces]]\nx = 0\ny = 0.3\n[[traces]]\nx = 150\ny = 0.9")
    shown = traces(study, tmp_path)
    assert [trace.letter for trace in shown] == ["A", "B"]
    assert shown[0].outcome == "settles"
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    figure = plane_figure(study, swept, 0, shown, [Marker(0, 0.3, True), Marker(40, 0.9, False)])
    texts = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"exact: spectral radius 1", "delay margin", "live: as predicted", "live: not as predicted"} <= texts


def test_command_writes_all_result_files(tmp_path: Path) -> None:
    write(tmp_path, SMALL + "[[traces]]\nx = 0\ny = 0.3")
    out = tmp_path / "out"
    done = hilrig_in_process("study", tmp_path / "study.toml", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["runs"] == 6
    assert {"schema": "hilrig.study/1", **json.loads((out / "study.json").read_text())} == summary
    assert summary["controllers"][0]["settled_interval"] is None
    assert summary["controllers"][0]["cost"] is None
    table = pyarrow.parquet.read_table(out / "runs.parquet")
    assert table.num_rows == 6
    # The page documents exactly the columns of the table.
    page = (ROOT / "docs/studies.md").read_text(encoding="utf-8").split("| column of `runs.parquet` |")[1]
    cells = [line.split("|")[1] for line in page.split("\n\n")[0].splitlines()[2:]]
    assert set(re.findall(r"`(\w+)`", "".join(cells))) == set(table.column_names)
    origin = json.loads(table.schema.metadata[b"hilrig"])
    assert origin == {name: summary[name] for name in PROVENANCE}
    assert origin["units"] == {field.name: field.metadata[b"unit"].decode() for field in table.schema}
    assert (origin["seed"], origin["controller_sha256"]) == (1, {})
    assert origin["versions"]["numpy"] == np.__version__
    assert abs((datetime.now(UTC) - datetime.fromisoformat(origin["date"])).total_seconds()) < 600
    assert (out / "plane-1.png").stat().st_size > 10_000
    assert (out / "plane-1.svg").read_text().startswith("<?xml")
    assert RrdFile(out / "study.rrd").rows("/trace/A/error/θ1") == 150


def test_results_have_the_hash_of_each_controller_file(tmp_path: Path) -> None:
    program = (ROOT / "examples/controllers/pd.py").read_bytes()
    (tmp_path / "mine.py").write_bytes(program)
    study = load(tmp_path, SMALL + '[[controllers]]\nname = "mine"\nkind = "file"\nfile = "mine.py"\n')
    assert provenance(study, tmp_path)["controller_sha256"] == {"mine": hashlib.sha256(program).hexdigest()}


def test_growing_error_is_not_settled(tmp_path: Path) -> None:
    # The loop grows by 0.2 % a step: after 10 s the error is still less than half of the offset.
    text = SMALL.replace("duration_s = 3", "duration_s = 10").replace("[0, 40, 150]", "[81]")
    study = load(tmp_path, text.replace("[0.3, 0.9]", "[0.6, 0.65]"))
    found = sweep(study, tmp_path, lambda _: None, workers=1)
    assert found.radius[1] == pytest.approx(1.002, abs=0.002)
    assert np.isnan(found.results["failed_s"]).all()
    assert found.results["settled"].tolist() == [True, False]


def test_settled_share_of_random_runs_has_an_interval(tmp_path: Path) -> None:
    study = load(tmp_path, "runs = 4" + SMALL.replace("delay_ms", "jitter_ms"))
    found = sweep(study, tmp_path, lambda _: None, workers=1, theory=False)
    low, high = settled_interval(found, 0) or (1.0, 0.0)
    share = found.results["settled"].mean()
    assert low <= share <= high
    assert high - low > 0.1


def test_command_accepts_controller_file(tmp_path: Path) -> None:
    path, example = write(tmp_path), ROOT / "examples" / "controllers" / "pd.py"
    done = hilrig_in_process("study", path, "--controller", example, "--out", tmp_path / "out", "--json")
    assert done.returncode == 0, done.stderr
    controllers = json.loads(done.stdout)["controllers"]
    assert [controller["name"] for controller in controllers] == ["PD", "pd"]
    assert controllers[1]["theory"] == []
    assert (tmp_path / "out" / "plane-2.png").exists()


def test_command_reports_missing_arguments(tmp_path: Path) -> None:
    path = write(tmp_path)
    for arguments, expected in (
        ([], "STUDY.TOML or --from RUN.MCAP is required"),
        ([str(path), "--live"], "the study has none"),
        ([str(path), "--live", "--from", "x.mcap"], "can't be combined"),
    ):
        done = CliRunner().invoke(app, ["study", *arguments])
        assert isinstance(done.exception, InputError), done.output
        assert expected in str(done.exception)
