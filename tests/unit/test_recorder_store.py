"""What the recorder tells of its disk: when it is slow, once, until it is quick again."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hilrig_recorder.storage.store import SLOW_S, Files
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import Event


def test_a_slow_disk_is_told_of_once_and_until_it_is_quick_again(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    disk: Any = SimpleNamespace(behind_s=0.2)
    told: list[Event] = []
    files = Files(
        "lab",
        RecorderConfig(folder=tmp_path, min_free_mib=0),
        ManualClock(),
        disk,
        instance="1",
        repeated_ns=0,
        tell=told.append,
        ask_config=lambda _: None,
        give_up=lambda _: None,
    )
    files.tick(0)
    assert (files.trouble, told) == ("", [])
    disk.behind_s = SLOW_S + 1
    for now_ns in range(5):
        files.tick(now_ns)
    assert f"the disk is slow: what comes is safe from a power cut after {SLOW_S:g} s and more" in files.trouble
    assert [(event.kind, event.severity, event.text) for event in told] == [
        (Event.RECORDING, Event.WARNING, files.trouble)
    ]
    disk.behind_s = 0.1
    files.tick(6)
    assert files.trouble == ""
    files.release()
