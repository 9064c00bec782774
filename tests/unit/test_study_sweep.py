"""A study as a whole: its file, its sweep, a student's controller, its results and pictures."""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from hilrig_cli.main import app
from hilrig_runtime.errors import InputError
from hilrig_study.plots import Dot, plane_figure, traces
from hilrig_study.study_config import StudyConfig, load_study
from hilrig_study.sweep import cell_at, cells_of, run_cells, sweep
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
    ("wrong", "said"),
    [
        (
            '[x]\nwhat = "delay_ms"\nvalues = [-5]\n[y]\nwhat = "gain"\nvalues = [1]',
            "delay_ms must not be negative, found -5",
        ),
        ('[x]\nwhat = "loss"\nvalues = [2]\n[y]\nwhat = "gain"\nvalues = [1]', "share from 0 to 1"),
        ('[x]\nwhat = "gain"\nvalues = [1]\n[y]\nwhat = "gain"\nvalues = [1]', "both sweep gain"),
        ('[x]\nwhat = "gain"\nvalues = [0]\n[y]\nwhat = "loss"\nvalues = [0]', "gain must be positive"),
        ('[x]\nwhat = "gain"\n[y]\nwhat = "loss"\nvalues = [0]', "either values or a range"),
        (SMALL + '[[controllers]]\nkind = "file"', "a file go together"),
        (SMALL + '[[traces]]\nx = 1\ny = 1\ncontroller = "X"', "no controller is called 'X'"),
        (SMALL + "[task]\npose = [0, 0, 0, 0]", "d3"),
        (
            SMALL + "[task]\npose = [132, 0, 80, 0]\noffset = [3, 0, 0, 0]",
            r"task: theta1 would start at 135 \(pose 132, offset 3\): expected -133 to 133",
        ),
        (SMALL.replace("duration_s = 3", "compute_ms = 30"), "its period must be longer"),
        (SMALL + '[impairment]\ncommand = "uniform:40,10"', "low_ms 40 is above high_ms 10"),
        (SMALL + "[task]\noffset = [200, 0, 0, 0]", "theta1"),
        ("x = 3 =", "no valid TOML"),
    ],
)
def test_a_mistake_in_a_studys_file_is_named(tmp_path: Path, wrong: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load(tmp_path, wrong)


def test_a_trace_with_a_gap_is_refused_with_its_line(tmp_path: Path) -> None:
    trace = tmp_path / "trace.txt"
    trace.write_text("20\n30\n\n25\n")
    with pytest.raises(InputError, match="line 3"):
        load(tmp_path, SMALL + f"[impairment]\ncommand = 'trace:{trace}'")


def test_the_examples_are_studies() -> None:
    for path in sorted((ROOT / "examples" / "studies").glob("*.toml")):
        assert load_study(path).title


def test_a_sweep_gives_the_same_on_one_core_and_on_two_and_as_its_cells_alone(tmp_path: Path) -> None:
    study = load(
        tmp_path, 'runs = 2\nimpairment = { command = "uniform:0,50" }\n' + SMALL.replace("title", "\ntitle", 1)
    )
    shares: list[float] = []
    two = sweep(study, tmp_path, shares.append, workers=2, theory=False)
    cells = cells_of(study)
    alone, _ = run_cells(study, cells[3:4])
    assert two.results[3].tobytes() == alone[0].tobytes()
    together, _ = run_cells(study, cells)
    assert two.results.tobytes() == together.tobytes()
    assert shares[-1] == 1.0
    # Runs of a cell differ in what is drawn.
    assert together["cost"][0] != together["cost"][1]


def test_what_theory_says_stands_beside_what_the_runs_did(tmp_path: Path) -> None:
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
    # The boundary is a tick's: phase, computing and transport leave 13.6 ms of the first step.
    assert (high.stable_until_ms - 13.6) % 20 == pytest.approx(0, abs=0.05) or high.stable_until_ms == pytest.approx(
        13.6, abs=0.05
    )
    assert low.nominal is not None
    assert low.nominal.jitter_margin_s < low.nominal.delay_margin_s


def test_where_delays_are_drawn_the_boundary_is_that_of_the_second_moments(tmp_path: Path) -> None:
    delays = [0.0, 30.0, 60.0, 90.0, 120.0]
    text = SMALL.replace("[0, 40, 150]", str(delays)) + '[impairment]\ncommand = "uniform:0,75"\n'
    study = load(tmp_path, text.replace("[0.3, 0.9]", "[0.3, 0.65, 1.5]"))
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    slack, middle, stiff = swept.theory
    assert (slack.mean_square_until, stiff.mean_square_until) == (np.inf, -1)
    assert middle.mean_square_until in delays
    # The same loop on the linear arm, for long: below the boundary it dies out, well above it grows.
    assert 0 < middle.mean_square_until < 100
    for delay_ms, dies_out in ((middle.mean_square_until - 20, True), (middle.mean_square_until + 50, False)):
        plane = {
            "x": study.x.model_copy(update={"values": (delay_ms,)}),
            "y": study.y.model_copy(update={"values": (0.65,)}),
        }
        long = study.model_copy(
            update={**plane, "plant": "linear", "loop": study.loop.model_copy(update={"duration_s": 40.0})}
        )
        results, _ = run_cells(long, cells_of(long)[:1], tmp_path)
        assert bool(results["settled"][0]) is dies_out
    figure = plane_figure(study, swept, 0)
    assert "stable in the mean square" in {text.get_text() for text in figure.legends[0].get_texts()}


def test_where_nothing_is_drawn_or_the_law_predicts_there_is_no_such_boundary(tmp_path: Path) -> None:
    predicts = '[[controllers]]\nname = "LQR"\nkind = "lqr"\nimpairment = { command = "uniform:0,40" }\n'
    study = load(tmp_path, SMALL + predicts + '[[controllers]]\nkind = "pd"\n')
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    assert np.isnan([one.mean_square_until for one in swept.theory]).all()


def test_what_is_unstable_by_itself_is_a_clear_result(tmp_path: Path) -> None:
    study = load(tmp_path, SMALL.replace("values = [0.3, 0.9]", "values = [3.0]"))
    (theory,) = sweep(study, tmp_path, lambda _: None, workers=1).theory
    assert theory.stable_until_ms == -1
    assert theory.nominal is not None
    assert not theory.nominal.stable


def test_steps_and_periods_can_be_swept(tmp_path: Path) -> None:
    text = SMALL.replace('what = "gain"', 'what = "step_ms"').replace("[0.3, 0.9]", "[10, 20]")
    study = load(tmp_path, text)
    cells = cells_of(study)
    assert set(zip(cells["step_ms"].tolist(), cells["poll_ms"].tolist(), strict=True)) == {(10, 10), (20, 20)}
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    assert set(swept.results["loop_p50_ms"][cells["delay_ms"] == 0].tolist()) == {10.0, 20.0}


# -- a student's file --------------------------------------------------------------------------------------------------


def student(folder: Path, body: str, head: str = "") -> StudyConfig:
    text = f"{head}\nclass Controller:\n    def __init__(self, period_s, gain):\n        self.gain = gain\n"
    text += f"    def update(self, time_s, position, goal, latency_s):\n        {body}\n"
    (folder / "mine.py").write_text(text)
    return load(folder, SMALL + '[[controllers]]\nname = "mine"\nkind = "file"\nfile = "mine.py"')


def run_first(study: StudyConfig, folder: Path) -> np.ndarray:
    return run_cells(study, cell_at(study, 0.0, 0.3), folder)[0]


def test_the_example_controller_brings_the_arm_to_rest(tmp_path: Path) -> None:
    (tmp_path / "pd.py").write_text((ROOT / "examples" / "controllers" / "pd.py").read_text())
    text = SMALL.replace("duration_s = 3", "duration_s = 6")
    study = load(tmp_path, text + '[[controllers]]\nname = "mine"\nkind = "file"\nfile = "pd.py"')
    results, _ = run_cells(study, cell_at(study, 0.0, 0.5), tmp_path)
    assert results["settled"][0]


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("return [1 / 0] * 4", r"mine\.py, line 6: Controller.update raised ZeroDivisionError.* at 0.005 s of the run"),
        ("return [float('nan')] * 4", "must give four finite numbers"),
        ("return [0, 0]", r"gave \[0, 0\]"),
        ("return None", "gave None"),
        ("return 'torque'", "gave 'torque'"),
    ],
)
def test_a_students_mistake_is_told_with_file_line_and_time(tmp_path: Path, body: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        run_first(student(tmp_path, body), tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import no_such_module", "can't be run: ModuleNotFoundError"),
        ("x = 1", "has no class Controller"),
        ("class Controller: pass", "has no class Controller with a method update"),
        ("class Controller:\n    def update(self): pass", "__init__ raised TypeError"),
    ],
)
def test_a_file_that_is_no_controller_is_refused(tmp_path: Path, text: str, said: str) -> None:
    study = student(tmp_path, "return [0] * 4")
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(InputError, match=said):
        run_first(study, tmp_path)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    study = student(tmp_path, "return [0] * 4")
    (tmp_path / "mine.py").unlink()
    with pytest.raises(InputError, match=r"mine\.py: a controller is a Python file"):
        run_first(study, tmp_path)


