"""A device whose loop is impaired, in virtual time: stamps that add up, and a watchdog that nothing holds up."""

import json
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hilrig_modbus_edge.device.client import Client
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_schemas import Event, TorqueCommand
from support.device_bench import MS, Bench

KINDS = {
    "constant:12.5": None,
    "uniform:5,20": stats.uniform(5, 15),
    "normal:15,3": stats.truncnorm(-5, np.inf, 15, 3),
    "gamma:10,3": stats.gamma((10 / 3) ** 2, scale=9 / 10),
    "exponential:4,3": stats.expon(3, 4),
}


def impaired(**impairment: Any) -> Bench:
    """A device with a state, that is impaired so from its start."""
    bench = Bench(impairment=ImpairmentConfig.model_validate(impairment))
    bench.state(1)
    bench.device.begin()
    return bench


def let_pass(bench: Bench, ms: float) -> None:
    """Let time pass as the edge does: commands leave at their moments."""
    end_ns = bench.clock.monotonic_ns() + round(ms * MS)
    while bench.sends and min(bench.sends) <= end_ns:
        bench.clock.sleep_until_ns(min(bench.sends))
        bench.sends = [send for send in bench.sends if send > bench.clock.monotonic_ns()]
        bench.device.send_due(bench.clock.monotonic_ns())
    bench.clock.sleep_until_ns(end_ns)
    bench.device.check(end_ns)


def words_of(bench: Bench) -> list[TorqueCommand]:
    """Commands of controllers, the edge's own word left out."""
    return [command for command in bench.commands if command.controller]


def run_loop(bench: Bench, client: Client, steps: int, step_ms: float = 20.0) -> None:
    """A state a step, and a controller that reads a moment later and writes what it read as a torque."""
    for step in range(2, steps + 2):
        bench.state(step, position=(step * 1e-4, 0, 0, 0))
        let_pass(bench, 0.3)
        positions = bench.read(client, 4, 4)
        let_pass(bench, 0.2)
        bench.write(client, 0, positions[0] & 0x7FFF, 0, 0, 0)
        let_pass(bench, step_ms - 0.5)
    let_pass(bench, 1000)


def assert_stages_hold(command: TorqueCommand) -> None:
    """Each stage of docs/timing.md that the edge measures is no less than nothing."""
    assert command.state_served_ns - command.state_arrived_ns - command.state_injected_ns >= 0
    assert command.write_arrived_ns - command.state_served_ns >= 0
    assert command.sent_ns - command.write_arrived_ns - command.command_injected_ns >= 0


# -- injected is what was asked for


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", ["state", "command"])
def test_injected_is_distributed_as_asked(kind: str, way: str) -> None:
    """At a step of 100 ms nothing is overtaken, so what is measured is the whole distribution.

    A state is shown when its delay has passed; the controller here looks 99 ms after each, so that all have.
    """
    bench = impaired(**{way: kind}, seed=4)
    client = bench.connect()
    for step in range(2, 1002):
        bench.state(step)
        let_pass(bench, 99)
        bench.read(client, 4, 4)
        bench.write(client, 0, step & 0x7FFF, 0, 0, 0)
        let_pass(bench, 1)
    let_pass(bench, 100)
    commands = words_of(bench)
    for command in commands:
        assert_stages_hold(command)
    injected = np.array([getattr(command, f"{way}_injected_ns") for command in commands]) / 1e6
    other = "command" if way == "state" else "state"
    assert not any(getattr(command, f"{other}_injected_ns") for command in commands)
    assert len(injected) == 1000
    if KINDS[kind] is None:
        assert set(injected) == {12.5}
    else:
        found = stats.kstest(injected, KINDS[kind].cdf)
        assert found.pvalue > 0.01, found
        assert len(set(injected)) > 900


def test_a_trace_is_injected_in_its_order() -> None:
    trace = [3.0, 11.0, 5.5, 9.25, 1.0, 30.0, 2.0]
    bench = impaired(command={"delay": {"kind": "trace", "delays_ms": trace}})
    client = bench.connect()
    run_loop(bench, client, 21, step_ms=50)
    injected = [command.command_injected_ns / 1e6 for command in words_of(bench)]
    start = trace.index(injected[0])
    assert injected == [trace[(start + index) % len(trace)] for index in range(21)]


def test_a_command_leaves_at_the_end_of_its_delay_and_not_before() -> None:
    bench = impaired(command="constant:30")
    client = bench.connect()
    bench.write(client, 0, 1000)
    asked_ns = bench.clock.monotonic_ns()
    let_pass(bench, 29)
    assert not words_of(bench)
    let_pass(bench, 2)
    [command] = words_of(bench)
    assert (command.sent_ns, command.command_injected_ns) == (asked_ns + 30 * MS, 30 * MS)
    assert list(command.effort) == [1.0, 0.0, 0.0, 0.0]


def test_the_controller_reads_back_what_it_wrote_at_once() -> None:
    bench = impaired(command="constant:30")
    client = bench.connect()
    bench.write(client, 0, 1000)
    assert bench.read(client, 0, 1) == [1000]


