"""Log lines of a service: text with a time stamp, or one JSON object per line."""

import json
import logging
import re

import pytest

from hilrig_runtime.process.logging_setup import start_logging


def log_line(
    service: str, log_format: str, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    root = logging.getLogger()
    # Without the handlers of pytest, `start_logging` adds its own.
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    start_logging(service, "east", log_format)
    logging.getLogger("any").warning(text)
    return capsys.readouterr().err


def test_text_log_has_time_source_and_level(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = log_line("edge", "text", "link lost", monkeypatch, capsys)
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3} edge east: WARNING: link lost\n", line)


def test_json_log_is_one_object_per_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    [line] = log_line("up", "json", "two\nlines", monkeypatch, capsys).splitlines()
    entry = json.loads(line)
    assert (entry["service"], entry["level"], entry["message"]) == ("up", "WARNING", "two\nlines")
