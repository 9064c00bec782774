"""Unit tests of the state encoder: valid protobuf, independent of the arrival time of the commands."""

import struct
from functools import partial

import numpy as np
import pytest

from hilrig_runtime.config.lab import parse_lab
from hilrig_schemas import Event, JointState
from hilrig_sim.loop import PRE_ENCODE_MIN_RIGS
from hilrig_sim.plant.plant import Plant
from hilrig_sim.state_encoder import encode_loop_latency, encode_motion
from support.virtual_rig import VirtualRig

LAB = parse_lab(f"[rigs]\ncount = {PRE_ENCODE_MIN_RIGS}\n")


def test_encoded_motion_equals_protobuf_encoding() -> None:
    with VirtualRig(parse_lab("[rigs]\ncount = 3\n")) as lab:
        plant = Plant(lab.parameters)
    random = np.random.default_rng(3)
    for values in (plant.position, plant.velocity, plant.error):
        values[:] = random.normal(size=values.shape)
    plant.position[0, 1], plant.velocity[:, 2] = -0.0, 0.0
    for rig, encoded in enumerate(encode_motion(plant)):
        state = JointState.FromString(encoded)
        assert state.SerializeToString() == encoded
        for found, expected in (
            (state.position, plant.position),
            (state.velocity, plant.velocity),
            (state.integration_error, plant.error),
        ):
            assert struct.pack("<4d", *found) == struct.pack("<4d", *expected[:, rig])


@pytest.mark.parametrize("latency_ns", [0, 1, 20_000_000, 2**62])
def test_loop_latency_is_encoded(latency_ns: int) -> None:
    assert JointState.FromString(encode_loop_latency(latency_ns)).loop_latency_ns == latency_ns


def simulate(at_ms: float) -> tuple[list[JointState], list[Event]]:
    """Command, hold, reset and release two of many rigs, `at_ms` before each tick."""
    with VirtualRig(LAB) as lab:
        sleep_until, sent = lab.clock.sleep_until_ns, [False]
        tick_ns = [0]

        def until(commands: object, deadline_ns: int) -> None:
            # The commands arrive while the simulation waits for the deadline.
            arrival_ns = tick_ns[0] - round(at_ms * 1e6)
            if not sent[0] and deadline_ns >= arrival_ns:
                sleep_until(arrival_ns)
                sent[0] = True
                commands()  # type: ignore[operator]
            sleep_until(deadline_ns)

        for step in range(70):

            def commands(step: int = step) -> None:
                for rig, turn in (("rig1", 0), ("rig7", 1)):
                    if step < 30 and (step + turn) % 3:
                        options = {"basis_step": max(0, step - turn), "resets": int(step > 20), "magnet": step > 5}
                        lab.command((3.0, -1.0, -5.0, 0.1 * step), rig=rig, **options)  # type: ignore[arg-type]

            lab.clock.sleep_until_ns = partial(until, commands)  # type: ignore[method-assign]
            tick_ns[0], sent[0] = lab._rate.next_ns, False
            lab.tick()
        return lab.states, lab.events


@pytest.mark.parametrize("at_ms", [1.0, 0.1])
def test_states_do_not_depend_on_command_arrival_time(at_ms: float) -> None:
    early, late = simulate(5.0), simulate(at_ms)
    # Only arrival time and incarnation differ.
    fields = {field.name for field in JointState.DESCRIPTOR.fields} - {"command_arrived_ns", "incarnation"}
    for one, other in zip(early[0], late[0], strict=True):
        for name in fields:
            assert getattr(one, name) == getattr(other, name), (one.step, one.rig, name)
        assert bool(one.command_arrived_ns) == bool(other.command_arrived_ns)
    assert [event.kind for event in early[1]] == [event.kind for event in late[1]]
    assert {Event.RESET, Event.COMMAND_LOST} <= {event.kind for event in early[1]}
    assert any(state.loop_latency_ns for state in early[0])


def test_parts_are_published_on_time_after_a_late_command() -> None:
    lab = parse_lab(f"[rigs]\ncount = {PRE_ENCODE_MIN_RIGS}\n[[scene.parts]]\nname = 'red'\nposition_mm = [300, 0]\n")
    with VirtualRig(lab) as rig:
        for _ in range(120):
            rig.simulation.pre_encode(rig._rate.next_ns)
            rig.command((0.1, 0.0, 0.0, 0.0))
            rig.simulation.tick(rig._rate.wait())
        steps = [state.step for state in rig.states if state.rig == "rig1" and state.parts]
        others = [state.step for state in rig.states if state.rig == "rig2" and state.parts]
    assert steps == others
    assert len(steps) >= 3


def test_command_that_expires_before_a_late_tick_does_not_act() -> None:
    with VirtualRig(LAB) as rig:
        rig.command((3.0, 0.0, 0.0, 0.0))
        rig.tick(2)
        assert rig.states[-PRE_ENCODE_MIN_RIGS].effort[0] == 3.0
        rig.simulation.pre_encode(rig._rate.next_ns)
        rig.clock.advance(LAB.sim.command_timeout_ns)
        rig.simulation.tick(rig._rate.wait())
        (state,) = [state for state in rig.states[-PRE_ENCODE_MIN_RIGS:] if state.rig == "rig1"]
        assert (list(state.effort), state.safe) == ([0.0] * 4, True)
        assert state.missed_steps or state.lateness_ns > LAB.sim.step_ns
