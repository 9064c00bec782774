"""The notebook's page is run as it stands, block after block."""

import re
from pathlib import Path

import pytest

from recordings import Script, record

PAGE = Path(__file__).parents[2] / "docs" / "notebook.md"


def test_every_block_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "run.mcap", Script(seconds=4.0))
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 5
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
        "J into the arm",
    ):
        assert words in printed, words
