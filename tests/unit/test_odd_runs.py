"""Unusual and unreadable runs: each command reports one clear error, or accepts the run."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hilrig_replay.analysis.compare import compare
from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.verify import verify
from hilrig_replay.io.run import open_run
from hilrig_replay.report.report import build_report
from hilrig_replay.rerun_view.view import save_rrd
from hilrig_runtime.errors import InputError
from support.recordings import Script, make, record, write

COMMANDS: dict[str, Callable[[Path], object]] = {
    "latency": lambda path: measure(open_run(path)),
    "replay": lambda path: save_rrd(open_run(path), path.with_suffix(".rrd")),
    "compare": lambda path: compare([open_run(path), open_run(path)]),
    "report": lambda path: build_report([path]),
    "verify": verify,
}


def truncated(folder: Path) -> Path:
    path = folder / "run.mcap"
    path.write_bytes(record(folder / "whole.mcap", Script(seconds=2.0)).read_bytes()[:9000])
    return path


def damaged(folder: Path) -> Path:
    path = record(folder / "run.mcap", Script(seconds=2.0))
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2] ^= 0x10
    path.write_bytes(whole)
    return path


def newer(folder: Path) -> Path:
    return write(folder / "run.mcap", make(Script(seconds=1.0)), schema_version="hilrig.v2")


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (truncated, r"truncated \(no footer\): run `hilrig recover .*` to complete it"),
        (damaged, "damaged .*: run `hilrig recover .*` to save the intact messages"),
        (newer, r"recorded with message schemas hilrig\.v2, but this version reads hilrig\.v1: use a newer hilrig"),
    ],
)
def test_commands_report_unreadable_files_with_a_fix(
    spoil: Callable[[Path], Path], words: str, command: str, tmp_path: Path
) -> None:
    path = spoil(tmp_path)
    with pytest.raises(InputError, match=words) as raised:
        COMMANDS[command](path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("command", [command for command in COMMANDS if command != "verify"])
def test_commands_accept_a_run_without_a_controller(command: str, tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", Script(seconds=1.0, controllers=False))
    COMMANDS[command](path)
    if command == "replay":
        assert (tmp_path / "run.rrd").stat().st_size > 10_000