def test_a_reader_is_shown_the_newest_state_that_has_arrived() -> None:
    bench = impaired(state="constant:45")
    client = bench.connect()
    for step in range(2, 8):
        bench.state(step, position=(step * 1e-2, 0, 0, 0))
        let_pass(bench, 20)
    # Step 7 came 20 ms ago, 6 40 ms, 5 60 ms.
    [first, *_] = bench.read(client, 4, 4)
    assert first == round(np.degrees(5e-2) * 100)
    bench.write(client, 0, 1)
    [command] = words_of(bench)
    assert command.basis_step == 5
    assert command.state_injected_ns == 45 * MS
    assert command.state_served_ns - command.state_arrived_ns == 60 * MS


@settings(max_examples=40)
@given(
    preset=st.sampled_from(["wired", "busy-wifi", "vpn", "mobile", "paper-25-100ms"]),
    seed=st.integers(0, 1000),
    step_ms=st.sampled_from([1.0, 5.0, 20.0]),
)
def test_whatever_happens_stages_hold_and_numbers_grow(preset: str, seed: int, step_ms: float) -> None:
    bench = impaired(preset=preset, seed=seed)
    client = bench.connect()
    run_loop(bench, client, 60, step_ms)
    numbers = [command.seq for command in bench.commands]
    assert numbers == sorted(set(numbers))
    for command in words_of(bench):
        assert_stages_hold(command)
    status = bench.device.impaired.status()
    assert status.commands == 60
    assert len(words_of(bench)) == status.commands - status.commands_lost - status.commands_superseded


def test_the_same_seed_gives_the_same_delays_in_each_session() -> None:
    def injected(bench: Bench, client: Client) -> list[tuple[int, int]]:
        before = len(words_of(bench))
        run_loop(bench, client, 30)
        return [(command.state_injected_ns, command.command_injected_ns) for command in words_of(bench)[before:]]

    bench = impaired(command="gamma:8,2", seed=11)
    first, second = bench.connect(host="10.0.0.1"), bench.connect(host="10.0.0.2", port=2)
    delays = injected(bench, first)
    bench.device.disconnect(first, "done")
    assert injected(bench, second) == delays
    assert bench.kinds().count("SESSION_START") == 2
    other = impaired(command="gamma:8,2", seed=12)
    assert injected(other, other.connect()) != delays


# -- safety


def test_the_watchdogs_zero_is_not_held_up_and_voids_what_is_on_its_way() -> None:
    bench = impaired(command="constant:1500")
    client = bench.connect()
    bench.write(client, 0, 1000)
    tripped_at_ns = bench.clock.monotonic_ns() + 1000 * MS
    let_pass(bench, 999)
    assert "WATCHDOG_TRIP" not in bench.kinds()
    let_pass(bench, 1)
    last = bench.commands[-1]
    assert (list(last.effort), last.safe, last.sent_ns) == ([0.0] * 4, True, tripped_at_ns)
    assert last.command_injected_ns == 0
    let_pass(bench, 3000)
    assert not words_of(bench), "the torque of a controller that is gone comes no more"
    assert bench.device.impaired.status().commands_superseded == 1


def test_a_controller_whose_words_are_all_lost_is_silent_to_the_watchdog() -> None:
    bench = impaired(command="constant:0")
    client = bench.connect()
    bench.write(client, 0, 1000)
    bench.device.impaired.set(ImpairmentConfig.model_validate({"command": {"loss": "bernoulli:1"}}))
    for _ in range(50):
        let_pass(bench, 20)
        bench.write(client, 0, 2000)
    assert bench.kinds().count("WATCHDOG_TRIP") == 1
    assert list(bench.commands[-1].effort) == [0.0] * 4
    assert [list(command.effort) for command in words_of(bench)] == [[1.0, 0.0, 0.0, 0.0]]


def test_what_is_repeated_is_what_the_simulation_was_told() -> None:
    bench = impaired(command="constant:500")
    client = bench.connect()
    bench.write(client, 0, 1000)
    let_pass(bench, 450)
    assert {tuple(repeat.effort) for repeat in bench.repeats} == {(0.0, 0.0, 0.0, 0.0)}
    let_pass(bench, 100)
    bench.repeats.clear()
    let_pass(bench, 300)
    assert {(tuple(repeat.effort), repeat.seq) for repeat in bench.repeats} == {
        ((1.0, 0.0, 0.0, 0.0), words_of(bench)[-1].seq)
    }


def test_a_trip_leaves_the_magnet_as_the_simulation_has_it() -> None:
    from hilrig_modbus_edge.registers import map as registers

    bench = impaired(command="constant:1500")
    client = bench.connect()
    client.heard(bench.clock.monotonic_ns())
    bench.device.write_coil(client, registers.MAGNET, True, bench.clock.monotonic_ns())
    bench.write(client, 0, 1000)
    let_pass(bench, 1000)
    assert bench.commands[-1].safe
    assert not bench.commands[-1].magnet, "it was asked for, but never arrived"


