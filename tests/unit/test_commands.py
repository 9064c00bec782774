"""Which command acts, how old it is, and from when: decided without clock and bus."""

import math
from dataclasses import dataclass

import pytest

from hilrig_schemas import TorqueCommand
from hilrig_sim.arm.model import LARGEST_EFFORT
from hilrig_sim.commands import ZERO_EFFORT, CommandFollower, StepTimes

MS = 1_000_000


@dataclass(frozen=True)
class Came:
    payload: bytes
    arrived_ns: int


def command(seq: int = 1, at_ms: int = 0, **fields: object) -> Came:
    fields = {"effort": [1.0, 2.0, 3.0, 4.0], "session": "s", "basis_incarnation": 7, "basis_step": 5} | fields
    return Came(TorqueCommand(seq=seq, **fields).SerializeToString(), at_ms * MS)


def follower(timeout_ms: int = 600) -> CommandFollower:
    return CommandFollower(incarnation=7, timeout_ns=timeout_ms * MS)


def test_before_any_command_the_effort_is_zero_and_nothing_is_said_to_be_lost() -> None:
    follows = follower()
    follows.latch(None, 10_000 * MS)
    assert (follows.effort, follows.safe, follows.seq, follows.lost) == (ZERO_EFFORT, True, 0, False)


def test_a_new_command_acts_once_as_new_with_its_basis_and_arrival() -> None:
    follows = follower()
    came = command(at_ms=3)
    follows.latch(came, 20 * MS)
    assert follows.is_new
    assert (follows.effort, follows.basis_step, follows.arrived_ns) == ((1.0, 2.0, 3.0, 4.0), 5, 3 * MS)
    assert not follows.safe
    assert not follows.back
    follows.latch(came, 40 * MS)
    assert not follows.is_new
    assert (follows.basis_step, follows.arrived_ns, follows.seq) == (0, 0, 1)
    assert follows.effort == (1.0, 2.0, 3.0, 4.0)


def test_a_repeat_refreshes_the_age_but_is_not_new() -> None:
    follows = follower(timeout_ms=100)
    follows.latch(command(at_ms=0), 0)
    follows.latch(command(at_ms=90), 95 * MS)
    assert not follows.is_new
    follows.latch(None, 180 * MS)
    assert not follows.safe


@pytest.mark.parametrize("change", [{"seq": 2}, {"session": "t"}])
def test_new_is_what_has_another_number_or_session(change: dict[str, object]) -> None:
    follows = follower()
    follows.latch(command(), 0)
    follows.latch(command(**{"at_ms": 5, **change}), 20 * MS)  # type: ignore[arg-type]
    assert follows.is_new


def test_without_commands_the_effort_goes_to_zero_once_and_comes_back() -> None:
    follows = follower(timeout_ms=100)
    came = command(magnet=True)
    follows.latch(came, 0)
    follows.latch(came, 100 * MS)
    assert not follows.safe
    follows.latch(came, 101 * MS)
    assert follows.safe
    assert follows.lost
    assert follows.effort == ZERO_EFFORT
    assert follows.magnet
    assert follows.silent_ns == 101 * MS
    follows.latch(came, 121 * MS)
    assert follows.safe
    assert not follows.lost
    follows.latch(command(at_ms=139), 140 * MS)
    assert follows.back
    assert not follows.is_new
    assert follows.effort == (1.0, 2.0, 3.0, 4.0)
    follows.latch(command(at_ms=139), 160 * MS)
    assert not follows.back


def test_with_a_timeout_of_zero_a_command_holds_for_ever() -> None:
    follows = follower(timeout_ms=0)
    follows.latch(command(), 0)
    follows.latch(None, 10**15)
    assert not follows.safe


def test_a_basis_of_another_run_of_the_simulation_is_none() -> None:
    follows = follower()
    follows.latch(command(basis_incarnation=6), 0)
    assert follows.is_new
    assert follows.basis_step == 0


def test_efforts_are_cut_to_what_is_finite_and_what_the_drives_give() -> None:
    follows = follower()
    follows.latch(command(effort=[math.nan, math.inf, -math.inf, 1e9]), 0)
    assert follows.effort == (0.0, LARGEST_EFFORT, -LARGEST_EFFORT, LARGEST_EFFORT)


def test_what_is_no_command_changes_nothing_but_is_counted() -> None:
    follows = follower()
    follows.latch(command(), 0)
    follows.latch(Came(b"\xff\xff\xff", MS), 20 * MS)
    follows.latch(command(seq=9, effort=[1.0]), 40 * MS)
    assert follows.malformed == 2
    assert (follows.seq, follows.effort) == (1, (1.0, 2.0, 3.0, 4.0))


def test_a_reset_is_asked_for_by_a_count_that_grows() -> None:
    follows = follower()
    told = []
    for seq, resets in enumerate([3, 3, 4, 4, 0, 1], start=1):
        follows.latch(command(seq=seq, resets=resets), seq * MS)
        told.append(follows.reset)
    # The first is only the count that the edge has; one that fell is an edge that was started anew.
    assert told == [False, False, True, False, False, True]
    follows.latch(command(seq=6, resets=2), 8 * MS)
    assert follows.reset


def test_times_of_steps_are_kept_for_a_while() -> None:
    times = StepTimes(capacity=4)
    assert times.get(0) is None
    for step in range(1, 7):
        times.add(step, step * 10)
    assert [times.get(step) for step in range(8)] == [None, None, None, 30, 40, 50, 60, None]


def test_a_command_that_is_overtaken_before_its_tick_has_never_acted() -> None:
    follows = follower()
    follows.latch(command(seq=1, at_ms=15, basis_step=4, effort=[9.0, 0.0, 0.0, 0.0]), 20 * MS)
    follows.overtake(command(seq=2, at_ms=19, basis_incarnation=8), 20 * MS)
    assert follows.is_new
    assert (follows.seq, follows.effort, follows.arrived_ns) == (2, (1.0, 2.0, 3.0, 4.0), 19 * MS)
    assert follows.basis_step == 0


def test_what_is_the_same_nothing_or_a_repeat_overtakes_nothing() -> None:
    follows = follower()
    came = command(seq=1, at_ms=15)
    follows.latch(came, 20 * MS)
    for later in (came, None, command(seq=1, at_ms=19), Came(b"\xff\xff\xff", 19 * MS)):
        follows.overtake(later, 20 * MS)
        assert follows.is_new
        assert (follows.seq, follows.basis_step, follows.arrived_ns) == (1, 5, 15 * MS)
    assert follows.malformed == 1


def test_a_reset_that_is_overtaken_before_its_tick_is_done_once() -> None:
    follows = follower()
    follows.latch(command(seq=1), 20 * MS)
    follows.latch(command(seq=2, resets=1), 40 * MS)
    last = command(seq=3, resets=1)
    follows.overtake(last, 40 * MS)
    assert follows.reset
    follows.latch(last, 60 * MS)
    assert not follows.reset


def test_a_command_that_comes_just_before_the_tick_that_would_miss_it_was_never_lost() -> None:
    follows = follower(timeout_ms=100)
    came = command()
    follows.latch(came, 0)
    follows.latch(came, 120 * MS)
    assert follows.lost
    follows.overtake(command(seq=2, at_ms=119), 120 * MS)
    assert (follows.safe, follows.lost, follows.back) == (False, False, False)
    assert follows.effort == (1.0, 2.0, 3.0, 4.0)