def test_each_run_has_an_object_of_its_own(tmp_path: Path) -> None:
    body = "self.n = getattr(self, 'n', 0) + 1; return [self.n * 1e-3 * self.gain, 0, -4.905, 0]"
    study = student(tmp_path, body)
    cells = cells_of(study)
    _, outcome = run_cells(study, cells, tmp_path, keep=True)
    first, last = outcome.efforts[20, 0, 0], outcome.efforts[20, 0, 3]
    assert last == pytest.approx(first * 3, abs=0.002)


# -- results and pictures ----------------------------------------------------------------------------------------------


def test_the_picture_has_theory_traces_and_dots(tmp_path: Path) -> None:
    study = load(tmp_path, SMALL + "[[traces]]\nx = 0\ny = 0.3\n[[traces]]\nx = 150\ny = 0.9")
    shown = traces(study, tmp_path)
    assert [trace.letter for trace in shown] == ["A", "B"]
    assert "rest" in shown[0].outcome
    swept = sweep(study, tmp_path, lambda _: None, workers=1)
    figure = plane_figure(study, swept, 0, shown, [Dot(0, 0.3, True), Dot(40, 0.9, False)])
    texts = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"exact: spectral radius 1", "delay margin", "live: as predicted", "live: not as predicted"} <= texts


