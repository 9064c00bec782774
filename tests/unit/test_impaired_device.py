"""Unit tests of a device with network impairment, in simulated time: timestamps, delays, losses and safety."""

import json
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.watchdog import WatchdogState
from hilrig_modbus_edge.registers.map import ECHO_ADDRESS, MAGNET_COIL
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
    """Return a device with a state and this impairment from its start."""
    bench = Bench(impairment=ImpairmentConfig.model_validate(impairment))
    bench.state(1)
    bench.device.start()
    return bench


def client_commands(bench: Bench) -> list[TorqueCommand]:
    """Return the commands of clients, without internal commands."""
    return [command for command in bench.commands if command.controller]


def run_loop(bench: Bench, client: Client, steps: int, step_ms: float = 20.0) -> None:
    """Publish one state per step; the client reads it a moment later and writes it as a torque."""
    for step in range(2, steps + 2):
        bench.state(step, position=(step * 1e-4, 0, 0, 0))
        bench.advance(0.3)
        positions = bench.read(client, 4, 4)
        bench.advance(0.2)
        bench.write(client, 0, positions[0] & 0x7FFF, 0, 0, 0)
        bench.advance(step_ms - 0.5)
    bench.advance(1000)


def assert_stages_not_negative(command: TorqueCommand) -> None:
    """Check that each latency stage of docs/timing.md that the edge measures is not negative."""
    assert command.state_served_ns - command.state_arrived_ns - command.state_injected_ns >= 0
    assert command.write_arrived_ns - command.state_served_ns >= 0
    assert command.sent_ns - command.write_arrived_ns - command.command_injected_ns >= 0


# -- distribution of the injected delay


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("link", ["state", "command"])
def test_injected_delay_has_configured_distribution(kind: str, link: str) -> None:
    """At a step of 100 ms no message is superseded, so the measured distribution is complete.

    A state is served when its delay has passed; the client reads 99 ms after each state, later than any delay.
    """
    bench = impaired(**{link: kind}, seed=4)
    client = bench.connect()
    for step in range(2, 1002):
        bench.state(step)
        bench.advance(99)
        bench.read(client, 4, 4)
        bench.write(client, 0, step & 0x7FFF, 0, 0, 0)
        bench.advance(1)
    bench.advance(100)
    commands = client_commands(bench)
    for command in commands:
        assert_stages_not_negative(command)
    injected = np.array([getattr(command, f"{link}_injected_ns") for command in commands]) / 1e6
    other = "command" if link == "state" else "state"
    assert not any(getattr(command, f"{other}_injected_ns") for command in commands)
    assert len(injected) == 1000
    distribution = KINDS[kind]
    if distribution is None:
        assert set(injected) == {12.5}
    else:
        found = stats.kstest(injected, distribution.cdf)
        assert found.pvalue > 0.01, found
        assert len(set(injected)) > 900


def test_trace_is_injected_in_its_order() -> None:
    trace = [3.0, 11.0, 5.5, 9.25, 1.0, 30.0, 2.0]
    bench = impaired(command={"delay": {"kind": "trace", "delays_ms": trace}})
    client = bench.connect()
    run_loop(bench, client, 21, step_ms=50)
    injected = [command.command_injected_ns / 1e6 for command in client_commands(bench)]
    start = trace.index(injected[0])
    assert injected == [trace[(start + index) % len(trace)] for index in range(21)]


def test_command_is_sent_exactly_after_its_delay() -> None:
    bench = impaired(command="constant:30")
    client = bench.connect()
    bench.write(client, 0, 1000)
    written_ns = bench.clock.monotonic_ns()
    bench.advance(29)
    assert not client_commands(bench)
    bench.advance(2)
    [command] = client_commands(bench)
    assert (command.sent_ns, command.command_injected_ns) == (written_ns + 30 * MS, 30 * MS)
    assert list(command.effort) == [1.0, 0.0, 0.0, 0.0]


def test_client_reads_back_its_delayed_write_at_once() -> None:
    bench = impaired(command="constant:30")
    client = bench.connect()
    bench.write(client, 0, 1000)
    assert bench.read(client, 0, 1) == [1000]


def test_reader_is_served_the_newest_delivered_state() -> None:
    bench = impaired(state="constant:45")
    client = bench.connect()
    for step in range(2, 8):
        bench.state(step, position=(step * 1e-2, 0, 0, 0))
        bench.advance(20)
    # Step 7 arrived 20 ms ago, step 6 40 ms ago, step 5 60 ms ago.
    [first, *_] = bench.read(client, 4, 4)
    assert first == round(np.degrees(5e-2) * 100)
    bench.write(client, 0, 1)
    [command] = client_commands(bench)
    assert command.basis_step == 5
    assert command.state_injected_ns == 45 * MS
    assert command.state_served_ns - command.state_arrived_ns == 60 * MS


