"""Unit tests of adding and removing rigs at run time: the motion of the other rigs stays bit-identical."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np

from hilrig_cli.client import send_control_request
from hilrig_runtime.config.lab import LabConfig, RigSettings, parse_lab
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_schemas import AddRig, ControlRequest, RemoveRig, RigConfig, ServiceInfo, StartSession, topics
from hilrig_sim.arm.model import PLANT_VERSION
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.plant import Plant
from hilrig_sim.rig_registry import RigRegistry
from support.foreign_requests import OWN, assert_refuses_foreign_requests
from support.virtual_rig import VirtualRig

LAB = parse_lab("[rigs]\ncount = 3\n")
GUEST = RigSettings(name="guest")


def motion(change: Callable[[VirtualRig], None] | None = None, rig: str = "rig3") -> list[bytes]:
    """Return the states of a rig for 60 steps under a torque; `change` is applied at step 20."""
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


def test_added_rig_does_not_change_the_others() -> None:
    assert motion() == motion(lambda lab: lab.simulation.add("guest", grown(lab)))


def test_removed_rig_does_not_change_the_others() -> None:
    assert motion() == motion(lambda lab: lab.simulation.remove(0, without(lab, 0)))


def test_held_commands_stay_with_their_rigs_after_removal() -> None:
    def moved(lab: VirtualRig, *, remove: bool) -> dict[str, list[float]]:
        for number, name in enumerate(("rig1", "rig2", "rig3"), start=1):
            lab.command((0.5 * number, -0.2 * number, -4.9, 0.01), magnet=number == 2, rig=name)
        lab.tick(2)
        if remove:
            lab.simulation.remove(0, without(lab, 0))
        # No further commands: the held ones stay applied.
        assert lab.simulation._magnet.tolist() == ([True, False] if remove else [False, True, False])
        lab.tick(15)
        return {state.rig: list(state.position) for state in lab.states[-2:]}

    with VirtualRig(LAB) as all_three, VirtualRig(LAB) as two:
        assert moved(all_three, remove=False) == moved(two, remove=True)


def test_added_rig_moves_and_is_recorded() -> None:
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


def test_copied_state_includes_falling_and_held_parts() -> None:
    lab = LabConfig()
    parameters = [rig_parameters(lab, lab.rigs[0])] * 2
    before, after = Plant(parameters), Plant(parameters)
    effort, on = np.zeros((4, 2)), np.array([True, False])
    effort[2] = 6.0
    for step in range(120):
        before.step(effort, on if step % 60 < 50 else ~on)
    after.copy_state_from(before, [0, 1], [0, 1])
    for _ in range(40):
        before.step(effort, on)
        after.step(effort, on)
    for name in ("position", "velocity"):
        assert np.array_equal(getattr(before, name), getattr(after, name))
    for name in ("x", "y", "z", "yaw", "held"):
        assert np.array_equal(getattr(before.world, name), getattr(after.world, name))


class RegistryRig(VirtualRig):
    """A simulation with a rig registry on the bus, whose executor runs calls at once."""

    def __init__(self) -> None:
        super().__init__(LAB)
        self.registry = RigRegistry(self.service, self.simulation, OwnerThreadExecutor(lambda run: run()))

    def ask(self, **request: Any) -> str:
        info = ServiceInfo(service="sim", instance="1", software_version=OWN)
        try:
            return send_control_request(self.service.bus, LAB, info, ControlRequest(**request)).text
        except OperationError as error:
            return str(error).partition(" refused: ")[2]


def test_start_event_has_the_step_parameters() -> None:
    with RegistryRig() as lab:
        assert lab.kinds() == ["CONFIGURATION"] * 3
        assert [event.rig for event in lab.events] == ["rig1", "rig2", "rig3"]
        assert lab.events[0].text == "simulation started: step 20 ms, rkf45, automatic sub-steps"
        parameters = json.loads(lab.events[0].configuration_data.text)
        assert parameters == {
            "step_ns": 20_000_000,
            "substeps": "auto",
            "integrator": "rkf45",
            "plant_version": PLANT_VERSION,
        }


def test_rig_is_added_described_and_removed_by_query() -> None:
    with RegistryRig() as lab:
        assert lab.ask(add_rig=AddRig(settings_json=GUEST.model_dump_json())) == "guest is simulated"
        (answer,) = lab.service.bus.query(topics.CONFIG.key(LAB.name, "guest"))
        assert RigConfig.FromString(answer.payload).rig == "guest"
        assert [rig.name for rig in lab.service.rigs] == ["rig1", "rig2", "rig3", "guest"]
        assert lab.ask(remove_rig=RemoveRig(rig="guest")) == "guest is no longer simulated"
        assert lab.service.bus.query(topics.CONFIG.key(LAB.name, "guest")) == []
        assert lab.kinds()[-2:] == ["RIG_ADDED", "RIG_REMOVED"]


def test_invalid_requests_are_rejected_without_effect() -> None:
    with RegistryRig() as lab:
        assert (
            lab.ask(add_rig=AddRig(settings_json=RigSettings(name="rig1").model_dump_json()))
            == "rig 'rig1' is already simulated here; choose another name"
        )
        assert "must be > 0" in lab.ask(add_rig=AddRig(settings_json='{"name": "x", "arm": {"l2_m": -1}}'))
        assert (
            lab.ask(remove_rig=RemoveRig(rig="nobody"))
            == "rig 'nobody' is not simulated here; hilrig rig list shows all rigs"
        )
        assert "does not execute start_session" in lab.ask(start_session=StartSession(rig="rig1"))
        assert lab.ask(remove_rig=RemoveRig(rig="rig1")).endswith("no longer simulated")
        lab.ask(remove_rig=RemoveRig(rig="rig2"))
        assert "the only rig" in lab.ask(remove_rig=RemoveRig(rig="rig3"))
        lab.tick()
        assert lab.states[-1].rig == "rig3"


def test_requests_of_other_versions_are_refused() -> None:
    with RegistryRig() as lab:
        assert_refuses_foreign_requests(lab.service.bus, LAB.name, ServiceInfo(service="sim", instance="1"))
        assert [rig.name for rig in lab.service.rigs] == ["rig1", "rig2", "rig3"]


def test_nan_in_one_rig_does_not_change_the_others() -> None:
    def break_first(lab: VirtualRig) -> None:
        lab.simulation._plant.velocity[:, 0] = np.nan

    with np.errstate(all="ignore"):
        assert motion() == motion(break_first)


def test_malformed_command_does_not_change_other_rigs() -> None:
    def send_malformed(lab: VirtualRig) -> None:
        lab.send(b"\xff\x00rubbish", "rig1")

    assert motion() == motion(send_malformed)
