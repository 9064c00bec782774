"""A table in a file gives back what was put in, in its order, and says where there is no room for it."""

import errno
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilrig_replay.analysis.disk_table import Spool
from hilrig_replay.io.columns import Rows
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
def test_what_was_put_in_comes_back(pieces: tuple[int, ...]) -> None:
    spool = Spool(ROW, block=10)
    whole = rows(sum(pieces))
    at = 0
    for piece in pieces:
        spool.add(whole[at : at + piece])
        at += piece
        assert len(spool) == at
    np.testing.assert_array_equal(spool[:], whole)
    np.testing.assert_array_equal(spool[5:-5:2], whole[5:-5:2])
    for name in ROW.names or ():
        np.testing.assert_array_equal(spool[name], whole[name])
        assert spool[name].dtype == ROW[name]
    for block in spool.blocks("when", "small"):
        assert len(block) <= 10
        assert block.dtype.names == ("when", "small")


def test_columns_can_be_gone_through_side_by_side_and_again() -> None:
    spool, whole = Spool(ROW, block=7), rows(50)
    spool.add(whole)
    number, when = spool.column("number"), spool.column("when")
    for _ in range(2):
        pairs = list(zip(number(), when(), strict=True))
        np.testing.assert_array_equal(np.concatenate([one for one, _ in pairs]), whole["number"])
        np.testing.assert_array_equal(np.concatenate([other for _, other in pairs]), whole["when"])


def test_a_short_table_never_touches_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda: pytest.fail("made a file"))
    spool = Spool(ROW, block=10)
    spool.add(rows(9))
    assert len(spool["number"]) == 9


def test_no_room_is_said_with_the_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    with pytest.raises(OperationError, match=r"No space left on device; TMPDIR names another") as said:
        Spool(ROW, block=10).add(rows(30))
    assert str(said.value).startswith(tempfile.gettempdir())


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc")
def test_the_file_ends_with_the_table() -> None:
    def files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    before = files()
    spool = Spool(ROW, block=10)
    spool.add(rows(30))
    assert files() == before + 1
    del spool
    assert files() == before
