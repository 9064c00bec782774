"""Unit tests of the command latch: new commands, repetition, timeout, resets, late commands."""

import math
from typing import Any

import pytest

from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import TorqueCommand
from hilrig_sim.arm.model import LARGEST_EFFORT
from hilrig_sim.commands import ZERO_EFFORT, CommandLatch, StepTimes

MS = 1_000_000


def command(seq: int = 1, at_ms: int = 0, **fields: Any) -> TimestampedPayload:
    given: dict[str, Any] = {
        "effort": [1.0, 2.0, 3.0, 4.0],
        "session": "s",
        "basis_incarnation": 7,
        "basis_step": 5,
    } | fields
    return TimestampedPayload(TorqueCommand(seq=seq, **given).SerializeToString(), at_ms * MS)


def tick(latch: CommandLatch, received: TimestampedPayload | None, now_ns: int) -> None:
    """End the step before, and latch the command of the next tick."""
    latch.start_step()
    latch.latch(received, now_ns)


def new_latch(timeout_ms: int = 600) -> CommandLatch:
    return CommandLatch(incarnation=7, timeout_ns=timeout_ms * MS)


def test_effort_is_zero_before_the_first_command() -> None:
    latch = new_latch()
    tick(latch, None, 10_000 * MS)
    assert (latch.effort, latch.safe, latch.seq, latch.command_lost) == (ZERO_EFFORT, True, 0, False)


def test_new_command_has_basis_and_arrival_for_one_tick() -> None:
    latch = new_latch()
    received = command(at_ms=3)
    tick(latch, received, 20 * MS)
    assert latch.is_new
    assert (latch.effort, latch.basis_step, latch.arrived_ns) == ((1.0, 2.0, 3.0, 4.0), 5, 3 * MS)
    assert not latch.safe
    assert not latch.command_resumed
    tick(latch, received, 40 * MS)
    assert not latch.is_new
    assert (latch.basis_step, latch.arrived_ns, latch.seq) == (0, 0, 1)
    assert latch.effort == (1.0, 2.0, 3.0, 4.0)


def test_repetition_restarts_the_timeout_but_is_not_new() -> None:
    latch = new_latch(timeout_ms=100)
    tick(latch, command(at_ms=0), 0)
    tick(latch, command(at_ms=90), 95 * MS)
    assert not latch.is_new
    tick(latch, None, 180 * MS)
    assert not latch.safe


@pytest.mark.parametrize("change", [{"seq": 2}, {"session": "t"}])
def test_new_number_or_session_is_a_new_command(change: dict[str, object]) -> None:
    latch = new_latch()
    tick(latch, command(), 0)
    tick(latch, command(**{"at_ms": 5, **change}), 20 * MS)  # type: ignore[arg-type]
    assert latch.is_new


def test_timeout_zeroes_effort_until_the_next_message() -> None:
    latch = new_latch(timeout_ms=100)
    received = command(magnet=True)
    tick(latch, received, 0)
    tick(latch, received, 100 * MS)
    assert not latch.safe
    tick(latch, received, 101 * MS)
    assert latch.safe
    assert latch.command_lost
    assert latch.effort == ZERO_EFFORT
    assert latch.magnet
    assert latch.silent_ns == 101 * MS
    tick(latch, received, 121 * MS)
    assert latch.safe
    assert not latch.command_lost
    tick(latch, command(at_ms=139), 140 * MS)
    assert latch.command_resumed
    assert not latch.is_new
    assert latch.effort == (1.0, 2.0, 3.0, 4.0)
    tick(latch, command(at_ms=139), 160 * MS)
    assert not latch.command_resumed


def test_timeout_zero_holds_a_command_forever() -> None:
    latch = new_latch(timeout_ms=0)
    tick(latch, command(), 0)
    tick(latch, None, 10**15)
    assert not latch.safe


def test_basis_of_another_incarnation_is_ignored() -> None:
    latch = new_latch()
    tick(latch, command(basis_incarnation=6), 0)
    assert latch.is_new
    assert latch.basis_step == 0


def test_efforts_are_limited_and_finite() -> None:
    latch = new_latch()
    tick(latch, command(effort=[math.nan, math.inf, -math.inf, 1e9]), 0)
    assert latch.effort == (0.0, LARGEST_EFFORT, -LARGEST_EFFORT, LARGEST_EFFORT)


def test_malformed_message_is_counted_and_ignored() -> None:
    latch = new_latch()
    tick(latch, command(), 0)
    tick(latch, TimestampedPayload(b"\xff\xff\xff", MS), 20 * MS)
    tick(latch, command(seq=9, effort=[1.0]), 40 * MS)
    assert latch.counters.malformed == 2
    assert (latch.seq, latch.effort) == (1, (1.0, 2.0, 3.0, 4.0))


def test_increased_count_requests_a_reset() -> None:
    latch = new_latch()
    resets_requested = []
    for seq, resets in enumerate([3, 3, 4, 4, 0, 1], start=1):
        tick(latch, command(seq=seq, resets=resets), seq * MS)
        resets_requested.append(latch.reset)
    # The first count is only a reference; a lower count is that of a restarted edge.
    assert resets_requested == [False, False, True, False, False, True]
    tick(latch, command(seq=6, resets=2), 8 * MS)
    assert latch.reset


def test_step_times_are_kept_up_to_the_capacity() -> None:
    times = StepTimes(capacity=4)
    assert times.get(0) is None
    for step in range(1, 7):
        times.add(step, step * 10)
    assert [times.get(step) for step in range(8)] == [None, None, None, 30, 40, 50, 60, None]


def test_command_superseded_before_its_tick_is_not_applied() -> None:
    latch = new_latch()
    tick(latch, command(seq=1, at_ms=15, basis_step=4, effort=[9.0, 0.0, 0.0, 0.0]), 20 * MS)
    latch.latch(command(seq=2, at_ms=19, basis_incarnation=8), 20 * MS)
    assert latch.is_new
    assert (latch.seq, latch.effort, latch.arrived_ns) == (2, (1.0, 2.0, 3.0, 4.0), 19 * MS)
    assert latch.basis_step == 0


def test_repetition_or_malformed_message_supersedes_nothing() -> None:
    latch = new_latch()
    received = command(seq=1, at_ms=15)
    tick(latch, received, 20 * MS)
    for later in (received, None, command(seq=1, at_ms=19), TimestampedPayload(b"\xff\xff\xff", 19 * MS)):
        latch.latch(later, 20 * MS)
        assert latch.is_new
        assert (latch.seq, latch.basis_step, latch.arrived_ns) == (1, 5, 15 * MS)
    assert latch.counters.malformed == 1


def test_reset_of_superseded_command_is_executed_once() -> None:
    latch = new_latch()
    tick(latch, command(seq=1), 20 * MS)
    tick(latch, command(seq=2, resets=1), 40 * MS)
    last = command(seq=3, resets=1)
    latch.latch(last, 40 * MS)
    assert latch.reset
    tick(latch, last, 60 * MS)
    assert not latch.reset


def test_command_just_before_the_timeout_tick_is_not_lost() -> None:
    latch = new_latch(timeout_ms=100)
    received = command()
    tick(latch, received, 0)
    tick(latch, received, 120 * MS)
    assert latch.command_lost
    latch.latch(command(seq=2, at_ms=119), 120 * MS)
    assert (latch.safe, latch.command_lost, latch.command_resumed) == (False, False, False)
    assert latch.effort == (1.0, 2.0, 3.0, 4.0)