def test_the_command_leaves_table_json_pictures_and_a_rerun_file(tmp_path: Path) -> None:
    write(tmp_path, SMALL + "[[traces]]\nx = 0\ny = 0.3")
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["study", str(tmp_path / "study.toml"), "--out", str(out), "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["runs"] == 6
    assert json.loads((out / "study.json").read_text()) == said
    table = pyarrow.parquet.read_table(out / "runs.parquet")
    assert table.num_rows == 6
    # The page says what each column is, and of no other.
    page = (ROOT / "docs/studies.md").read_text(encoding="utf-8").split("| column of `runs.parquet` |")[1]
    cells = [line.split("|")[1] for line in page.split("\n\n")[0].splitlines()[2:]]
    assert set(re.findall(r"`(\w+)`", "".join(cells))) == set(table.column_names)
    assert (out / "plane-1.png").stat().st_size > 10_000
    assert (out / "plane-1.svg").read_text().startswith("<?xml")
    assert RrdFile(out / "study.rrd").rows("/trace/A/error/θ1") == 150


def test_a_students_file_can_be_named_on_the_command_line(tmp_path: Path) -> None:
    path, example = write(tmp_path), ROOT / "examples" / "controllers" / "pd.py"
    arguments = ["study", str(path), "--controller", str(example), "--out", str(tmp_path / "out"), "--json"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    controllers = json.loads(done.stdout)["controllers"]
    assert [controller["name"] for controller in controllers] == ["PD", "pd"]
    assert controllers[1]["theory"] == []
    assert (tmp_path / "out" / "plane-2.png").exists()


def test_the_command_says_what_is_missing(tmp_path: Path) -> None:
    path = write(tmp_path)
    for arguments, said in (
        ([], "STUDY.TOML or --from RUN.MCAP is required"),
        ([str(path), "--live"], "the study has none"),
        ([str(path), "--live", "--from", "x.mcap"], "can't be combined"),
    ):
        done = CliRunner().invoke(app, ["study", *arguments])
        assert isinstance(done.exception, InputError), done.output
        assert said in str(done.exception)
