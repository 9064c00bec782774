"""Space on a disk: how much is kept free, what is set aside, and when recording stops and goes on."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilrig_recorder.storage.disk_reserve import MIB, Space


class Disk:
    """A disk of 64 MiB, of which 4 are set aside, with as much free as the test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free_mib = 60
        monkeypatch.setattr(
            shutil, "disk_usage", lambda _: SimpleNamespace(total=64 * MIB, used=0, free=self.free_mib * MIB)
        )


def reserve(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob(".recorder-one.reserve"))


def test_recording_stops_below_what_is_kept_free_and_goes_on_above(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(monkeypatch)
    space = Space(tmp_path, "one", min_free_mib=10)
    assert (space.look(), space.full) == ("", False)
    disk.free_mib = 10
    assert (space.look(), space.full) == ("", False)
    disk.free_mib = 9
    assert space.look() == f"{tmp_path}: only 9 MiB are free, 10 are kept: no recording"
    assert space.full
    assert space.look() == "", "it is said once"
    disk.free_mib = 11
    assert (space.look(), space.full) == ("", False)


def test_what_was_set_aside_is_given_back_when_the_disk_is_full_and_has_to_fit_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(monkeypatch)
    space = Space(tmp_path, "one", min_free_mib=0)
    assert reserve(tmp_path) == 4 * MIB
    disk.free_mib = 0
    space.run_out()
    assert (reserve(tmp_path), space.full) == (0, True)
    disk.free_mib = 3
    assert (space.look(), space.full, reserve(tmp_path)) == ("", True, 0)
    disk.free_mib = 5
    assert (space.look(), space.full, reserve(tmp_path)) == ("", False, 4 * MIB)


def test_a_disk_without_room_to_set_aside_records_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Disk(monkeypatch).free_mib = 3
    space = Space(tmp_path, "one", min_free_mib=0)
    assert (space.look(), space.full, reserve(tmp_path)) == ("", False, 0)
