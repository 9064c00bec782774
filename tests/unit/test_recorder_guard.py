"""One recorder a lab, and sessions that a person begins and ends."""

import random
from pathlib import Path

import pytest

from hilrig_recorder.by_hand import HandSessions
from hilrig_recorder.guard import FolderLock, elder, introduction
from hilrig_runtime.bus import Answer
from hilrig_runtime.errors import OperationError
from hilrig_schemas import Event, OpenSession

WALL = 1_767_225_600_000_000_000


def test_a_folder_is_held_by_one_and_free_when_it_lets_go(tmp_path: Path) -> None:
    with FolderLock(tmp_path), pytest.raises(OperationError, match=r"another recorder \(process \d+ on .*\) records"):
        FolderLock(tmp_path)
    FolderLock(tmp_path).close()


def test_of_two_recorders_the_younger_gives_way() -> None:
    answers = [Answer("k1", introduction("recorder/1", 100)), Answer("k2", introduction("recorder/2", 200))]
    assert elder(answers, 100) == ""
    assert elder(answers, 200) == "recorder/1 (k1)"


def test_answers_that_mean_nothing_are_passed_over() -> None:
    assert elder([Answer("k", b"\xff"), Answer("k", b"", "refused"), Answer("k", b"")], 200) == ""


def sessions() -> HandSessions:
    return HandSessions(["rig1", "rig2"], random.Random(1))


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
    with pytest.raises(OperationError, match="it has rig1, rig2"):
        by_hand.begin("rig3", WALL)
    with pytest.raises(OperationError, match="not being recorded by hand"):
        by_hand.end("rig2")


def test_a_session_of_a_recorder_before_goes_on_and_can_be_ended() -> None:
    by_hand = sessions()
    by_hand.restore(OpenSession(rig="rig1", session="old"))
    assert by_hand.end("rig1").session == "old"
