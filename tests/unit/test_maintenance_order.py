"""The order of recovery after a restart of the recorder, and the durability of a new file."""

import os
from pathlib import Path

import pytest

from hilrig_recorder.mcap_format import writer
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_recorder.storage.maintenance import find_unfinished


def test_newest_unfinished_session_is_recovered_first(tmp_path: Path) -> None:
    for number, name in enumerate(("rig1/c", "rig2/a", "rig1/b")):
        path = tmp_path / f"{name}.mcap.part"
        path.parent.mkdir(exist_ok=True)
        path.touch()
        os.utime(path, (number, number))
    assert [path.name for path in find_unfinished(tmp_path)] == ["b.mcap.part", "a.mcap.part", "c.mcap.part"]


def test_folder_is_synced_after_a_file_is_created(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(writer, "sync_folder", synced.append)
    file = RecordingWriter(tmp_path / "run.mcap")
    file.sync()
    file.sync()
    assert synced == [tmp_path]
    file.close()
