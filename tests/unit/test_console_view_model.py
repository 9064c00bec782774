"""View model of the console: poses, events, and the messages to a browser."""

import json
import math
from typing import Any

import numpy as np
import pytest

from hilrig_console.events import MAX_EVENTS, EventBuffer
from hilrig_console.poses import PoseCache
from hilrig_console.view_model import ClientState, Frame, ViewModel
from hilrig_monitoring.lab_view import REMOVED_AFTER_S, SILENT_AFTER_S, LabView
from hilrig_replay.geometry.arm_picture import AT_STOP, HOLDS_PART, MAGNET_ON, pose_of, scene_of
from hilrig_runtime.config.lab import LabConfig
from hilrig_schemas import Event, Health, JointState, PartState, RigBatch, RigConfig, RigReport, ServiceInfo
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


def poses(*rigs: str, now_s: float = 0.0) -> PoseCache:
    cache = PoseCache()
    cache.add([batch(**dict.fromkeys(rigs, state()))], now_s)
    for rig in rigs:
        cache.configure(rig, config())
    return cache


@pytest.mark.parametrize("joints", [(0.0, 0.0, 0.0, 0.0), (0.5, -0.8, 0.1, 0.2), (-2.0, 2.5, 0.2, -6.0)])
def test_pose_equals_forward_kinematics(joints: tuple[float, ...]) -> None:
    pose = pose_of(ArmParameters(), state(joints))
    assert pose is not None
    tool = forward(ArmParameters(), np.array(joints))[:3] * 1000
    assert pose[2:5] == pytest.approx(tool, abs=0.5)
    assert math.hypot(pose[0], pose[1]) == pytest.approx(300, abs=1)


def test_flags_contain_magnet_part_and_stop() -> None:
    shown = pose_of(ArmParameters(), state(magnet=True, held_part="red", limit_flags=1))
    assert shown is not None
    assert shown[5] == MAGNET_ON | HOLDS_PART | AT_STOP
    for fields, flag in (
        ({"magnet": True}, MAGNET_ON),
        ({"held_part": "red"}, HOLDS_PART),
        ({"limit_flags": 256}, AT_STOP),
    ):
        one = pose_of(ArmParameters(), state(**fields))
        assert one is not None
        assert one[5] == flag
    assert pose_of(ArmParameters(), state((math.nan, 0.0, 0.0, 0.0))) is None


def test_scene_has_parts_in_order_of_states() -> None:
    scene = scene_of(RIG)
    assert [part["name"] for part in scene["parts"]] == [part.name for part in RIG.scene.parts]
    assert scene["span"] == 600
    assert (scene["top"], scene["bottom"]) == (139, -61)
    assert scene["reach"].count("M") == 3
    json.dumps(scene)


def test_pose_needs_configuration_of_rig() -> None:
    cache = PoseCache()
    cache.add([batch(rig1=state())], 0.0)
    assert cache.unconfigured() == ["rig1"]
    assert cache.as_dict(0.0) == {}
    cache.configure("rig1", None)
    assert cache.unconfigured() == ["rig1"]
    cache.configure("rig1", config())
    assert cache.unconfigured() == []
    cache.add([batch(rig1=state())], 0.1)
    number, pose, parts = cache.as_dict(0.1)["rig1"]
    assert (number, len(pose), parts) == (0, 6, [])


def test_invalid_configuration_is_not_queried_again() -> None:
    cache = PoseCache()
    cache.add([batch(rig1=state())], 0.0)
    cache.configure("rig1", RigConfig(parameters_json="{}"))
    assert cache.unconfigured() == []


def test_new_incarnation_is_configured_again() -> None:
    cache = poses("rig1", "rig2")
    assert len(cache.scenes) == 1
    again = state()
    again.incarnation = 8
    cache.add([batch(rig1=again)], 0.1)
    assert cache.unconfigured() == ["rig1"]
    other = RigParameters(arm=ArmParameters(l2=0.4), scene=RIG.scene)
    cache.configure("rig1", config(other))
    cache.add([batch(rig1=again, rig2=state())], 0.2)
    assert [drawn[0] for drawn in cache.as_dict(0.2).values()] == [1, 0]


def test_parts_keep_their_last_position() -> None:
    cache = poses("rig1")
    moved = state(parts=[PartState(name="red", x=0.1, y=-0.2, z=0.0, yaw=math.pi / 2)])
    cache.add([batch(rig1=moved)], 0.1)
    cache.add([batch(rig1=state())], 0.2)
    assert cache.as_dict(0.2)["rig1"][2] == [[100, -200, 90]]


def test_newest_pose_and_newest_parts_are_used() -> None:
    cache = poses("rig1", "rig2")

    def placed(x: float) -> JointState:
        return state((0.0, 0.0, 0.0, 0.0), parts=[PartState(name="red", x=x, y=0.1, z=0.1, yaw=0.1)])

    straight, bent = state((0.0, 0.0, 0.0, 0.0)), state((math.pi / 2, 0.0, 0.0, 0.0))
    cache.add(
        [batch(rig1=placed(0.1)), batch(rig1=placed(0.2), rig2=bent), batch(rig1=bent), batch(rig2=straight)], 0.1
    )
    drawn = cache.as_dict(0.1)
    assert [drawn[rig][1][2:4] for rig in ("rig1", "rig2")] == [[0, 600], [600, 0]]
    assert drawn["rig1"][2] == [[200, 100, 6]]
    # Also after the length of a state with parts is known.
    cache.add([batch(rig1=placed(0.3)), batch(rig1=straight)], 0.2)
    assert cache.as_dict(0.2)["rig1"][2] == [[300, 100, 6]]


