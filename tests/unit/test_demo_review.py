"""Summary of `hilrig demo`: missing parts, the reason, and whether the demo passed."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from hilrig_cli.local.demo import DemoRun, Review
from hilrig_replay.analysis.latency import LatencyReport
from hilrig_replay.analysis.verify import Verification
from hilrig_replay.grading.placement import PartPlacement, PlacementReport

DONE = {"done_s": 12.1, "duration_s": 20.0, "doing": "", "missing": []}
LATE = {"done_s": None, "duration_s": 12.0, "doing": "pick blue", "missing": ["blue", "green"]}
FAILED: dict[str, Any] = {}


def review(controller: dict[str, Any], *in_tray: str) -> Review:
    parts = [PartPlacement(name, 0, 0.25) if name in in_tray else PartPlacement(name, None, None) for name in SCENE]
    exact = Verification(100, 0, 0, True, 0.0, (0, 0, 0, 0), (0, 0, 0, 0), 0.0, None, {}, (), "here")
    latency = cast(LatencyReport, SimpleNamespace(samples=100))
    run = DemoRun(Path("run.mcap"), controller)
    return Review(run, latency, exact, PlacementReport(tuple(parts)), Path("latency.png"), Path("run.rrd"))


SCENE = ("red", "blue", "green")
PLACED = "placed: 3 of 3 parts are in the tray, position error at most 0.25 mm"


@pytest.mark.parametrize(
    ("controller", "in_tray", "passed", "summary"),
    [
        (DONE, SCENE, True, PLACED),
        # Its time ended on the move home, so no part is missing.
        (LATE | {"missing": [], "doing": "home"}, SCENE, True, PLACED),
        (
            LATE,
            ("red",),
            True,
            "placed: 1 of 3 parts are in the tray, position error at most 0.25 mm; missing blue, green: "
            "the controller's 12 s ended during 'pick blue'",
        ),
        (
            DONE,
            ("red", "blue"),
            False,
            "placed: 2 of 3 parts are in the tray, position error at most 0.25 mm; missing green: "
            "the controller reported green as placed",
        ),
        (FAILED, (), False, "placed: 0 of 3 parts are in the tray; missing red, blue, green: the controller failed"),
        # Lack of time explains only the parts that the controller itself reported as missing.
        (
            LATE,
            (),
            False,
            "placed: 0 of 3 parts are in the tray; missing red, blue, green: "
            "the controller's 12 s ended during 'pick blue'; the controller reported red as placed",
        ),
    ],
)
def test_missing_parts_are_listed_with_the_reason(
    controller: dict[str, Any], in_tray: tuple[str, ...], passed: bool, summary: str
) -> None:
    result = review(controller, *in_tray)
    assert result.summary_lines()[1] == summary
    assert result.passed is passed
    assert bool(result.missing_reason) is bool(result.missing)
    assert result.missing == [name for name in SCENE if name not in in_tray]
