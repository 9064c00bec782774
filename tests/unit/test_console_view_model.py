"""The model of the console's page: batches, answers, events and reports come in, what a browser gets comes out."""

import json
import math
from typing import Any

import numpy as np
import pytest

from hilrig_console.arm_picture import AT_STOP, HOLDS, MAGNET, pose_of, scene_of
from hilrig_console.events import KEPT, EventLog
from hilrig_console.poses import Poses
from hilrig_console.view_model import Frame, Page, Seen
from hilrig_monitoring.lab_view import REMOVED_AFTER_S, SILENT_AFTER_S, LabView
from hilrig_runtime.config.lab import LabConfig
from hilrig_schemas import Event, Health, JointState, PartState, RigBatch, RigConfig, RigReport, Roster
from hilrig_sim.arm.kinematics import forward
from hilrig_sim.arm.model import ArmParameters, RigParameters
from hilrig_sim.parameters import rig_parameters

LAB = LabConfig()
RIG = rig_parameters(LAB, LAB.rigs[0])


def state(position: tuple[float, ...] = (0.5, -0.8, 0.1, 0.2), **more: Any) -> JointState:
    return JointState(incarnation=7, position=position, **more)


def batch(**states: JointState) -> bytes:
    return RigBatch(rigs=states, messages=[one.SerializeToString() for one in states.values()]).SerializeToString()


def config(parameters: RigParameters = RIG) -> RigConfig:
    return RigConfig(parameters_json=parameters.to_json())


def poses(*rigs: str, now_s: float = 0.0) -> Poses:
    made = Poses()
    made.hear([batch(**dict.fromkeys(rigs, state()))], now_s)
    for rig in rigs:
        made.learn(rig, config())
    return made


@pytest.mark.parametrize("joints", [(0.0, 0.0, 0.0, 0.0), (0.5, -0.8, 0.1, 0.2), (-2.0, 2.5, 0.2, -6.0)])
def test_a_pose_has_the_tool_where_the_kinematics_have_it(joints: tuple[float, ...]) -> None:
    pose = pose_of(ArmParameters(), state(joints))
    assert pose is not None
    tool = forward(ArmParameters(), np.array(joints))[:3] * 1000
    assert pose[2:5] == pytest.approx(tool, abs=0.5)
    assert math.hypot(pose[0], pose[1]) == pytest.approx(300, abs=1)


def test_flags_tell_of_magnet_part_and_stop() -> None:
    shown = pose_of(ArmParameters(), state(magnet=True, held_part="red", limit_flags=1))
    assert shown is not None
    assert shown[5] == MAGNET | HOLDS | AT_STOP
    for said, flag in (({"magnet": True}, MAGNET), ({"held_part": "red"}, HOLDS), ({"limit_flags": 256}, AT_STOP)):
        one = pose_of(ArmParameters(), state(**said))
        assert one is not None
        assert one[5] == flag
    assert pose_of(ArmParameters(), state((math.nan, 0.0, 0.0, 0.0))) is None


def test_a_scene_has_the_parts_in_the_order_of_the_states() -> None:
    scene = scene_of(RIG)
    assert [part["name"] for part in scene["parts"]] == [part.name for part in RIG.scene.parts]
    assert scene["span"] == 600
    assert (scene["top"], scene["bottom"]) == (139, -61)
    assert scene["reach"].count("M") == 3
    json.dumps(scene)


def test_a_rig_is_drawn_when_it_is_known_what_it_looks_like() -> None:
    made = Poses()
    made.hear([batch(rig1=state())], 0.0)
    assert made.unknown() == ["rig1"]
    assert made.drawn(0.0) == {}
    made.learn("rig1", None)
    assert made.unknown() == ["rig1"]
    made.learn("rig1", config())
    assert made.unknown() == []
    made.hear([batch(rig1=state())], 0.1)
    number, pose, parts = made.drawn(0.1)["rig1"]
    assert (number, len(pose), parts) == (0, 6, [])


def test_an_answer_that_is_not_understood_is_not_asked_for_again() -> None:
    made = Poses()
    made.hear([batch(rig1=state())], 0.0)
    made.learn("rig1", RigConfig(parameters_json="{}"))
    assert made.unknown() == []


