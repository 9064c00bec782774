"""Rigs are added and taken away while others run, and the others' motion is the same to the last bit."""

import json
from collections.abc import Callable

import numpy as np
import pytest

from hilrig_runtime.config.lab import LabConfig, RigSettings, parse_lab
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_schemas import Event, RigConfig, topics
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.plant import Plant
from hilrig_sim.rig_registry import Membership
from support.virtual_rig import VirtualRig

LAB = parse_lab("[rigs]\ncount = 3\n")
GUEST = RigSettings(name="guest")


def motion(change: Callable[[VirtualRig], None] | None = None, rig: str = "rig3") -> list[bytes]:
    """What a rig does for 60 steps under a torque, where something happens to the others at the 20th."""
    with VirtualRig(LAB) as lab:
        for step in range(60):
            if step == 20 and change is not None:
                change(lab)
            lab.command((0.7, -0.3, 1.0, 0.02), magnet=step % 40 > 10, rig=rig)
            lab.tick()
        mine = [state for state in lab.states if state.rig == rig]
        assert [state.step for state in mine] == list(range(1, 61))
        for state in mine:
            state.ClearField("incarnation")
        return [state.SerializeToString() for state in mine]


def grown(lab: VirtualRig) -> Plant:
    return Plant([*lab.simulation.parameters, rig_parameters(lab.lab, GUEST)])


def without(lab: VirtualRig, index: int) -> Plant:
    return Plant([one for number, one in enumerate(lab.simulation.parameters) if number != index])


def test_others_do_not_feel_a_rig_that_is_added() -> None:
    assert motion() == motion(lambda lab: lab.simulation.add("guest", grown(lab)))


def test_others_do_not_feel_a_rig_that_is_taken_away() -> None:
    assert motion() == motion(lambda lab: lab.simulation.remove(0, without(lab, 0)))


def test_torques_and_magnets_that_stand_stay_with_their_rigs_when_one_before_them_is_taken_away() -> None:
    def moved(lab: VirtualRig, *, remove: bool) -> dict[str, list[float]]:
        for number, name in enumerate(("rig1", "rig2", "rig3"), start=1):
            lab.command((0.5 * number, -0.2 * number, -4.9, 0.01), magnet=number == 2, rig=name)
        lab.tick(2)
        if remove:
            lab.simulation.remove(0, without(lab, 0))
        # Nothing is sent any more: what stands acts.
        assert lab.simulation._magnet.tolist() == ([True, False] if remove else [False, True, False])
        lab.tick(15)
        return {state.rig: list(state.position) for state in lab.states[-2:]}

    with VirtualRig(LAB) as all_three, VirtualRig(LAB) as two:
        assert moved(all_three, remove=False) == moved(two, remove=True)


def test_a_rig_that_was_added_moves_and_is_recorded() -> None:
    with VirtualRig(LAB) as lab:
        lab.tick(5)
        lab.simulation.add("guest", grown(lab))
        for _ in range(20):
            lab.command((0.7, 0.0, 0.0, 0.0), rig="guest")
            lab.tick()
        mine = [state for state in lab.states if state.rig == "guest"]
        assert len(mine) == 20
        assert mine[-1].position[0] > 0.01
        assert [key for key, *_ in lab.service.recording_stream._entries].count(
            topics.STATE.key(lab.lab.name, "guest")
        ) == 20


def test_parts_in_the_air_and_on_magnets_go_on() -> None:
    lab = LabConfig()
    parameters = [rig_parameters(lab, lab.rigs[0])] * 2
    before, after = Plant(parameters), Plant(parameters)
    effort, on = np.zeros((4, 2)), np.array([True, False])
    effort[2] = 6.0
    for step in range(120):
        before.step(effort, on if step % 60 < 50 else ~on)
    after.adopt(before, [0, 1], [0, 1])
    for _ in range(40):
        before.step(effort, on)
        after.step(effort, on)
    for name in ("position", "velocity"):
        assert np.array_equal(getattr(before, name), getattr(after, name))
    for name in ("x", "y", "z", "yaw", "held"):
        assert np.array_equal(getattr(before.world, name), getattr(after.world, name))


