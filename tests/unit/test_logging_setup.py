"""Log lines of a service: text with a time stamp, or one JSON object per line."""

import json
import logging
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from hilrig_runtime.process.logging_setup import start_logging
from hilrig_runtime.process.shutdown import ErrorOutput
from support.labs import hilrig


def log_line(
    service: str, log_format: str, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    root = logging.getLogger()
    # Without the handlers of pytest, `start_logging` adds its own.
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    monkeypatch.setattr(ErrorOutput, "write", ErrorOutput.write)
    for module in (sys, threading):
        monkeypatch.setattr(module, "excepthook", module.excepthook)
    start_logging(service, "east", log_format)
    logging.captureWarnings(False)
    logging.getLogger("any").warning(text)
    return capsys.readouterr().err


def test_text_log_has_time_source_and_level(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = log_line("edge", "text", "link lost", monkeypatch, capsys)
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3} edge east: WARNING: link lost\n", line)


def test_text_log_escapes_control_characters(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = log_line("edge", "text", "lost sim/\x1b[2J\n2026-01-01T00:00:00.000 sim: ERROR: forged", monkeypatch, capsys)
    assert r"lost sim/\x1b[2J\x0a2026" in line
    assert line.count("\n") == 1


def test_json_log_is_one_object_per_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    [line] = log_line("up", "json", "two\nlines", monkeypatch, capsys).splitlines()
    entry = json.loads(line)
    assert (entry["service"], entry["level"], entry["message"]) == ("up", "WARNING", "two\nlines")


@pytest.mark.parametrize("command", ["up", "edge", "router", "metrics", "console"])
def test_final_errors_are_json_too(tmp_path: Path, command: str) -> None:
    (tmp_path / "lab.toml").write_text("[sim]\nstep = 1\n[edge]\nhots = 2\n")
    done = hilrig(command, "--log-format", "json", "--config", tmp_path / "lab.toml")
    entries = [json.loads(line) for line in done.stderr.splitlines()]
    assert done.returncode == 2
    assert [(entry["service"], entry["level"]) for entry in entries] == [(command, "ERROR")] * 2
    assert "sim.step: unknown key" in entries[0]["message"]


CRASHING = """
import threading, warnings
from hilrig_runtime.process.logging_setup import start_logging
start_logging("sim", "1", "json")
warnings.warn("odd", stacklevel=1)
thread = threading.Thread(target=lambda: 1 / 0, name="worker")
thread.start()
thread.join()
raise RuntimeError("end")
"""


def test_crashes_and_warnings_are_json_too() -> None:
    done = subprocess.run([sys.executable, "-c", CRASHING], capture_output=True, text=True, timeout=30, check=False)
    entries = [json.loads(line) for line in done.stderr.splitlines()]
    assert [entry["level"] for entry in entries] == ["WARNING", "CRITICAL", "CRITICAL"]
    assert "ZeroDivisionError" in entries[1]["exception"]
    assert entries[2]["message"] == "end"
