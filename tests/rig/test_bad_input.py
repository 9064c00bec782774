"""Invalid input on the command line: one line with the error and its place, the documented exit code, no traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.writer import Writer

from support.labs import hilrig, write_lab
from support.recordings import record

READERS = (
    ("latency", "{file}"),
    ("replay", "{file}", "--save", "{folder}/run.rrd"),
    ("verify", "{file}"),
)


def error_line(stderr: str) -> str:
    """The only error line of the output."""
    assert "Traceback" not in stderr, stderr
    lines = [line for line in stderr.splitlines() if line.startswith("hilrig: error: ")]
    assert len(lines) == 1, stderr
    return lines[0]


@pytest.mark.parametrize("command", READERS, ids=lambda arguments: arguments[0])
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: None, "no such file"),
        (lambda path: path.mkdir(), "folder"),
        (lambda path: path.write_bytes(b""), "empty"),
        (lambda path: path.write_text("hello, I am a text file and no recording\n" * 5), "not an MCAP file"),
    ],
    ids=["missing", "folder", "empty", "text"],
)
def test_file_that_is_not_a_recording(tmp_path: Path, command: tuple[str, ...], make, message: str) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "run.mcap"
    make(file)
    done = hilrig(*(argument.format(file=file, folder=tmp_path) for argument in command))
    assert done.returncode == 2
    line = error_line(done.stderr)
    assert str(file) in line
    assert message.lower() in line.lower()


@pytest.mark.parametrize("command", READERS, ids=lambda arguments: arguments[0])
def test_empty_recording(tmp_path: Path, command: tuple[str, ...]) -> None:
    file = tmp_path / "run.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    done = hilrig(*(argument.format(file=file, folder=tmp_path) for argument in command))
    assert done.returncode == 2
    assert f"{file}: empty recording: " in error_line(done.stderr)


def test_plot_in_a_missing_folder(tmp_path: Path) -> None:
    file = record(tmp_path / "run.mcap")
    done = hilrig("latency", file, "--plot", tmp_path / "nowhere" / "plot.png")
    assert done.returncode == 2
    assert "nowhere" in error_line(done.stderr)


@pytest.mark.parametrize("text", ["[sim]\nstep = 5\n", "[sim]\nstep_ms = 'x'\n", "[sim"], ids=["key", "type", "toml"])
@pytest.mark.parametrize("command", ["check", "up", "sim", "edge", "recorder"])
def test_invalid_lab_file(tmp_path: Path, command: str, text: str) -> None:
    file = tmp_path / "lab.toml"
    file.write_text(text)
    done = hilrig(command, *((file,) if command == "check" else ("--config", file)))
    assert done.returncode == 2
    assert str(file) in error_line(done.stderr)


def test_recordings_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "recordings").write_text("a file instead of a folder")
    done = hilrig("up", "--config", write_lab(tmp_path), timeout_s=60)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert f"{tmp_path / 'recordings'}" in done.stderr


@pytest.mark.skipif(os.geteuid() == 0, reason="root can write everywhere")
def test_recordings_folder_without_permission(tmp_path: Path) -> None:
    (tmp_path / "recordings").mkdir(mode=0o500)
    done = hilrig("up", "--config", write_lab(tmp_path), timeout_s=60)
    assert done.returncode == 3
    assert "Permission denied" in done.stderr


def test_demo_that_can_not_write_its_results(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file instead of a folder")
    done = hilrig("demo", "--duration", "1", "--out", tmp_path / "out")
    assert done.returncode == 3
    assert str(tmp_path / "out") in error_line(done.stderr)


def without(package: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command without a package, as on a host where only some parts of hilrig are installed."""
    code = f"import sys; sys.modules['{package}'] = None; from hilrig_cli.__main__ import main; main()"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("package", "command", "extra"),
    [("pymodbus", "edge", "rig"), ("mcap", "runs", "review"), ("uvicorn", "console", "console")],
)
def test_missing_package_is_named(tmp_path: Path, package: str, command: str, extra: str) -> None:
    done = without(package, command, *([tmp_path] if command == "runs" else []))
    assert done.returncode == 3
    line = error_line(done.stderr)
    assert (
        f"`hilrig {command}` needs {package!r}, which is not installed: run in hilrig's folder: {sys.executable}"
        in line
    )
    assert line.endswith(f"-m pip install '.[{extra}]'")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("latency", "missing argument 'RUN.MCAP…'; see hilrig latency --help"),
        ("nonsense", "no such command 'nonsense'; see hilrig --help"),
        ("demo --duration -5", "--duration: must be ≥ 1, got '-5'; see hilrig demo --help"),
        ("up --edges x", "--edges: must be an integer, got 'x'; see hilrig up --help"),
        ("rig list --jsn", "no such option: --jsn (Possible options: --json); see hilrig rig list --help"),
        ("impair rig1 --loss 2", "--loss: rate: must be ≤ 1, got '2'"),
        ("registers --csv --json", "--csv, --markdown and --json can't be combined: use one of them"),
        ("check nowhere.toml", "nowhere.toml: no such file"),
        ("recover nowhere.mcap", "nowhere.mcap: no such file"),
    ],
)
def test_invalid_usage_is_one_line_and_exit_code_2(command: str, message: str) -> None:
    done = hilrig(*command.split())
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"hilrig: error: {message}\n"


def test_every_command_has_help() -> None:
    from typer.main import get_command

    from hilrig_cli.main import app

    commands = get_command(app).commands  # type: ignore[attr-defined]
    assert {"up", "demo", "live", "runs", "latency", "replay", "sim", "edge", "recorder", "check"} <= set(commands)
    for command in commands.values():
        assert command.help, f"hilrig {command.name} has no help text"
        for parameter in command.params:
            assert getattr(parameter, "help", None), f"hilrig {command.name}: {parameter.name} has no help text"


def test_group_accepts_config_before_and_after_the_command(tmp_path: Path) -> None:
    before, after = tmp_path / "before.toml", tmp_path / "after.toml"
    for arguments, used in (
        (("record", "-c", before, "start", "rig1"), before),
        (("record", "start", "-c", after, "rig1"), after),
        (("record", "-c", before, "stop", "rig1", "-c", after), after),
        (("rig", "--config", before, "list"), before),
    ):
        done = hilrig(*arguments)
        assert done.returncode == 2, done.stderr
        assert str(used) in error_line(done.stderr)
