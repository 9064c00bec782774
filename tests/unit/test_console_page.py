"""The page's JavaScript reads only fields, states and addresses that the console sends."""

import itertools
import json
import re
from collections.abc import Set
from pathlib import Path

import pytest

from hilrig_console import catalog
from hilrig_console.app import FRAME_PERIOD_S, STATIC_FOLDER
from hilrig_console.events import MAX_EVENTS, EventBuffer
from hilrig_console.view_model import ClientState, ViewModel
from hilrig_monitoring.lab_view import LabView, RigStatus
from hilrig_replay.analysis.index import RunEntry
from hilrig_replay.geometry import arm_picture
from hilrig_schemas import Event, ExceptionCount, Health, RigReport
from support.recordings import PARAMETERS

SCRIPT = (STATIC_FOLDER / "console.js").read_text(encoding="utf-8")


def body(head: str) -> str:
    """Source of a function or method, from its head to the closing brace of the same indentation."""
    found = re.search(rf"^( *){re.escape(head)}.*?^\1}}$", SCRIPT, re.DOTALL | re.MULTILINE)
    assert found, head
    return found[0]


def fields_read(variable: str, *heads: str) -> set[str]:
    return {name for head in heads for name in re.findall(rf"(?<![\w.]){variable}\.(\w+)", body(head))}


def lab_message() -> dict[str, Set[str]]:
    model = ViewModel("lab", LabView(("rig1",)), start=0)
    model.view.update(Health(service="sim", instance="1"), 0.0)
    refused = ExceptionCount(host="127.0.0.1", function=3, code=2, count=7)
    model.view.update(
        Health(service="edge", rig_reports=[RigReport(rig="rig1", exceptions=[refused], student="ada")]), 0.0
    )
    lab = json.loads(model.frame(0.0, {"runs": 1}).lab)
    return {
        "lab": lab.keys(),
        "rig": lab["rigs"][0].keys(),
        "service": lab["services"][0].keys(),
        "refused": lab["rigs"][0]["exceptions"][0].keys(),
    }


def event_row() -> Set[str]:
    buffer = EventBuffer(0)
    buffer.add("hil/lab/sim/event", Event(text="text").SerializeToString())
    row: dict[str, object] = json.loads(buffer.entries()[0][1])
    return row.keys()


def run_list(folder: Path) -> tuple[Set[str], Set[str]]:
    with catalog.RecordingCatalog(folder) as recordings:
        recordings._entries = [RunEntry("run.mcap", size=1, mtime_ns=1)]
        found = recordings.search("")
    return found.keys(), found["runs"][0].keys()


def test_fields_of_the_lab_are_sent() -> None:
    sent = lab_message()
    # `lab.toml` is part of a message.
    assert {"rigs", "services"} <= fields_read("lab", "function showLab(") - {"toml"} <= sent["lab"]
    assert {"state", "loop_p50_ms"} <= fields_read("rig", "update(rig, runs)") <= sent["rig"]
    assert (
        {"host", "silent"} <= fields_read("service", "function showServices(", "function showLab(") <= sent["service"]
    )
    assert {"host", "function", "code", "count"} == fields_read("refused", "function showRefused(") == sent["refused"]
    assert set(re.findall(r"\(rig\) => rig\.(\w+)", body("function showLab("))) - {"level"} <= sent["rig"]


def test_fields_of_an_event_are_sent() -> None:
    assert {"text", "severity"} <= fields_read("event", "function showEvent(") <= event_row()


def test_fields_of_a_recording_are_sent(tmp_path: Path) -> None:
    reply, run = run_list(tmp_path)
    assert {"found", "total"} <= fields_read("list", "function showRuns(") <= reply
    assert {"path", "fit"} <= fields_read("run", "function showRuns(") <= run


def test_fields_of_a_scene_are_sent() -> None:
    scene = arm_picture.scene_of(PARAMETERS)
    (names,) = re.findall(r"const \{([\w, ]+)\} = this\.scene;", SCRIPT)
    assert {"span", "top"} <= fields_read("scene", "build(scene)") | set(names.split(", ")) <= scene.keys()
    assert {"at", "places"} <= fields_read("tray", "build(scene)") <= scene["trays"][0].keys()
    assert {"at", "round"} <= fields_read("part", "build(scene)") <= scene["parts"][0].keys()


def table(name: str) -> set[str]:
    (text,) = re.findall(rf"const {name} = \{{(.*?)\}};", SCRIPT)
    return set(re.findall(r'"?(\w[\w ]*)"?: ', text))


def test_page_knows_each_state_of_a_rig() -> None:
    states = {
        RigStatus("rig1", controller, served=served, simulated=simulated, watchdog_tripped=tripped, safe=safe).state
        for controller in ("", "a:1")
        for served, simulated, tripped, safe in itertools.product((False, True), repeat=4)
    }
    assert table("LEVELS") == states


def test_page_knows_each_severity() -> None:
    assert table("SEVERITIES") == {name.lower() for name, number in Event.Severity.items() if number}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("MAX_EVENTS", MAX_EVENTS),
        ("ANIMATION_MS", round(1000 * FRAME_PERIOD_S)),
        ("HOLDS_PART", arm_picture.HOLDS_PART),
        ("MAGNET_ON", arm_picture.MAGNET_ON),
    ],
)
def test_constants_of_the_page_equal_those_of_python(name: str, value: int) -> None:
    assert re.findall(rf"\b{name} = (\d+)", SCRIPT) == [str(value)]


def test_page_listens_to_each_kind_of_message() -> None:
    model = ViewModel("lab", LabView(("rig1",)), start=0)
    model.events.add("hil/lab/sim/event", Event(text="text").SerializeToString())
    text, _ = model.frame(0.0, {}).updates(ClientState())
    assert set(re.findall(r'on\("(\w+)", ', SCRIPT)) == set(re.findall(r"^event: (\w+)$", text, re.MULTILINE))


def test_page_requests_existing_routes() -> None:
    source = (STATIC_FOLDER.parent / "app.py").read_text(encoding="utf-8")
    routes = set(re.findall(r'Route\("/(\w+)', source))
    requested = set(re.findall(r'(?:fetch\(["`]|EventSource\("|href: `)(\w+)', SCRIPT))
    assert requested == routes
