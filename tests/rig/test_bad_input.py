"""Bad input to the command line: one clear line that says what and where, the documented exit code, no traceback."""

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


def one_line(stderr: str) -> str:
    assert "Traceback" not in stderr, stderr
    lines = [line for line in stderr.splitlines() if line.startswith("hilrig: error: ")]
    assert len(lines) == 1, stderr
    return lines[0]


@pytest.mark.parametrize("command", READERS, ids=lambda words: words[0])
@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda _: None, "no such file"),
        (lambda path: path.mkdir(), "folder"),
        (lambda path: path.write_bytes(b""), "empty"),
        (lambda path: path.write_text("hello, I am a text file and no recording\n" * 5), "no MCAP"),
    ],
    ids=["missing", "folder", "empty", "text"],
)
def test_a_file_that_is_no_recording(tmp_path: Path, command: tuple[str, ...], make, says: str) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "run.mcap"
    make(file)
    done = hilrig(*(word.format(file=file, folder=tmp_path) for word in command))
    assert done.returncode == 2
    line = one_line(done.stderr)
    assert str(file) in line
    assert says.lower() in line.lower()


@pytest.mark.parametrize("command", READERS, ids=lambda words: words[0])
def test_a_recording_of_nothing(tmp_path: Path, command: tuple[str, ...]) -> None:
    file = tmp_path / "run.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    done = hilrig(*(word.format(file=file, folder=tmp_path) for word in command))
    assert done.returncode == 2
    assert f"{file}: an empty recording" in one_line(done.stderr)


def test_a_plot_that_can_not_be_written(tmp_path: Path) -> None:
    file = record(tmp_path / "run.mcap")
    done = hilrig("latency", file, "--plot", tmp_path / "nowhere" / "plot.png")
    assert done.returncode == 2
    assert "nowhere" in one_line(done.stderr)


@pytest.mark.parametrize("text", ["[sim]\nstep = 5\n", "[sim]\nstep_ms = 'x'\n", "[sim"], ids=["key", "type", "toml"])
@pytest.mark.parametrize("command", ["check", "up", "sim", "edge", "recorder"])
def test_a_lab_that_is_none(tmp_path: Path, command: str, text: str) -> None:
    file = tmp_path / "lab.toml"
    file.write_text(text)
    done = hilrig(command, *((file,) if command == "check" else ("--config", file)))
    assert done.returncode == 2
    assert str(file) in one_line(done.stderr)


def test_a_folder_for_recordings_that_can_not_be_written(tmp_path: Path) -> None:
    (tmp_path / "recordings").write_text("a file is in the way")
    done = hilrig("up", "--config", write_lab(tmp_path), timeout_s=60)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert f"{tmp_path / 'recordings'}" in done.stderr


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    (tmp_path / "recordings").mkdir(mode=0o500)
    done = hilrig("up", "--config", write_lab(tmp_path), timeout_s=60)
    assert done.returncode == 3
    assert "Permission denied" in done.stderr


def test_a_demo_that_can_not_write_its_results(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file is in the way")
    done = hilrig("demo", "--duration", "1", "--out", tmp_path / "out")
    assert done.returncode == 3
    assert str(tmp_path / "out") in one_line(done.stderr)


def without(package: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """A command where a package is not installed, as on a host with some of the parts."""
    code = f"import sys; sys.modules['{package}'] = None; from hilrig_cli.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(("package", "command"), [("cryptography", "certs"), ("mcap", "runs")])
def test_a_part_that_is_not_installed_is_named(tmp_path: Path, package: str, command: str) -> None:
    done = without(package, command, tmp_path)
    assert done.returncode == 3
    assert f"needs {package!r}, which is not installed" in one_line(done.stderr)


def test_a_host_that_can_not_read_certificates_is_looked_at_all_the_same(tmp_path: Path) -> None:
    config = write_lab(tmp_path, extra=f"bus.tls = {{folder = '{tmp_path}'}}")
    done = without("cryptography", "doctor", "--config", config)
    assert done.returncode == 1, "the bus can't be joined without certificates"
    assert "'cryptography' is not installed" in " ".join(done.stdout.replace("│", "").split())
    assert "open files" in done.stdout
    assert "Traceback" not in done.stderr


def test_wrong_usage_is_exit_code_2() -> None:
    assert hilrig("latency").returncode == 2
    assert hilrig("nonsense").returncode == 2
    assert hilrig("demo", "--duration", "-5").returncode == 2


def test_every_command_has_help() -> None:
    from typer.main import get_command

    from hilrig_cli.main import app

    commands = get_command(app).commands  # type: ignore[attr-defined]
    assert {"up", "demo", "live", "runs", "latency", "replay", "sim", "edge", "recorder", "check"} <= set(commands)
    for command in commands.values():
        assert command.help, f"hilrig {command.name} does not say what it does"
        for parameter in command.params:
            assert getattr(parameter, "help", None), f"hilrig {command.name}: {parameter.name} has no help"


def test_the_labs_file_may_stand_before_or_behind_the_command_of_a_group(tmp_path: Path) -> None:
    near, far = tmp_path / "near.toml", tmp_path / "far.toml"
    for words, meant in (
        (("record", "-c", far, "start", "rig1"), far),
        (("record", "start", "-c", near, "rig1"), near),
        (("record", "-c", far, "stop", "rig1", "-c", near), near),
        (("rig", "--config", far, "list"), far),
    ):
        done = hilrig(*words)
        assert done.returncode == 2, done.stderr
        assert str(meant) in one_line(done.stderr)
