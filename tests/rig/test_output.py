"""Output of commands: full disks, encodings without some characters, closed pipes, complete help texts."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from support.hilrig_process import HILRIG
from support.recordings import record

pytestmark = pytest.mark.rig


def run_command(*arguments: str | Path, **options: object) -> subprocess.CompletedProcess[str]:
    command = [*HILRIG, *map(str, arguments)]
    return subprocess.run(command, check=False, stderr=subprocess.PIPE, text=True, timeout=60, **options)  # type: ignore[call-overload]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full (Linux)")
@pytest.mark.parametrize("arguments", [("check",), ("check", "--json"), ("check", "--template")], ids=" ".join)
def test_full_disk_is_reported_in_one_line(arguments: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        done = run_command(*arguments, stdout=full)
    assert done.returncode == 3
    assert done.stderr == "hilrig: error: standard output: can't be written: No space left on device\n"


def test_characters_missing_in_the_encoding_are_dropped(tmp_path: Path) -> None:
    file = record(tmp_path / "run.mcap")
    done = run_command("compare", file, file, stdout=subprocess.PIPE, env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0, done.stderr
    assert "tool distance" in done.stdout


@pytest.mark.skipif(os.name != "posix", reason="needs a POSIX shell")
def test_closed_output_is_not_an_error() -> None:
    done = subprocess.run(
        ["sh", "-c", '"$@" >&-', "sh", *HILRIG, "check", "--json"],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")


PRINTERS = [
    ("check", "--json"),
    ("registers",),
    ("compare", "{run}", "{run}"),
    ("latency", "{run}", "--json"),
    ("runs", "{folder}"),
    ("--help",),
    # Its error message is also written to the closed pipe.
    ("report", "{folder}/nowhere.mcap"),
]


@pytest.mark.skipif(os.name != "posix", reason="needs SIGPIPE")
@pytest.mark.parametrize("arguments", PRINTERS, ids=lambda arguments: arguments[0])
def test_closed_pipe_ends_a_command_with_exit_code_141(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    run = record(tmp_path / "run.mcap")
    reader, writer = os.pipe()
    os.close(reader)
    fails = arguments[0] == "report"
    try:
        done = subprocess.run(
            [*HILRIG, *(argument.format(run=run, folder=tmp_path) for argument in arguments)],
            check=False,
            stdout=writer,
            stderr=writer if fails else subprocess.PIPE,
            # Unbuffered streams leave nothing in a buffer at the end of the process, and hide its loss.
            env={name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"},
            timeout=60,
        )
    finally:
        os.close(writer)
    assert done.returncode == 141
    assert not done.stderr


def test_help_shows_the_first_paragraph_of_every_command() -> None:
    from typer.main import get_command

    from hilrig_cli.main import app

    done = run_command("--help", stdout=subprocess.PIPE, env=os.environ | {"COLUMNS": "200"})
    assert done.returncode == 0
    shown = " ".join(re.sub(r"[│╭╮╰╯─]", " ", done.stdout).split())
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        paragraph = command.help.split("\n\n")[0].replace("\\[", "[")
        assert f"{name} {' '.join(paragraph.split())}" in shown
