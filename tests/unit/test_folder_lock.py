"""One recorder a rig, and sessions that a person begins and ends."""

import random
from pathlib import Path

import pytest

from hilrig_recorder.ingest.manual_sessions import HandSessions
from hilrig_recorder.ingest.rig_partition import Share
from hilrig_recorder.storage.folder_lock import FolderLock
from hilrig_runtime.errors import OperationError
from hilrig_schemas import Event, OpenSession

WALL = 1_767_225_600_000_000_000


def test_a_rig_s_recordings_are_held_by_one_recorder_and_free_when_it_lets_go(tmp_path: Path) -> None:
    refusal = r"another recorder \(process \d+ on .*\) records rig2 there"
    with FolderLock(tmp_path, "1", ["rig1", "rig2"]), pytest.raises(OperationError, match=refusal):
        FolderLock(tmp_path, "2", ["rig2", "rig3"])
    FolderLock(tmp_path, "2", ["rig2", "rig3"]).close()


def test_two_recorders_share_a_folder_when_they_share_no_rig(tmp_path: Path) -> None:
    with FolderLock(tmp_path, "1", ["rig1"]), FolderLock(tmp_path, "2", ["rig2"]):
        with pytest.raises(OperationError, match="choose another --instance"):
            FolderLock(tmp_path, "2", ["rig3"])
        with pytest.raises(OperationError, match="records rig1 there"):
            FolderLock(tmp_path, "3", ["rig1", "rig3"])


@pytest.mark.parametrize("content", ["", "no json", "[]", "{}"])
def test_a_lock_that_says_nothing_and_is_held_by_nobody_is_in_nobody_s_way(tmp_path: Path, content: str) -> None:
    (tmp_path / ".recorder-old.lock").write_text(content)
    FolderLock(tmp_path, "1", ["rig1"]).close()


def test_each_rig_is_one_recorder_s_also_those_that_were_added_since() -> None:
    lab = ["rig1", "rig2", "rig3"]
    shares = [Share(lab, ["rig1", "rig3"]), Share(lab, ["rig2"])]
    for rig, owner in (("rig1", 0), ("rig2", 1), ("rig3", 0), ("added", 0)):
        assert [share.has(rig) for share in shares] == [owner == 0, owner == 1]
    assert [share.lists("added") for share in shares] == [False, False]


def sessions() -> HandSessions:
    return HandSessions(["rig1", "rig2"].__contains__, random.Random(1))


def test_a_session_by_hand_has_an_id_like_any_other() -> None:
    by_hand = sessions()
    event = by_hand.begin("rig1", WALL)
    assert event.kind == Event.SESSION_START
    assert event.session.startswith("20260101T000000Z-rig1-")
    assert [session.session for session in by_hand.sessions] == [event.session]
    assert by_hand.end("rig1").session == event.session
    assert by_hand.sessions == []


def test_what_can_not_be_is_refused_with_the_reason() -> None:
    by_hand = sessions()
    by_hand.begin("rig1", WALL)
    with pytest.raises(OperationError, match="already"):
        by_hand.begin("rig1", WALL)
    with pytest.raises(OperationError, match="there is no rig 'rig3'"):
        by_hand.begin("rig3", WALL)
    with pytest.raises(OperationError, match="not being recorded by hand"):
        by_hand.end("rig2")


def test_a_session_of_a_recorder_before_goes_on_and_can_be_ended() -> None:
    by_hand = sessions()
    by_hand.restore(OpenSession(rig="rig1", session="old"))
    assert by_hand.end("rig1").session == "old"