class Served(VirtualRig):
    """A simulation whose rigs can be changed over the bus; its turns are run at once."""

    def __init__(self) -> None:
        super().__init__(LAB)
        turns = OwnerThreadExecutor()
        turns.call = lambda work: work()  # type: ignore[method-assign]
        self.membership = Membership(self.service, self.simulation, turns)

    def ask(self, kind: Event.Kind, rig: str, settings: str = "") -> str:
        request = Event(kind=kind, rig=rig)
        request.configuration_data.text = settings
        (answer,) = self.service.bus.query(topics.CONTROL.key(LAB.name, "sim", "1"), request.SerializeToString())
        return answer.error or Event.FromString(answer.payload).text


def test_a_simulation_says_how_it_steps_when_it_begins() -> None:
    with Served() as lab:
        assert lab.kinds() == ["CONFIGURATION"] * 3
        assert [event.rig for event in lab.events] == ["rig1", "rig2", "rig3"]
        assert lab.events[0].text == "simulated from now on: step 20 ms, rkf45"
        said = json.loads(lab.events[0].configuration_data.text)
        assert said == {"step_ns": 20_000_000, "substeps": 1, "integrator": "rkf45"}


def test_over_the_bus_a_rig_is_added_described_and_taken_away() -> None:
    with Served() as lab:
        assert lab.ask(Event.RIG_ADDED, "guest", GUEST.model_dump_json()) == "guest is simulated"
        (answer,) = lab.service.bus.query(topics.CONFIG.key(LAB.name, "guest"))
        assert RigConfig.FromString(answer.payload).rig == "guest"
        assert [rig.name for rig in lab.service.rigs] == ["rig1", "rig2", "rig3", "guest"]
        assert lab.ask(Event.RIG_REMOVED, "guest") == "guest is simulated no more"
        assert lab.service.bus.query(topics.CONFIG.key(LAB.name, "guest")) == []
        assert lab.kinds()[-2:] == ["RIG_ADDED", "RIG_REMOVED"]


def test_what_can_not_be_done_is_refused_and_changes_nothing() -> None:
    with Served() as lab:
        assert (
            lab.ask(Event.RIG_ADDED, "rig1", RigSettings(name="rig1").model_dump_json())
            == "'rig1' is simulated already"
        )
        assert "expected greater than 0" in lab.ask(Event.RIG_ADDED, "x", '{"name": "x", "arm": {"l2_m": -1}}')
        assert lab.ask(Event.RIG_REMOVED, "nobody") == "'nobody' is not simulated here"
        assert "does not know" in lab.ask(Event.SESSION_START, "rig1")
        assert lab.ask(Event.RIG_REMOVED, "rig1").endswith("no more")
        lab.ask(Event.RIG_REMOVED, "rig2")
        assert "the only rig" in lab.ask(Event.RIG_REMOVED, "rig3")
        lab.tick()
        assert lab.states[-1].rig == "rig3"


def test_a_service_that_does_not_come_to_it_says_so_and_does_not_do_it_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hilrig_runtime.process.mailbox.TIMEOUT_S", 0.01)
    turns, done = OwnerThreadExecutor(), []
    with pytest.raises(OperationError, match="too busy"):
        turns.call(lambda: done.append(1))
    turns.run_pending()
    assert done == []


def test_a_broken_number_in_one_rig_stays_in_it() -> None:
    def break_first(lab: VirtualRig) -> None:
        lab.simulation._plant.velocity[:, 0] = np.nan

    with np.errstate(all="ignore"):
        assert motion() == motion(break_first)


def test_a_malformed_command_for_one_rig_does_not_touch_another() -> None:
    def send_rubbish(lab: VirtualRig) -> None:
        lab.send(b"\xff\x00rubbish", "rig1")

    assert motion() == motion(send_rubbish)