def test_the_teachers_reset_is_not_held_up() -> None:
    bench = impaired(command="constant:300")
    bench.write(bench.connect(), 0, 1000)
    bench.device.reset()
    assert (bench.commands[-1].resets, list(bench.commands[-1].effort)) == (1, [0.0] * 4)
    let_pass(bench, 400)
    assert not words_of(bench), "the torque of before comes no more"


def test_a_session_that_ends_does_not_bring_the_last_torque_early() -> None:
    bench = impaired(command="constant:300")
    first = bench.connect(host="10.0.0.1")
    bench.write(first, 0, 1000)
    let_pass(bench, 350)
    bench.write(first, 0, 5000)
    bench.device.disconnect(first, "gone")
    second = bench.connect(host="10.0.0.2", port=2)
    bench.write(second, 1, 7)
    own_words = [command for command in bench.commands if not command.controller]
    assert list(own_words[-1].effort) == [1.0, 0.0, 0.0, 0.0]
    let_pass(bench, 400)
    assert list(bench.commands[-1].effort) == [1.0, 0.007, 0.0, 0.0]


# -- changed while it runs


def test_every_change_is_told_with_what_is_set() -> None:
    bench = Bench()
    bench.device.begin()
    bench.state(1)
    bench.write(bench.connect(), 0, 1)
    assert "IMPAIRMENT_CHANGED" not in bench.kinds()
    bench.device.impaired.set(ImpairmentConfig.model_validate({"preset": "vpn", "seed": 5}))
    bench.device.impaired.set(ImpairmentConfig())
    texts = [event for event in bench.events if event.kind == Event.IMPAIRMENT_CHANGED]
    assert texts[0].text.startswith("impairment of rig1: state way gamma mean 3 ms")
    assert texts[0].text.endswith("seed 5 (by hand)")
    assert json.loads(texts[0].configuration_data.text)["command"]["delay"]["offset_ms"] == 15
    assert texts[0].session == bench.device.session.id
    assert texts[1].text == "impairment of rig1: none (by hand)"


def test_a_schedule_is_followed_and_told() -> None:
    schedule = [{"at_s": 0.2, "command": "constant:5"}, {"at_s": 0.4, "preset": "none"}]
    bench = impaired(schedule=schedule)
    client = bench.connect()
    for _ in range(30):
        bench.write(client, 0, 1)
        let_pass(bench, 20)
    injected = [command.command_injected_ns for command in words_of(bench)]
    assert injected == [0] * 10 + [5 * MS] * 10 + [0] * 10
    assert bench.kinds().count("IMPAIRMENT_CHANGED") == 2


def test_the_recording_of_an_impaired_session_says_so_from_its_start() -> None:
    bench = impaired(preset="wired")
    bench.write(bench.connect(), 0, 1)
    kinds = bench.kinds()
    assert kinds[kinds.index("SESSION_START") :].count("IMPAIRMENT_CHANGED") == 1
    told = [event for event in bench.events if event.kind == Event.IMPAIRMENT_CHANGED][-1]
    assert told.session == bench.device.session.id


def test_when_it_is_turned_off_what_is_on_its_way_arrives_and_the_newest_state_is_shown() -> None:
    bench = impaired(state="constant:200", command="constant:200")
    client = bench.connect()
    let_pass(bench, 250)
    bench.state(50, position=(0.5, 0, 0, 0))
    bench.write(client, 0, 1000)
    bench.clock.advance(3 * MS)
    bench.device.impaired.set(ImpairmentConfig())
    [command] = words_of(bench)
    assert (command.command_injected_ns, list(command.effort)) == (3 * MS, [1.0, 0, 0, 0])
    assert bench.read(client, 4, 1) == [round(np.degrees(0.5) * 100)]
    assert bench.arrive is None, "states are followed no more"
    bench.write(client, 0, 2000)
    assert bench.commands[-1].command_injected_ns == 0
    assert bench.commands[-1].sent_ns == bench.clock.monotonic_ns()


def test_states_that_nobody_reads_do_not_pile_up() -> None:
    bench = impaired(state="constant:100")
    assert bench.arrive is not None
    for step in range(2, 500):
        bench.state(step)
        let_pass(bench, 20)
    line = bench.device.impaired._state_way.line  # type: ignore[union-attr]
    assert line.count == 498
    assert len(line._waiting) <= 6


def test_words_without_a_torque_are_not_held_up() -> None:
    """The echo word and the time-out are the edge's own registers: they hold at once."""
    from hilrig_modbus_edge.registers import map as registers

    bench = impaired(command="constant:100")
    client = bench.connect()
    client.heard(bench.clock.monotonic_ns())
    bench.device.write_registers(client, registers.ECHO, struct.pack(">HH", 7, 2000), bench.clock.monotonic_ns())
    assert bench.device.watchdog.timeout_ns == 2000 * MS