@settings(max_examples=40)
@given(
    preset=st.sampled_from(["wired", "busy-wifi", "vpn", "mobile", "paper-25-100ms"]),
    seed=st.integers(0, 1000),
    step_ms=st.sampled_from([1.0, 5.0, 20.0]),
)
def test_stages_not_negative_and_numbers_increase(preset: str, seed: int, step_ms: float) -> None:
    bench = impaired(preset=preset, seed=seed)
    client = bench.connect()
    run_loop(bench, client, 60, step_ms)
    numbers = [command.seq for command in bench.commands]
    assert numbers == sorted(set(numbers))
    for command in client_commands(bench):
        assert_stages_not_negative(command)
    status = bench.device.impairment.status()
    assert status.commands == 60
    assert len(client_commands(bench)) == status.commands - status.commands_lost - status.commands_superseded


def test_same_seed_gives_same_delays_in_each_session() -> None:
    def injected(bench: Bench, client: Client) -> list[tuple[int, int]]:
        before = len(client_commands(bench))
        run_loop(bench, client, 30)
        return [(command.state_injected_ns, command.command_injected_ns) for command in client_commands(bench)[before:]]

    bench = impaired(command="gamma:8,2", seed=11)
    first, second = bench.connect(host="10.0.0.1"), bench.connect(host="10.0.0.2", port=2)
    delays = injected(bench, first)
    bench.device.disconnect(first, "done")
    assert injected(bench, second) == delays
    assert bench.kinds().count("SESSION_START") == 2
    other = impaired(command="gamma:8,2", seed=12)
    assert injected(other, other.connect()) != delays


# -- safety


def test_watchdog_zero_is_not_delayed_and_drops_commands() -> None:
    bench = impaired(command="constant:1500")
    client = bench.connect()
    bench.write(client, 0, 1000)
    tripped_at_ns = bench.clock.monotonic_ns() + 1000 * MS
    bench.advance(999)
    assert "WATCHDOG_TRIP" not in bench.kinds()
    bench.advance(1)
    last = bench.commands[-1]
    assert (list(last.effort), last.safe, last.sent_ns) == ([0.0] * 4, True, tripped_at_ns)
    assert last.command_injected_ns == 0
    bench.advance(3000)
    assert not client_commands(bench), "the delayed torque must not be sent after the trip"
    assert bench.device.impairment.status().commands_superseded == 1


def test_watchdog_trips_when_all_commands_are_lost() -> None:
    bench = impaired(command="constant:0")
    client = bench.connect()
    bench.write(client, 0, 1000)
    bench.device.impairment.set(ImpairmentConfig.model_validate({"command": {"loss": "bernoulli:1"}}))
    for _ in range(50):
        bench.advance(20)
        bench.write(client, 0, 2000)
    assert bench.kinds().count("WATCHDOG_TRIP") == 1
    assert list(bench.commands[-1].effort) == [0.0] * 4
    assert [list(command.effort) for command in client_commands(bench)] == [[1.0, 0.0, 0.0, 0.0]]


def test_dropped_write_does_not_arm_or_rearm_watchdog() -> None:
    bench = impaired(command={"loss": "bernoulli:1"})
    client = bench.connect()
    bench.write(client, 0, 1000)
    assert bench.device.watchdog.state is WatchdogState.WAITING
    bench.advance(2000)
    assert "WATCHDOG_TRIP" not in bench.kinds()
    bench.device.impairment.set(ImpairmentConfig())
    bench.write(client, 0, 1000)
    bench.advance(1000)
    assert bench.kinds().count("WATCHDOG_TRIP") == 1
    bench.device.impairment.set(ImpairmentConfig.model_validate({"command": {"loss": "bernoulli:1"}}))
    bench.write(client, 0, 1000)
    bench.device.write_coil(client, MAGNET_COIL, True, bench.clock.monotonic_ns())
    assert bench.device.watchdog.state is WatchdogState.TRIPPED
    assert "WATCHDOG_REARM" not in bench.kinds()


def test_repeated_command_is_the_last_published_one() -> None:
    bench = impaired(command="constant:500")
    client = bench.connect()
    bench.write(client, 0, 1000)
    bench.advance(450)
    assert {tuple(repeat.effort) for repeat in bench.repeats} == {(0.0, 0.0, 0.0, 0.0)}
    bench.advance(100)
    bench.repeats.clear()
    bench.advance(300)
    assert {(tuple(repeat.effort), repeat.seq) for repeat in bench.repeats} == {
        ((1.0, 0.0, 0.0, 0.0), client_commands(bench)[-1].seq)
    }


def test_trip_keeps_the_published_magnet_command() -> None:
    bench = impaired(command="constant:1500")
    client = bench.connect()
    client.record_request(bench.clock.monotonic_ns())
    bench.device.write_coil(client, MAGNET_COIL, True, bench.clock.monotonic_ns())
    bench.write(client, 0, 1000)
    bench.advance(1000)
    assert bench.commands[-1].safe
    assert not bench.commands[-1].magnet, "it was written, but never published"


