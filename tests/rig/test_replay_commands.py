"""Commands that analyze and show recordings: output, files and exit codes."""

import json
from pathlib import Path

import pytest

from support.labs import hilrig
from support.recordings import Script, make, record, write
from support.rrd_files import RrdFile

pytestmark = pytest.mark.rig


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("runs") / "run.mcap", Script(seconds=12.0))


def test_latency_prints_a_table(run: Path) -> None:
    result = hilrig("latency", run)
    assert result.returncode == 0, result.stderr
    for expected in (
        "loop",
        "register wait",
        "tick wait",
        "p99.9",
        " age ",
        "control period 20.0 ms",
        "valid for latency measurements",
    ):
        assert expected in result.stdout


def test_latency_json_is_the_only_standard_output(run: Path, tmp_path: Path) -> None:
    result = hilrig("latency", run, "--json", "--plot", tmp_path / "latency.png")
    report = json.loads(result.stdout)
    assert report["fit"] is True
    assert report["loop_ms"]["p50"] == pytest.approx(20, abs=0.1)
    assert (tmp_path / "latency.png").stat().st_size > 20_000


def test_latency_of_an_invalid_recording_exits_with_1(tmp_path: Path) -> None:
    result = hilrig("latency", record(tmp_path / "run.mcap", Script(seconds=3.0)))
    assert result.returncode == 1
    assert "not valid for latency measurements" in result.stdout


def test_latency_of_a_folder_reports_unreadable_runs(run: Path, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "good.mcap").write_bytes(run.read_bytes())
    (tmp_path / "torn.mcap").write_bytes(run.read_bytes()[:5000])
    result = hilrig("latency", tmp_path, "--json")
    assert result.returncode == 1
    answer = json.loads(result.stdout)
    assert [each["fit"] for each in answer["runs"]] == [True]
    assert len(answer["unreadable"]) == 1
    assert "truncated" in answer["unreadable"][0]["reason"]


@pytest.mark.parametrize("command", [["latency"], ["replay", "--save", "out.rrd"]])
@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "no such file"), (b"", "empty"), (b"something else" * 10, "not an MCAP file")],
)
def test_unreadable_file_gives_one_error_line(
    command: list[str], content: bytes | None, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    if content is not None:
        path.write_bytes(content)
    result = hilrig(*command, path, cwd=tmp_path)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert f"{path}: " in result.stderr
    assert message in result.stderr


def test_run_without_a_controller_has_no_latency(tmp_path: Path, run: Path) -> None:
    script = Script(seconds=1.0, controllers=False)
    path = write(tmp_path / "alone.mcap", make(script), script=script)
    result = hilrig("latency", path)
    assert (result.returncode, result.stderr) == (1, "")
    assert "no closed loop: no controller wrote commands in this session" in " ".join(result.stdout.split())
    assert "jitter" not in result.stdout
    assert json.loads(hilrig("latency", path, "--json").stdout)["loop_ms"] is None
    assert hilrig("latency", path, "--plot", tmp_path / "plot.png").returncode == 2
    assert hilrig("replay", path, "--save", tmp_path / "run.rrd").returncode == 0
    page = tmp_path / "page.html"
    assert hilrig("report", path, "--out", page).returncode == 0
    assert "recorded manually" in page.read_text()
    compared = hilrig("compare", run, path, "--plot", tmp_path / "both.svg")
    assert compared.returncode == 0, compared.stderr
    assert "no command by a controller; aligned by its start instead" in " ".join(compared.stdout.split())


def test_compare_excludes_unreadable_runs(tmp_path: Path, run: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(run.read_bytes()[:5000])
    done = hilrig("compare", run, run, torn, "--json")
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert (len(found["runs"]), len(found["differences"])) == (2, 1)
    assert [f"{torn}: truncated" in reason for reason in found["left_out"]] == [True]
    assert f"skipped: {torn}: truncated" in hilrig("compare", run, run, torn).stderr
    for others in ([run, torn], [torn, run, run], [run, torn, torn]):
        refused = hilrig("compare", *others)
        assert (refused.returncode, refused.stdout) == (2, "")
        assert f"{torn}: truncated" in refused.stderr


def test_replay_writes_a_file_readable_by_rerun(run: Path, tmp_path: Path) -> None:
    result = hilrig("replay", run, "--save", tmp_path / "run.rrd")
    assert result.returncode == 0, result.stderr
    assert RrdFile(tmp_path / "run.rrd").rows("/position") == 600


@pytest.mark.parametrize(
    "command", ["latency {run}", "latency {run} {run}", "compare {run} {run}", "runs {folder}", "registers", "example"]
)
def test_tables_fit_80_columns(run: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    table = hilrig(*command.format(run=run, folder=run.parent).split()).stdout
    assert max(map(len, table.splitlines())) <= 80
    assert "…" not in table


def test_replay_rejects_save_with_web(run: Path, tmp_path: Path) -> None:
    result = hilrig("replay", run, "--save", tmp_path / "run.rrd", "--web")
    assert result.returncode == 2
    assert "can't be combined" in result.stderr


def test_compare_prints_differences_and_writes_plots(run: Path, tmp_path: Path) -> None:
    slow = record(tmp_path / "slow.mcap", Script(seconds=4.0, delay_ms=40.0))
    result = hilrig("compare", run, slow, "--json", "--plot", tmp_path / "both.png", "--save", tmp_path / "both.rrd")
    assert result.returncode == 0, result.stderr
    (difference,) = json.loads(result.stdout)["differences"]
    assert difference["loop_p50_ms"] == pytest.approx(40, abs=1)
    assert (tmp_path / "both.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "both.rrd").stat().st_size > 100_000
    table = hilrig("compare", run, slow)
    assert "tool distance, rms, mm" in table.stdout


@pytest.mark.parametrize(
    ("command", "option"),
    [("report", "-o"), ("replay", "--save"), ("compare", "--save"), ("compare", "--plot"), ("latency", "--plot")],
)
@pytest.mark.parametrize("name", ["other.mcap", "other.mcap.part", "other.png"])
def test_output_never_replaces_a_recording(run: Path, tmp_path: Path, command: str, option: str, name: str) -> None:
    other = tmp_path / name
    other.write_bytes(run.read_bytes())
    inputs = [run, run] if command == "compare" else [run]
    result = hilrig(command, option, other, *inputs)
    assert result.returncode == 2
    if option != "--plot" or name.endswith(".png"):
        assert f"{other} is a recording and is not overwritten: choose another output name" in result.stderr
    assert other.read_bytes() == run.read_bytes()


def test_report_into_a_missing_folder_is_rejected(run: Path, tmp_path: Path) -> None:
    result = hilrig("report", run, "--out", tmp_path / "nowhere" / "report.html")
    assert result.returncode == 2
    assert "does not exist" in result.stderr
