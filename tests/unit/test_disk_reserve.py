"""The disk reserve: minimum free space, reserved space, and when recording stops and resumes."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilrig_recorder.storage.disk_reserve import MIB, DiskReserve


class FakeDisk:
    """A disk of 64 MiB, of which 4 MiB are reserved; the test sets the free space."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free_mib = 60
        monkeypatch.setattr(
            shutil, "disk_usage", lambda _: SimpleNamespace(total=64 * MIB, used=0, free=self.free_mib * MIB)
        )


def reserved_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob(".recorder-one.reserve"))


def test_recording_stops_below_minimum_free_space_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = FakeDisk(monkeypatch)
    reserve = DiskReserve(tmp_path, "one", min_free_mib=10)
    assert (reserve.refresh(), reserve.is_exhausted) == ("", False)
    disk.free_mib = 10
    assert (reserve.refresh(), reserve.is_exhausted) == ("", False)
    disk.free_mib = 9
    assert reserve.refresh() == (f"{tmp_path}: recording stopped: 9 MiB free, minimum 10 MiB (recorder.min_free_mib)")
    assert reserve.is_exhausted
    assert reserve.refresh() == "", "reported once"
    disk.free_mib = 11
    assert (reserve.refresh(), reserve.is_exhausted) == ("", False)


def test_reserve_is_released_on_full_disk_and_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = FakeDisk(monkeypatch)
    reserve = DiskReserve(tmp_path, "one", min_free_mib=0)
    assert reserved_bytes(tmp_path) == 4 * MIB
    disk.free_mib = 0
    reserve.mark_exhausted()
    assert (reserved_bytes(tmp_path), reserve.is_exhausted) == (0, True)
    disk.free_mib = 3
    assert (reserve.refresh(), reserve.is_exhausted, reserved_bytes(tmp_path)) == ("", True, 0)
    disk.free_mib = 5
    assert (reserve.refresh(), reserve.is_exhausted, reserved_bytes(tmp_path)) == ("", False, 4 * MIB)


def test_recording_works_without_space_for_the_reserve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    FakeDisk(monkeypatch).free_mib = 3
    reserve = DiskReserve(tmp_path, "one", min_free_mib=0)
    assert (reserve.refresh(), reserve.is_exhausted, reserved_bytes(tmp_path)) == ("", False, 0)