def test_silent_rig_expires_and_invalid_batch_is_ignored() -> None:
    cache = poses("rig1")
    cache.add([batch(rig1=state())], 1.0)
    cache.add([b"\xff\xff garbage"], 1.0)
    assert "rig1" in cache.as_dict(1.0 + SILENT_AFTER_S)
    assert cache.as_dict(1.1 + SILENT_AFTER_S) == {}


def test_events_are_numbered_and_old_ones_evicted() -> None:
    log = EventBuffer(1000)
    for number in range(MAX_EVENTS + 5):
        event = Event(rig="rig1", kind=Event.LIMIT_HIT, severity=Event.WARNING, text=f"{number}")
        log.add("hil/lab/rig1/event", event.SerializeToString())
    log.add("hil/lab/rig1/event", b"\xff no event")
    kept = log.entries()
    assert len(kept) == MAX_EVENTS
    assert [number for number, _ in kept] == list(range(1006, 1006 + MAX_EVENTS))
    last = json.loads(kept[-1][1])
    assert (last["id"], last["kind"], last["severity"]) == (1000 + MAX_EVENTS + 5, "limit_hit", "warning")


def test_unknown_event_kind_is_shown_as_number() -> None:
    log = EventBuffer(0)
    event = Event(text="x" * 10_000)
    event.kind = 99  # type: ignore[assignment]
    log.add("hil/lab/sim/event", event.SerializeToString())
    shown = json.loads(log.entries()[0][1])
    assert (shown["kind"], len(shown["text"])) == ("99", 500)


def test_browser_receives_updates_and_all_events() -> None:
    first = Frame("{1}", "{a}", ((5, "e5"),))
    text, state = first.updates(ClientState())
    assert text == "event: lab\ndata: {1}\n\nevent: event\nid: 5\ndata: e5\n\nevent: poses\ndata: {a}\n\n"
    assert first.updates(state) == ("", state)
    later = Frame("{3}", "{a}", ((5, "e5"), (6, "e6"), (7, "e7")))
    text, state = later.updates(state)
    assert text == "event: lab\ndata: {3}\n\nevent: event\nid: 6\ndata: e6\n\nevent: event\nid: 7\ndata: e7\n\n"
    assert state.event == 7
    returned, _ = later.updates(ClientState(event=6))
    assert "id: 6" not in returned
    assert "id: 7" in returned


def lab_model() -> ViewModel:
    model = ViewModel("lab", LabView(("rig1", "rig2")), 0)
    sim = [RigReport(rig="rig1", loop_us=[20_000, 30_000]), RigReport(rig="rig2", safe=True)]
    edge = [RigReport(rig="rig1", controller="192.0.2.7:9", session="s"), RigReport(rig="rig2")]
    model.view.update(Health(service="sim", instance="1", overruns=3, lateness_p99_ns=40_000, rig_reports=sim), 0.0)
    model.view.update(Health(service="edge", instance="1", rig_reports=edge), 0.0)
    recorder = [RigReport(rig="rig1", recording=True)]
    model.view.update(Health(service="recorder", instance="1", rig_reports=recorder), 0.0)
    model.set_addresses(
        [ServiceInfo(service="edge", instance="1", rigs=["rig1", "rig2"], addresses=["h:5020", "h:5021"])]
    )
    return model


def test_lab_message_has_state_of_each_rig() -> None:
    lab = json.loads(lab_model().frame(0.0, {"runs": 4}).lab)
    assert (lab["lab"], lab["bus_error"], lab["runs"], lab["scenes"]) == ("lab", "", 4, 0)
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


def test_lab_message_has_bus_error_without_lab() -> None:
    model = ViewModel("lab", LabView(("rig1",)), 0)
    model.bus_error = "no zenoh router answers"
    lab = json.loads(model.frame(0.0, {}).lab)
    assert (lab["services"], lab["bus_error"]) == ([], "no zenoh router answers")
    assert [rig["state"] for rig in lab["rigs"]] == ["no edge"]
    assert model.frame(0.0, {}).poses == "{}"


def test_lab_message_changes_once_per_second() -> None:
    model = lab_model()
    first = model.frame(0.0, {})
    assert model.frame(0.9, {}).lab is first.lab
    assert model.frame(1.0, {}).lab != first.lab


def test_lab_message_is_sent_without_changes() -> None:
    model, client = ViewModel("lab", LabView(()), 0), ClientState()
    for second in range(3):
        text, client = model.frame(float(second), {}).updates(client)
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
def test_rig_state_text(edge: RigReport | None, sim: RigReport | None, state: str) -> None:
    view = LabView(("r",))
    for service, report in (("edge", edge), ("sim", sim)):
        view.update(Health(service=service, instance="1", rig_reports=[] if report is None else [report]), 0.0)
    assert view.rigs(0.0)[0].state == state


def test_service_is_removed_after_timeout() -> None:
    view = LabView(())
    view.update(Health(service="edge", instance="old"), 0.0)
    view.update(Health(service="edge", instance="new"), REMOVED_AFTER_S)
    assert len(view.services()) == 2
    view.update(Health(service="edge", instance="new"), REMOVED_AFTER_S + 1)
    assert [service.name for service in view.services()] == ["edge/new"]
    assert [service.reports for service in view.services()] == [2]
