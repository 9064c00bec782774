"""The notebook's page is run as it stands, block after block."""

import re
from pathlib import Path

import pytest

from support.recordings import Script, make, write

PAGE = Path(__file__).parents[2] / "docs" / "notebook.md"


def test_every_block_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = Script(seconds=4.0)
    task = "[[task.poses]]\nname = 'there'\nposition_mm = [400, 0, 0]\n"
    write(tmp_path / "run.mcap", make(script), script=script, lab_toml=task)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 6
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
    printed = capsys.readouterr().out
    for words in (
        "a step is 20.0 ms",
        "192.0.2.7:40001",
        "SESSION_START",
        "reads a second",
        "fit: False",
        "% of the task, ",
        "J into the arm",
    ):
        assert words in printed, words
