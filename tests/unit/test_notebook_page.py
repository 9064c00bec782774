"""Runs the code blocks of docs/notebook.md, and compares the public API with the page."""

import re
from pathlib import Path

import pytest

import hilrig_replay
import hilrig_sim
from support.recordings import Script, make, write

PAGE = Path(__file__).parents[2] / "docs" / "notebook.md"


def test_runs_all_code_blocks_of_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = Script(seconds=4.0)
    task = "[[task.poses]]\nname = 'there'\nposition_mm = [400, 0, 0]\n"
    write(tmp_path / "run.mcap", make(script), script=script, lab_toml=task)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 7
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
    printed = capsys.readouterr().out
    for words in (
        "a step is 20.0 ms",
        "192.0.2.7:40001",
        "SESSION_START",
        "reads per second",
        "valid for latency measurements: False",
        "% of the task, ",
        "J of mechanical energy into the arm",
        "is too far: 700.0 mm from joint 1",
    ):
        assert words in printed, words


def test_public_names_are_those_of_the_page() -> None:
    lines = re.findall(r"^from (hilrig_replay\S*) import (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert {module for module, _ in lines} == {"hilrig_replay"}
    assert sorted(name.strip() for _, names in lines for name in names.split(",")) == sorted(hilrig_replay.__all__)
    assert all(hasattr(hilrig_replay, name) for name in hilrig_replay.__all__)


def test_public_names_of_the_simulation_are_those_of_the_page() -> None:
    lines = re.findall(r"^from hilrig_sim import (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(name for line in lines for name in line.split(", ")) == sorted(hilrig_sim.__all__)
