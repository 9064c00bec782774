"""A recording whose evaluation fails in any way is one line of a list; the other recordings are evaluated."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import typer

from hilrig_cli.commands import compare as compare_command
from hilrig_cli.commands import latency as latency_command
from hilrig_cli.commands import recover as recover_command
from hilrig_cli.commands import report as report_command
from hilrig_cli.commands import runs as runs_command
from hilrig_cli.commands import verify as verify_command
from hilrig_console.catalog import ListWorker
from hilrig_replay.analysis.data_quality import DataQuality
from hilrig_replay.io.isolation import isolated
from hilrig_replay.io.run import Run
from hilrig_runtime.errors import HilrigError, InputError
from support.recordings import Script, record

ERRORS = (
    IndexError("index 0 is out of bounds"),
    ZeroDivisionError("division by zero"),
    RecursionError("maximum recursion depth exceeded"),
    OverflowError("int too big to convert"),
    OSError(5, "Input/output error"),
    MemoryError(),
)


@pytest.fixture
def recordings(tmp_path: Path) -> list[Path]:
    """Three recordings; the evaluation of `b.mcap` fails in `fail`."""
    folder = tmp_path / "lab" / "rig1"
    folder.mkdir(parents=True)
    return [record(folder / f"{name}.mcap", Script(seconds=1.0, seed=ord(name))) for name in "abc"]


def fail(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fails(original: Callable[..., None]) -> Callable[..., None]:
        def replacement(self: DataQuality, run: Run) -> None:
            if run.path.name == "b.mcap":
                raise error
            original(self, run)

        return replacement

    monkeypatch.setattr(DataQuality, "__init__", fails(DataQuality.__init__))


def exit_code(command: Callable[[], None]) -> int:
    try:
        command()
    except typer.Exit as ending:
        return ending.exit_code
    return 0


def test_each_list_isolates_an_error(
    recordings: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    fail(monkeypatch, MemoryError())
    assert exit_code(lambda: latency_command.latency(recordings, None, as_json=True)) == 1
    found = json.loads(capsys.readouterr().out)
    assert [Path(run["path"]).name for run in found["runs"]] == ["a.mcap", "c.mcap"]
    assert [Path(run["path"]).name for run in found["unreadable"]] == ["b.mcap"]
    assert found["unreadable"][0]["reason"].startswith(f"{recordings[1]}: ")

    assert exit_code(lambda: compare_command.compare(recordings, "start", None, None, as_json=True)) == 1
    found = json.loads(capsys.readouterr().out)
    assert len(found["runs"]) == 2
    assert found["left_out"][0].startswith(f"{recordings[1]}: ")

    page = tmp_path / "report.html"
    assert exit_code(lambda: report_command.report(recordings, page, False, None, as_json=True)) == 1
    found = json.loads(capsys.readouterr().out)
    assert len(found["runs"]) == 2
    assert found["left_out"][0].startswith(f"{recordings[1]}: ")
    assert page.stat().st_size > 10_000

    entries = {Path(entry.path).name: entry for entry in ListWorker(tmp_path / "lab").entries()[0]}
    assert entries["b.mcap"].fit is False
    assert entries["a.mcap"].loop_p50_ms is not None


def test_runs_shows_the_error_and_returns_1(
    recordings: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recordings[0].parent
    assert exit_code(lambda: runs_command.runs(folder, as_json=True)) == 0
    capsys.readouterr()
    fail(monkeypatch, ERRORS[0])
    assert exit_code(lambda: runs_command.runs(folder, rebuild=True, as_json=True)) == 1
    runs = {Path(run["path"]).name: run for run in json.loads(capsys.readouterr().out)["runs"]}
    assert runs["b.mcap"]["error"].startswith("can't be evaluated: IndexError: index 0 is out of bounds")
    assert runs["c.mcap"]["loop_p50_ms"] > 0


def test_verify_and_recover_continue_after_a_bad_file(
    recordings: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    recordings[1].write_bytes(b"not a recording")
    assert exit_code(lambda: verify_command.verify(recordings, 1e9, as_json=True)) == 1
    found = json.loads(capsys.readouterr().out)
    assert (len(found["runs"]), len(found["unreadable"])) == (2, 1)
    assert exit_code(lambda: recover_command.recover(recordings, None, as_json=True)) == 1
    found = capsys.readouterr()
    assert len(json.loads(found.out)) == 2
    assert f"{recordings[1]}: not an MCAP file" in found.err


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_error_of_one_recording_names_the_file(error: Exception) -> None:
    with pytest.raises(HilrigError, match=r"^run\.mcap: ") as raised, isolated(Path("run.mcap")):
        raise error
    assert len(str(raised.value).splitlines()) == 1


def test_own_errors_and_a_closed_pipe_pass_unchanged() -> None:
    for error in (InputError("wrong"), BrokenPipeError()):
        with pytest.raises(type(error)) as raised, isolated(Path("run.mcap")):
            raise error
        assert raised.value is error
