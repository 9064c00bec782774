"""A manual recording of a controller's session is marked, and only the session of the controller is graded."""

from pathlib import Path

import pytest

from hilrig_replay.analysis.index import RunIndex
from hilrig_replay.grading.overlap import Span, overlapping
from hilrig_replay.report.report import build_report
from support.labs import hilrig
from support.recordings import START_WALL_NS, Script, make, write

TASK = "[[task.poses]]\nname = 'a'\nposition_mm = [400, 200, 0]\n"
CONTROLLER = Span("controller", "rig1", False, 100, 200, (7,))
MANUAL = Span("manual", "rig1", True, 150, 300, (7, 7))


@pytest.mark.parametrize(
    ("other", "is_marked"),
    [
        (MANUAL, True),
        (MANUAL._replace(start_ns=50, end_ns=101), True),
        (MANUAL._replace(incarnations=(6, 7)), True),
        (MANUAL._replace(start_ns=200), False),
        (MANUAL._replace(start_ns=0, end_ns=100), False),
        (MANUAL._replace(rig="rig2"), False),
        # The rig of another computer has the same name.
        (MANUAL._replace(incarnations=(8,)), False),
        # Sessions of controllers overlap only by their pre-roll.
        (MANUAL._replace(is_manual=False), False),
    ],
)
def test_only_sessions_of_one_rig_at_one_time_overlap(other: Span, is_marked: bool) -> None:
    expected = [("manual",), ("controller",)] if is_marked else [(), ()]
    assert overlapping([CONTROLLER, other]) == expected


def session(folder: Path, name: str, script: Script, start_s: float) -> Path:
    start_ns = START_WALL_NS + round(start_s * 1e9)
    metadata = {
        "hilrig.session": {
            "session": name,
            "rig": "rig1",
            "controller": "192.0.2.7:40001" if name.startswith("controller") else "",
            "schema_version": "hilrig.v1",
            "start_wall_ns": str(start_ns),
        },
        "hilrig.summary": {
            "ended": "ended",
            "lost_transport": "0",
            "lost_recorder": "0",
            "end_wall_ns": str(start_ns + 4_000_000_000),
        },
    }
    made = make(script, session="controller")
    return write(folder / f"{name}.mcap", made, script=script, session=name, metadata=metadata, lab_toml=TASK)


def test_manual_recording_is_marked_and_not_graded(tmp_path: Path) -> None:
    script = Script(seconds=4.0)
    one = session(tmp_path, "controller", script, 0.0)
    two = session(tmp_path, "manual", script, 1.0)
    entries = {entry.session: entry.overlaps for entry in RunIndex(tmp_path).load()}
    assert entries == {"controller": ("manual",), "manual": ("controller",)}
    report = build_report([two, one])
    assert [run["session"] for run in report.runs] == ["controller", "manual"]
    assert [run["grade"] is None for run in report.runs] == [False, True]
    assert report.overlaps == ("manual: recorded manually at the time of controller: not graded",)
    assert "overlaps with manual" in report.html
    assert "overlaps with controller" in report.html
    assert build_report([two]).runs[0]["grade"] is not None
    listed = " ".join(hilrig("runs", tmp_path).stdout.split())
    assert "overlaps with manual" in listed
    assert "overlaps with controller" in listed
    assert "manual: recorded manually" in hilrig("report", tmp_path, "-o", tmp_path / "r.html").stderr