def test_operator_reset_is_not_delayed() -> None:
    bench = impaired(command="constant:300")
    bench.write(bench.connect(), 0, 1000)
    bench.device.reset()
    assert (bench.commands[-1].resets, list(bench.commands[-1].effort)) == (1, [0.0] * 4)
    bench.advance(400)
    assert not client_commands(bench), "the earlier torque must not be sent after the reset"


def test_session_end_does_not_send_delayed_torque_early() -> None:
    bench = impaired(command="constant:300")
    first = bench.connect(host="10.0.0.1")
    bench.write(first, 0, 1000)
    bench.advance(350)
    bench.write(first, 0, 5000)
    bench.device.disconnect(first, "gone")
    second = bench.connect(host="10.0.0.2", port=2)
    bench.write(second, 1, 7)
    internal = [command for command in bench.commands if not command.controller]
    assert list(internal[-1].effort) == [1.0, 0.0, 0.0, 0.0]
    bench.advance(400)
    assert list(bench.commands[-1].effort) == [1.0, 0.007, 0.0, 0.0]


# -- changes at run time


def test_every_change_is_reported_with_its_setting() -> None:
    bench = Bench()
    bench.device.start()
    bench.state(1)
    bench.write(bench.connect(), 0, 1)
    assert "IMPAIRMENT_CHANGED" not in bench.kinds()
    bench.device.impairment.set(ImpairmentConfig.model_validate({"preset": "vpn", "seed": 5}))
    bench.device.impairment.set(ImpairmentConfig())
    texts = [event for event in bench.events if event.kind == Event.IMPAIRMENT_CHANGED]
    assert texts[0].text.startswith("impairment of rig1: state link gamma mean 3 ms")
    assert texts[0].text.endswith("seed 5 (source: override)")
    assert json.loads(texts[0].configuration_data.text)["command"]["delay"]["offset_ms"] == 15
    assert texts[0].session == bench.session.id
    assert texts[1].text == "impairment of rig1: none (source: override)"


def test_schedule_is_followed_and_reported() -> None:
    schedule = [{"at_s": 0.2, "command": "constant:5"}, {"at_s": 0.4, "preset": "none"}]
    bench = impaired(schedule=schedule)
    client = bench.connect()
    for _ in range(30):
        bench.write(client, 0, 1)
        bench.advance(20)
    injected = [command.command_injected_ns for command in client_commands(bench)]
    assert injected == [0] * 10 + [5 * MS] * 10 + [0] * 10
    assert bench.kinds().count("IMPAIRMENT_CHANGED") == 2


def test_impaired_session_starts_with_impairment_event() -> None:
    bench = impaired(preset="wired")
    bench.write(bench.connect(), 0, 1)
    kinds = bench.kinds()
    assert kinds[kinds.index("SESSION_START") :].count("IMPAIRMENT_CHANGED") == 1
    change = [event for event in bench.events if event.kind == Event.IMPAIRMENT_CHANGED][-1]
    assert change.session == bench.session.id


def test_removed_impairment_delivers_messages_in_flight() -> None:
    bench = impaired(state="constant:200", command="constant:200")
    client = bench.connect()
    bench.advance(250)
    bench.state(50, position=(0.5, 0, 0, 0))
    bench.write(client, 0, 1000)
    bench.clock.advance(3 * MS)
    bench.device.impairment.set(ImpairmentConfig())
    [command] = client_commands(bench)
    assert (command.command_injected_ns, list(command.effort)) == (3 * MS, [1.0, 0, 0, 0])
    assert bench.read(client, 4, 1) == [round(np.degrees(0.5) * 100)]
    assert bench.arrive is None, "states must not be subscribed any more"
    bench.write(client, 0, 2000)
    assert bench.commands[-1].command_injected_ns == 0
    assert bench.commands[-1].sent_ns == bench.clock.monotonic_ns()


def test_states_without_reader_do_not_accumulate() -> None:
    bench = impaired(state="constant:100")
    assert bench.arrive is not None
    for step in range(2, 500):
        bench.state(step)
        bench.advance(20)
    line = bench.device._states.delayed.line  # type: ignore[union-attr]
    assert line.count == 498
    assert len(line._in_flight) <= 6


def test_writes_of_edge_registers_are_not_delayed() -> None:
    """Echo value and watchdog timeout are registers of the edge: they are set at once."""
    bench = impaired(command="constant:100")
    client = bench.connect()
    client.record_request(bench.clock.monotonic_ns())
    bench.device.write_registers(client, ECHO_ADDRESS, struct.pack(">HH", 7, 2000), bench.clock.monotonic_ns())
    assert bench.device.watchdog.timeout_ns == 2000 * MS