def test_a_simulation_that_starts_anew_is_asked_again_and_rigs_share_a_scene() -> None:
    made = poses("rig1", "rig2")
    assert len(made.scenes) == 1
    again = state()
    again.incarnation = 8
    made.hear([batch(rig1=again)], 0.1)
    assert made.unknown() == ["rig1"]
    other = RigParameters(arm=ArmParameters(l2=0.4), scene=RIG.scene)
    made.learn("rig1", config(other))
    made.hear([batch(rig1=again, rig2=state())], 0.2)
    assert [drawn[0] for drawn in made.drawn(0.2).values()] == [1, 0]


def test_parts_stay_where_they_were_said_to_be_last() -> None:
    made = poses("rig1")
    moved = state(parts=[PartState(name="red", x=0.1, y=-0.2, z=0.0, yaw=math.pi / 2)])
    made.hear([batch(rig1=moved)], 0.1)
    made.hear([batch(rig1=state())], 0.2)
    assert made.drawn(0.2)["rig1"][2] == [[100, -200, 90]]


def test_of_several_states_the_newest_pose_and_the_newest_parts_count() -> None:
    made = poses("rig1", "rig2")

    def placed(x: float) -> JointState:
        return state((0.0, 0.0, 0.0, 0.0), parts=[PartState(name="red", x=x, y=0.1, z=0.1, yaw=0.1)])

    still, bent = state((0.0, 0.0, 0.0, 0.0)), state((math.pi / 2, 0.0, 0.0, 0.0))
    made.hear([batch(rig1=placed(0.1)), batch(rig1=placed(0.2), rig2=bent), batch(rig1=bent), batch(rig2=still)], 0.1)
    drawn = made.drawn(0.1)
    assert [drawn[rig][1][2:4] for rig in ("rig1", "rig2")] == [[0, 600], [600, 0]]
    assert drawn["rig1"][2] == [[200, 100, 6]]
    # Also later, when how long such a state is is known.
    made.hear([batch(rig1=placed(0.3)), batch(rig1=still)], 0.2)
    assert made.drawn(0.2)["rig1"][2] == [[300, 100, 6]]


def test_a_rig_that_is_silent_is_drawn_no_more_and_garbage_changes_nothing() -> None:
    made = poses("rig1")
    made.hear([batch(rig1=state())], 1.0)
    made.hear([b"\xff\xff garbage"], 1.0)
    assert "rig1" in made.drawn(1.0 + SILENT_AFTER_S)
    assert made.drawn(1.1 + SILENT_AFTER_S) == {}


def test_events_are_numbered_and_old_ones_are_dropped() -> None:
    log = EventLog(1000)
    for number in range(KEPT + 5):
        log.hear(Event(rig="rig1", kind=Event.LIMIT_HIT, severity=Event.WARNING, text=f"{number}").SerializeToString())
    log.hear(b"\xff no event")
    kept = log.all()
    assert len(kept) == KEPT
    assert [number for number, _ in kept] == list(range(1006, 1006 + KEPT))
    last = json.loads(kept[-1][1])
    assert (last["id"], last["kind"], last["severity"]) == (1000 + KEPT + 5, "limit_hit", "warning")


def test_a_kind_of_event_that_is_newer_than_this_version_is_shown_by_its_number() -> None:
    log = EventLog(0)
    event = Event(text="x" * 10_000)
    event.kind = 99  # type: ignore[assignment]
    log.hear(event.SerializeToString())
    shown = json.loads(log.all()[0][1])
    assert (shown["kind"], len(shown["text"])) == ("99", 500)


def test_a_browser_gets_what_is_new_to_it_and_a_slow_one_misses_no_event() -> None:
    first = Frame("{1}", "{a}", ((5, "e5"),))
    text, seen = first.news(Seen())
    assert text == "event: lab\ndata: {1}\n\nevent: event\nid: 5\ndata: e5\n\nevent: poses\ndata: {a}\n\n"
    assert first.news(seen) == ("", seen)
    later = Frame("{3}", "{a}", ((5, "e5"), (6, "e6"), (7, "e7")))
    text, seen = later.news(seen)
    assert text == "event: lab\ndata: {3}\n\nevent: event\nid: 6\ndata: e6\n\nevent: event\nid: 7\ndata: e7\n\n"
    assert seen.event == 7
    returned, _ = later.news(Seen(event=6))
    assert "id: 6" not in returned
    assert "id: 7" in returned


