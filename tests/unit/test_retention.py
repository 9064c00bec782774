"""Retention: the oldest recordings are deleted first, the newest one of each rig is always kept."""

import os
from pathlib import Path

from hilrig_recorder.storage.maintenance import MaintenanceWorker
from hilrig_recorder.storage.retention import DAY_S, StoredRecording, finished_recordings, select_expired
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from support.waiting import eventually

NOW_S = 2_000_000_000.0
GIB = 2**30


def stored(rig: str, days_old: float, size: int = GIB) -> StoredRecording:
    return StoredRecording(Path(f"{rig}/{days_old}.mcap"), rig, size, NOW_S - days_old * DAY_S)


def ages(expired: list[StoredRecording]) -> list[tuple[str, float]]:
    return [(one.rig, round((NOW_S - one.finished_s) / DAY_S, 3)) for one in expired]


def test_without_rules_nothing_is_deleted() -> None:
    assert select_expired([stored("rig1", age) for age in (1, 1000)], keep_days=0, keep_gib=0, now_s=NOW_S) == []


def test_recordings_older_than_keep_days_are_deleted() -> None:
    recordings = [stored("rig1", age) for age in (1, 9, 31, 400)]
    assert ages(select_expired(recordings, keep_days=30, keep_gib=0, now_s=NOW_S)) == [("rig1", 400), ("rig1", 31)]


def test_newest_recording_of_a_rig_is_kept_at_any_age() -> None:
    recordings = [stored("rig1", 400), stored("rig1", 399), stored("rig2", 900)]
    assert ages(select_expired(recordings, keep_days=30, keep_gib=0, now_s=NOW_S)) == [("rig1", 400)]


def test_oldest_recordings_are_deleted_until_size_fits() -> None:
    recordings = [stored("rig1", age) for age in range(10)]
    expired = select_expired(recordings, keep_days=0, keep_gib=7, now_s=NOW_S)
    assert ages(expired) == [("rig1", 9), ("rig1", 8), ("rig1", 7)]


def test_newest_recording_of_a_rig_is_kept_at_any_size() -> None:
    recordings = [stored("rig1", 5, 100 * GIB), stored("rig2", 1), stored("rig2", 2)]
    assert ages(select_expired(recordings, keep_days=0, keep_gib=1, now_s=NOW_S)) == [("rig2", 2)]


def test_only_finished_recordings_are_listed(tmp_path: Path) -> None:
    (tmp_path / "rig1").mkdir()
    for name in ("a.mcap", "b.mcap.part", "c.mcap.recovering", "notes.txt"):
        (tmp_path / "rig1" / name).write_bytes(b"x")
    assert [one.path.name for one in finished_recordings(tmp_path)] == ["a.mcap"]


def test_maintenance_deletes_companion_files_too(tmp_path: Path) -> None:
    folder = tmp_path / "rig1"
    folder.mkdir()
    old = NOW_S - 1e9
    for name in ("a.mcap", "a.mcap.verified", "b.mcap", "c.mcap.part"):
        (folder / name).write_bytes(b"x")
        os.utime(folder / name, (old, old))
    os.utime(folder / "b.mcap", (old + 10, old + 10))
    errors: list[str] = []
    maintenance = MaintenanceWorker(tmp_path, [], RecorderConfig(keep_days=1), SYSTEM_CLOCK, errors.append)
    eventually(lambda: not (folder / "a.mcap.verified").exists())
    maintenance.close()
    assert sorted(path.name for path in folder.iterdir()) == ["b.mcap", "c.mcap.part"]
    assert errors == []
