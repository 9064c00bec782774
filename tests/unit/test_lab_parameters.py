"""Mistakes that only the geometry of a lab reveals are reported by every command that reads its file, all at once."""

from pathlib import Path

import pytest

from hilrig_recorder.storage.segment_file import without_folders
from support.labs import hilrig

UNREACHABLE = """
[[task.poses]]
name = "near"
position_mm = [900, 0, 0]
[[task.poses]]
name = "far"
position_mm = [0, 950, 0]
[task.place]
parts = ["pink"]
"""


@pytest.mark.parametrize("command", [["check"], ["up", "-c"], ["sim", "-c"], ["edge", "-c"], ["recorder", "-c"]])
def test_unreachable_task_is_refused_with_all_mistakes(tmp_path: Path, command: list[str]) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(UNREACHABLE)
    done = hilrig(*command, path, timeout_s=30)
    assert done.returncode == 2, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("hilrig: error: ")]
    assert len(lines) == 3
    for text in ("pose 'near' is out of reach", "pose 'far' is out of reach", "no ferromagnetic part 'pink'"):
        assert sum(text in line for line in lines) == 1


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('folder = "/home/ann/rec"', 'folder = "rec"'),
        ('folder = "/home/ann/rec/"', 'folder = "rec"'),
        ("key = '~/keys/edge.pem'", "key = 'edge.pem'"),
        (r'folder = "C:\\Users\\ann\\rec"', 'folder = "rec"'),
        ('delay = "trace:/home/ann/delays.csv"', 'delay = "trace:delays.csv"'),
        ('delays = ["trace:~/a.csv", "file:///home/ann/b"]', 'delays = ["trace:a.csv", "file:b"]'),
        (r"share = '\\srv\ann\rec'", "share = 'rec'"),
        ("# see /home/ann/notes.md", "# see notes.md"),
        ('folder = "/home/ann"', 'folder = "home"'),
        ('folder = "~ann/"', 'folder = "home"'),
        (
            'listen = "tcp/127.0.0.1:7447" # https://example.org/a',
            'listen = "tcp/127.0.0.1:7447" # https://example.org/a',
        ),
        ('allow = ["10.0.0.0/8"]', 'allow = ["10.0.0.0/8"]'),
        ('folder = "rec/x" # 5', 'folder = "rec/x" # 5'),
    ],
)
def test_recorded_lab_file_contains_no_absolute_path(text: str, expected: str) -> None:
    assert without_folders(text) == expected
