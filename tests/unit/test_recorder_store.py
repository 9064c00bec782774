"""Alerts of the recorder's file store: a slow disk is reported once, until it is fast again."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hilrig_recorder.storage.store import SLOW_SYNC_S, FileStore
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import Event


def test_slow_disk_alert_is_raised_once_and_cleared(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    sync_worker: Any = SimpleNamespace(sync_delay_s=0.2)
    events: list[Event] = []
    store = FileStore(
        "lab",
        RecorderConfig(folder=tmp_path, min_free_mib=0),
        ManualClock(),
        sync_worker,
        instance="1",
        repeated_ns=0,
        emit=events.append,
        request_config=lambda _: None,
        on_failed=lambda _: None,
    )
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