def page() -> Page:
    made = Page("lab", ("rig1", "rig2"), 0)
    sim = [RigReport(rig="rig1", loop_us=[20_000, 30_000]), RigReport(rig="rig2", safe=True)]
    edge = [RigReport(rig="rig1", controller="192.0.2.7:9", session="s"), RigReport(rig="rig2")]
    made.view.update(Health(service="sim", instance="1", overruns=3, lateness_p99_ns=40_000, rig_reports=sim), 0.0)
    made.view.update(Health(service="edge", instance="1", rig_reports=edge), 0.0)
    made.view.update(Health(service="recorder", instance="1", rig_reports=[RigReport(rig="rig1", recording=True)]), 0.0)
    made.know([Roster(service="edge", instance="1", rigs=["rig1", "rig2"], addresses=["h:5020", "h:5021"])])
    return made


def test_the_page_has_each_rig_with_its_address_session_loop_and_tick() -> None:
    lab = json.loads(page().frame(0.0, {"runs": 4}).lab)
    assert (lab["lab"], lab["link"], lab["runs"], lab["scenes"]) == ("lab", "", 4, 0)
    first, second = lab["rigs"]
    assert first["state"] == "in use"
    assert (first["address"], first["controller"], first["session"], first["recording"]) == (
        "h:5020",
        "192.0.2.7:9",
        "s",
        True,
    )
    assert (first["loop_p50_ms"], first["lateness_p99_ms"], first["overruns"]) == (20.0, 0.04, 3)
    assert (second["state"], second["address"]) == ("free", "h:5021")


def test_without_a_lab_the_page_says_so_and_why() -> None:
    made = Page("lab", ("rig1",), 0)
    made.link("no zenoh router answers")
    lab = json.loads(made.frame(0.0, {}).lab)
    assert (lab["services"], lab["link"]) == ([], "no zenoh router answers")
    assert [rig["state"] for rig in lab["rigs"]] == ["no edge"]
    assert made.frame(0.0, {}).poses == "{}"


def test_the_lab_is_told_once_a_second() -> None:
    made = page()
    first = made.frame(0.0, {})
    assert made.frame(0.9, {}).lab is first.lab
    assert made.frame(1.0, {}).lab != first.lab


def test_a_page_hears_of_a_lab_in_which_nothing_happens() -> None:
    made, seen = Page("lab", (), 0), Seen()
    for second in range(3):
        text, seen = made.frame(float(second), {}).news(seen)
        assert text.startswith("event: lab\n")


@pytest.mark.parametrize(
    ("edge", "sim", "state"),
    [
        (None, RigReport(rig="r"), "no edge"),
        (RigReport(rig="r"), None, "no simulation"),
        (RigReport(rig="r", watchdog_tripped=True), RigReport(rig="r", safe=True), "free"),
        (
            RigReport(rig="r", controller="c:1", watchdog_tripped=True),
            RigReport(rig="r", safe=True),
            "watchdog tripped",
        ),
        (RigReport(rig="r", controller="c:1"), RigReport(rig="r", safe=True), "no command"),
        (RigReport(rig="r", controller="c:1"), RigReport(rig="r"), "in use"),
    ],
)
def test_the_state_of_a_rig_in_two_words(edge: RigReport | None, sim: RigReport | None, state: str) -> None:
    view = LabView(("r",))
    for service, report in (("edge", edge), ("sim", sim)):
        view.update(Health(service=service, instance="1", rig_reports=[] if report is None else [report]), 0.0)
    assert view.rigs(0.0)[0].state == state


def test_a_service_that_is_long_gone_is_forgotten() -> None:
    view = LabView(())
    view.update(Health(service="edge", instance="old"), 0.0)
    view.update(Health(service="edge", instance="new"), REMOVED_AFTER_S)
    assert len(view.services()) == 2
    view.update(Health(service="edge", instance="new"), REMOVED_AFTER_S + 1)
    assert [service.name for service in view.services()] == ["edge/new"]
