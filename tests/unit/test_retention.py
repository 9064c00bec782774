"""Rules of keeping: the oldest go first, and a rig's last recording stays whatever the rules say."""

import os
from pathlib import Path

from hilrig_recorder.storage.maintenance import Housekeeping
from hilrig_recorder.storage.retention import DAY_S, Stored, finished_recordings, to_delete
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from support.waiting import eventually

NOW_S = 2_000_000_000.0
GIB = 2**30


def stored(rig: str, days_old: float, size: int = GIB) -> Stored:
    return Stored(Path(f"{rig}/{days_old}.mcap"), rig, size, NOW_S - days_old * DAY_S)


def ages(going: list[Stored]) -> list[tuple[str, float]]:
    return [(one.rig, round((NOW_S - one.finished_s) / DAY_S, 3)) for one in going]


def test_with_no_rule_nothing_goes() -> None:
    assert to_delete([stored("rig1", age) for age in (1, 1000)], keep_days=0, keep_gib=0, now_s=NOW_S) == []


def test_what_is_older_than_the_days_goes_oldest_first() -> None:
    recordings = [stored("rig1", age) for age in (1, 9, 31, 400)]
    assert ages(to_delete(recordings, keep_days=30, keep_gib=0, now_s=NOW_S)) == [("rig1", 400), ("rig1", 31)]


def test_the_last_of_a_rig_stays_however_old_it_is() -> None:
    recordings = [stored("rig1", 400), stored("rig1", 399), stored("rig2", 900)]
    assert ages(to_delete(recordings, keep_days=30, keep_gib=0, now_s=NOW_S)) == [("rig1", 400)]


def test_the_oldest_go_until_the_rest_is_small_enough() -> None:
    recordings = [stored("rig1", age) for age in range(10)]
    going = to_delete(recordings, keep_days=0, keep_gib=7, now_s=NOW_S)
    assert ages(going) == [("rig1", 9), ("rig1", 8), ("rig1", 7)]


def test_size_never_takes_the_last_of_a_rig_either() -> None:
    recordings = [stored("rig1", 5, 100 * GIB), stored("rig2", 1), stored("rig2", 2)]
    assert ages(to_delete(recordings, keep_days=0, keep_gib=1, now_s=NOW_S)) == [("rig2", 2)]


def test_only_finished_recordings_are_looked_at(tmp_path: Path) -> None:
    (tmp_path / "rig1").mkdir()
    for name in ("a.mcap", "b.mcap.part", "c.mcap.recovering", "notes.txt"):
        (tmp_path / "rig1" / name).write_bytes(b"x")
    assert [one.path.name for one in finished_recordings(tmp_path)] == ["a.mcap"]


def test_housekeeping_deletes_with_what_stands_beside(tmp_path: Path) -> None:
    folder = tmp_path / "rig1"
    folder.mkdir()
    old = NOW_S - 1e9
    for name in ("a.mcap", "a.mcap.verified", "b.mcap", "c.mcap.part"):
        (folder / name).write_bytes(b"x")
        os.utime(folder / name, (old, old))
    os.utime(folder / "b.mcap", (old + 10, old + 10))
    troubles: list[str] = []
    keeper = Housekeeping(tmp_path, [], RecorderConfig(keep_days=1), SYSTEM_CLOCK, troubles.append)
    eventually(lambda: not (folder / "a.mcap.verified").exists())
    keeper.close()
    assert sorted(path.name for path in folder.iterdir()) == ["b.mcap", "c.mcap.part"]
    assert troubles == []
