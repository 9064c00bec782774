"""Disk-backed table: returns the rows in their order, and reports a full disk with the folder."""

import errno
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilrig_replay.io.columns import Rows
from hilrig_replay.io.disk_table import DiskTable
from hilrig_runtime.errors import OperationError

ROW = np.dtype([("number", "<u8"), ("small", "<u2"), ("when", "<i8"), ("flag", "|b1")])


def rows(count: int, start: int = 0) -> Rows:
    made = np.empty(count, ROW)
    made["number"] = np.arange(start, start + count)
    made["small"] = made["number"] % 60_000
    made["when"] = -made["number"].astype(np.int64) * 1_000_000_007
    made["flag"] = made["number"] % 3 == 0
    return made


@pytest.mark.parametrize("pieces", [(0,), (5,), (10,), (11,), (3, 4, 5, 6), (100,), (1,) * 35, (25, 0, 25)])
def test_returns_the_rows_that_were_added(pieces: tuple[int, ...]) -> None:
    table = DiskTable(ROW, block=10)
    whole = rows(sum(pieces))
    at = 0
    for piece in pieces:
        table.add(whole[at : at + piece])
        at += piece
        assert len(table) == at
    np.testing.assert_array_equal(table[:], whole)
    np.testing.assert_array_equal(table[5:-5:2], whole[5:-5:2])
    for name in ROW.names or ():
        np.testing.assert_array_equal(table[name], whole[name])
        assert table[name].dtype == ROW[name]
    for block in table.blocks("when", "small"):
        assert len(block) <= 10
        assert block.dtype.names == ("when", "small")


def test_iterates_columns_in_parallel_and_repeatedly() -> None:
    table, whole = DiskTable(ROW, block=7), rows(50)
    table.add(whole)
    number, when = table.column("number"), table.column("when")
    for _ in range(2):
        pairs = list(zip(number(), when(), strict=True))
        np.testing.assert_array_equal(np.concatenate([one for one, _ in pairs]), whole["number"])
        np.testing.assert_array_equal(np.concatenate([other for _, other in pairs]), whole["when"])


def test_a_short_table_is_not_written_to_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda: pytest.fail("created a file"))
    table = DiskTable(ROW, block=10)
    table.add(rows(9))
    assert len(table["number"]) == 9


def test_reports_a_full_disk_with_the_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    with pytest.raises(OperationError, match=r"No space left on device; set TMPDIR to another folder") as said:
        DiskTable(ROW, block=10).add(rows(30))
    assert str(said.value).startswith(tempfile.gettempdir())


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc")
def test_closes_the_file_with_the_table() -> None:
    def files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    before = files()
    table = DiskTable(ROW, block=10)
    table.add(rows(30))
    assert files() == before + 1
    del table
    assert files() == before
