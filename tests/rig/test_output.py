"""Where a command's words go: disks that are full, terminals that can't show every sign, output that nobody reads."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from support.labs import HILRIG
from support.recordings import record

pytestmark = pytest.mark.rig


def ran(*words: str | Path, **options: object) -> subprocess.CompletedProcess[str]:
    command = [*HILRIG, *map(str, words)]
    return subprocess.run(command, check=False, stderr=subprocess.PIPE, text=True, timeout=60, **options)  # type: ignore[call-overload, no-any-return]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full (Linux)")
@pytest.mark.parametrize("words", [("check",), ("check", "--json"), ("check", "--template")], ids=" ".join)
def test_a_full_disk_is_one_line(words: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        done = ran(*words, stdout=full)
    assert done.returncode == 3
    assert done.stderr == "hilrig: error: the output: can't be written: No space left on device\n"


def test_what_an_encoding_can_not_say_is_left_out(tmp_path: Path) -> None:
    file = record(tmp_path / "run.mcap")
    done = ran("compare", file, file, stdout=subprocess.PIPE, env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0, done.stderr
    assert "tools apart" in done.stdout


@pytest.mark.skipif(os.name != "posix", reason="shells elsewhere have no such word")
def test_output_that_is_closed_is_no_reason_to_fail() -> None:
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
    # Its mistake is written to the closed pipe too.
    ("report", "{folder}/nowhere.mcap"),
]


@pytest.mark.skipif(os.name != "posix", reason="pipes elsewhere end otherwise")
@pytest.mark.parametrize("words", PRINTERS, ids=lambda words: words[0])
def test_a_pipe_that_nobody_reads_ends_a_command_quietly_as_it_ends_others(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    run = record(tmp_path / "run.mcap")
    reader, writer = os.pipe()
    os.close(reader)
    mistaken = words[0] == "report"
    try:
        done = subprocess.run(
            [*HILRIG, *(word.format(run=run, folder=tmp_path) for word in words)],
            check=False,
            stdout=writer,
            stderr=writer if mistaken else subprocess.PIPE,
            timeout=60,
        )
    finally:
        os.close(writer)
    assert done.returncode == 141
    assert not done.stderr


def test_help_says_every_command_s_first_sentence_in_full() -> None:
    from typer.main import get_command

    from hilrig_cli.main import app

    done = ran("--help", stdout=subprocess.PIPE, env=os.environ | {"COLUMNS": "200"})
    assert done.returncode == 0
    shown = " ".join(re.sub(r"[│╭╮╰╯─]", " ", done.stdout).split())
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        said = command.help.split("\n\n")[0].replace("\\[", "[")
        assert f"{name} {' '.join(said.split())}" in shown
