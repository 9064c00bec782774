"""Alerts of the recorder's file store: a slow disk is reported once, until it is fast again."""

import errno
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hilrig_recorder.ingest.recording import Recording
from hilrig_recorder.mcap_format.ending import Ending
from hilrig_recorder.storage.store import SLOW_SYNC_S, FileStore
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import Event


def make_store(folder: Path, sync_worker: Any, events: list[Event]) -> FileStore:
    return FileStore(
        "lab",
        RecorderConfig(folder=folder, min_free_mib=0),
        ManualClock(),
        sync_worker,
        instance="1",
        repeated_ns=0,
        emit=events.append,
        request_config=lambda _: None,
        on_failed=lambda _: None,
    )


def test_slow_disk_alert_is_raised_once_and_cleared(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    sync_worker: Any = SimpleNamespace(sync_delay_s=0.2)
    events: list[Event] = []
    store = make_store(tmp_path, sync_worker, events)
    store.tick(0)
    assert (store.alert, events) == ("", [])
    sync_worker.sync_delay_s = SLOW_SYNC_S + 1
    for now_ns in range(5):
        store.tick(now_ns)
    assert f"slow disk: a power failure may lose the last {SLOW_SYNC_S:g} s or more" in store.alert
    assert [(event.kind, event.severity, event.text) for event in events] == [
        (Event.RECORDING, Event.WARNING, store.alert)
    ]
    sync_worker.sync_delay_s = 0.1
    store.tick(6)
    assert store.alert == ""
    store.release()


def test_resumed_recorder_does_not_report_a_slow_disk(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    events: list[Event] = []
    sync_worker: Any = SimpleNamespace(sync_delay_s=0.2)
    store = make_store(tmp_path, sync_worker, events)
    store.tick(0)
    # The process was stopped for 14 s, in the middle of a sync.
    sync_worker.sync_delay_s = 14.0
    for now_ms in range(14_000, 18_000, 100):
        store.tick(now_ms * 1_000_000)
    assert (store.alert, events) == ("", [])
    for now_ms in range(18_000, 20_000, 100):
        store.tick(now_ms * 1_000_000)
    assert "slow disk" in store.alert


def test_name_of_a_segment_is_never_used_again(tmp_path: Path) -> None:
    sync_worker: Any = SimpleNamespace(sync_delay_s=0.0, follow=lambda _: None, finish=lambda writer, _: writer.close())
    store = make_store(tmp_path, sync_worker, [])
    recording = Recording("rig1", "s", "", "edge/1", 1, 0)
    assert store.open(recording)
    folder, moved = tmp_path / "lab" / "rig1", tmp_path / "moved"
    assert [path.name for path in folder.iterdir()] == ["s.mcap.part"]
    # The folder is replaced while the file is open, writing fails, and the session continues in another file.
    folder.rename(moved)
    next(iter(store._files.values())).fail(OSError(errno.EIO, "Input/output error"))
    store.tick(0)
    assert store.open(recording)
    assert [path.name for path in folder.iterdir()] == ["s.2.mcap.part"]
    # The session ends because its owner is silent, and continues later, in a folder that was replaced again.
    store.close(recording, Ending.OWNER_LOST, "")
    folder.rename(tmp_path / "moved again")
    again = Recording("rig1", "s", "", "edge/1", 1, 0)
    assert store.open(again)
    assert [path.name for path in folder.iterdir()] == ["s.3.mcap.part"]
    store.close(again, Ending.ENDED, "")
    store.release()
