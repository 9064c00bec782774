"""What `hilrig demo` says at its end: which parts are missing, why, and whether that is a failure."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from hilrig_cli.local.demo import DemoRun, Review
from hilrig_replay.analysis.latency import LatencyReport
from hilrig_replay.analysis.verify import Verification
from hilrig_replay.grading.placement import PartPlacement, PlacementReport

DONE = {"done_s": 12.1, "duration_s": 20.0, "doing": "", "missing": []}
LATE = {"done_s": None, "duration_s": 12.0, "doing": "take blue", "missing": ["blue", "green"]}
TORN: dict[str, Any] = {}


def review(controller: dict[str, Any], *standing: str) -> Review:
    parts = [PartPlacement(name, 0, 0.25) if name in standing else PartPlacement(name, None, None) for name in SCENE]
    exact = Verification(100, 0, 0, True, 0.0, (0, 0, 0, 0), (0, 0, 0, 0), 0.0, None, "here")
    latency = cast(LatencyReport, SimpleNamespace(samples=100))
    run = DemoRun(Path("run.mcap"), controller)
    return Review(run, latency, exact, PlacementReport(tuple(parts)), Path("latency.png"), Path("run.rrd"))


SCENE = ("red", "blue", "green")
PLACED = "placed: 3 of 3 parts stand in the tray, at most 0.25 mm from their places"


@pytest.mark.parametrize(
    ("controller", "standing", "good", "said"),
    [
        (DONE, SCENE, True, PLACED),
        # It ended on its way home: nothing is missing.
        (LATE | {"missing": [], "doing": "home"}, SCENE, True, PLACED),
        (
            LATE,
            ("red",),
            True,
            "placed: 1 of 3 parts stand in the tray, at most 0.25 mm from their places; not blue, green: "
            "the controller's 12 s were over at 'take blue'",
        ),
        (
            DONE,
            ("red", "blue"),
            False,
            "placed: 2 of 3 parts stand in the tray, at most 0.25 mm from their places; not green: "
            "the controller believed green placed",
        ),
        (TORN, (), False, "placed: 0 of 3 parts stand in the tray; not red, blue, green: the controller ended badly"),
        # Time explains what the controller knows that it did not do, and nothing else.
        (
            LATE,
            (),
            False,
            "placed: 0 of 3 parts stand in the tray; not red, blue, green: "
            "the controller's 12 s were over at 'take blue'; the controller believed red placed",
        ),
    ],
)
def test_what_is_not_placed_is_named_with_its_reason(
    controller: dict[str, Any], standing: tuple[str, ...], good: bool, said: str
) -> None:
    found = review(controller, *standing)
    assert found.sentences()[1] == said
    assert found.good is good
    assert bool(found.why_missing) is bool(found.missing)
    assert found.missing == [name for name in SCENE if name not in standing]
