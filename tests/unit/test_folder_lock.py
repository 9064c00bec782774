"""One recorder per rig (folder locks, partition), and manual sessions."""

import os
import random
from contextlib import closing
from pathlib import Path

import pytest

from hilrig_recorder.ingest.manual_sessions import ManualSessions
from hilrig_recorder.ingest.rig_partition import RigPartition
from hilrig_recorder.storage.folder_lock import FolderLock
from hilrig_runtime.errors import OperationError
from hilrig_schemas import Event, OpenSession

WALL = 1_767_225_600_000_000_000


def test_rig_is_locked_until_its_recorder_closes(tmp_path: Path) -> None:
    refusal = r"another recorder \(process \d+ on .*\) already records rig2 in this folder"
    with closing(FolderLock(tmp_path, "1", ["rig1", "rig2"])), pytest.raises(OperationError, match=refusal):
        FolderLock(tmp_path, "2", ["rig2", "rig3"])
    FolderLock(tmp_path, "2", ["rig2", "rig3"]).close()


def test_recorders_of_different_rigs_share_a_folder(tmp_path: Path) -> None:
    with closing(FolderLock(tmp_path, "1", ["rig1"])), closing(FolderLock(tmp_path, "2", ["rig2"])):
        with pytest.raises(OperationError, match="choose another --instance"):
            FolderLock(tmp_path, "2", ["rig3"])
        with pytest.raises(OperationError, match="already records rig1 in this folder"):
            FolderLock(tmp_path, "3", ["rig1", "rig3"])


@pytest.mark.parametrize("content", ["", "not json", "[]", "{}"])
def test_unheld_lock_file_with_any_content_is_ignored(tmp_path: Path, content: str) -> None:
    (tmp_path / ".recorder-old.lock").write_text(content)
    FolderLock(tmp_path, "1", ["rig1"]).close()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs POSIX FIFOs")
@pytest.mark.timeout(20)
def test_fifo_with_the_name_of_a_lock_does_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / ".recorder-old.lock")
    (tmp_path / ".recorder-folder.lock").mkdir()
    FolderLock(tmp_path, "1", ["rig1"]).close()
    with pytest.raises(OperationError, match=r"\.recorder-old\.lock: can't be locked: expected a regular file"):
        FolderLock(tmp_path, "old", ["rig1"])


def test_each_rig_also_an_added_one_has_one_recorder() -> None:
    lab = ["rig1", "rig2", "rig3"]
    partitions = [RigPartition(lab, ["rig1", "rig3"]), RigPartition(lab, ["rig2"])]
    for rig, owner in (("rig1", 0), ("rig2", 1), ("rig3", 0), ("added", 0)):
        assert [partition.contains(rig) for partition in partitions] == [owner == 0, owner == 1]
    assert [partition.contains_configured("added") for partition in partitions] == [False, False]


def manual_sessions() -> ManualSessions:
    return ManualSessions(["rig1", "rig2"].__contains__, random.Random(1))


def test_manual_session_has_a_session_id() -> None:
    manual = manual_sessions()
    event = manual.start("rig1", WALL)
    assert event.kind == Event.SESSION_START
    assert event.session.startswith("20260101T000000Z-rig1-")
    assert [session.session for session in manual.sessions] == [event.session]
    assert manual.stop("rig1").session == event.session
    assert manual.sessions == []


def test_invalid_manual_requests_are_refused_with_the_reason() -> None:
    manual = manual_sessions()
    manual.start("rig1", WALL)
    with pytest.raises(OperationError, match="already"):
        manual.start("rig1", WALL)
    with pytest.raises(OperationError, match="there is no rig 'rig3'"):
        manual.start("rig3", WALL)
    with pytest.raises(OperationError, match="no manual recording is running"):
        manual.stop("rig2")


def test_restored_manual_session_can_be_stopped() -> None:
    manual = manual_sessions()
    manual.restore(OpenSession(rig="rig1", session="old"))
    assert manual.stop("rig1").session == "old"
