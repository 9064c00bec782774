"""When commands leave: at once where they are few; where they are many together, each in time for its tick."""

import itertools

import pytest

from hilrig_modbus_edge import command_scheduler as departures
from hilrig_modbus_edge.command_scheduler import (
    FEW,
    GATHER_NS,
    JUST_AFTER_NS,
    LAST_NS,
    MANY,
    NEAR_NS,
    PARTS,
    Departures,
)
from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import RigBatch

STEP_NS = 20_000_000
US = 1_000
RIGS = ("other", *(f"rig{number}" for number in range(7)))


class Call:
    """What was asked for."""

    def __init__(self, at_ns: int, call: object) -> None:
        self.at_ns, self.call, self.cancelled = at_ns, call, False

    def cancel(self) -> None:
        self.cancelled = True


class Edge:
    """Departures on a clock of their own; `left` is what left, with the time since the last states, ns."""

    def __init__(self, step_ns: int = STEP_NS) -> None:
        self.clock = ManualClock()
        self.states = LatestValueCache(self.clock, Counters(), {})
        self.timers: list[Call] = []
        self.left: list[tuple[int, dict[str, bytes]]] = []
        self.departures = Departures("edge/1", self._put, self.states.get, step_ns, self.clock, self._call_at)
        self.send = self.departures.send
        self.ticked_ns = 0
        self.tick()

    def _put(self, payload: bytes) -> None:
        batch = RigBatch.FromString(payload)
        assert batch.source == "edge/1"
        self.left.append((self.since_tick_ns, dict(zip(batch.rigs, batch.messages, strict=True))))

    def _call_at(self, when_s: float, call: object) -> Call:
        self.timers.append(Call(round(when_s * 1e9), call))
        return self.timers[-1]

    @property
    def since_tick_ns(self) -> int:
        return self.clock.monotonic_ns() - self.ticked_ns

    @property
    def pending(self) -> list[Call]:
        return [timer for timer in self.timers if not timer.cancelled]

    def tick(self, *rigs: str) -> None:
        """States come, of all rigs if none is named."""
        self.ticked_ns = self.clock.monotonic_ns()
        batch = RigBatch(rigs=rigs or RIGS, messages=[b""] * len(rigs or RIGS))
        self.states.on_message("", batch.SerializeToString())

    def go_to(self, since_tick_ns: int) -> None:
        """Let time pass, and what is due be called."""
        until_ns = self.ticked_ns + since_tick_ns
        while (due := min(self.pending, key=lambda timer: timer.at_ns, default=None)) and due.at_ns <= until_ns:
            self.timers.remove(due)
            self.clock.advance(max(0, due.at_ns - self.clock.monotonic_ns()))
            due.call()  # type: ignore[operator]
        self.clock.advance(until_ns - self.clock.monotonic_ns())

    def be_many(self, tick_ns: int = 0) -> None:
        """So many came that they wait for each other from now on; states have just come."""
        for _ in range(MANY):
            self.send("other", b"")
        self.departures.look()
        self.left.clear()
        self.clock.advance(STEP_NS + tick_ns)
        self.tick()


def test_where_there_are_few_each_command_leaves_at_once() -> None:
    edge = Edge()
    for _ in range(3):
        for _ in range(MANY - 1):
            edge.send("rig1", b"x")
        edge.departures.look()
    assert len(edge.left) == 3 * (MANY - 1)
    assert edge.timers == []


def test_where_there_are_many_the_first_words_of_a_short_while_leave_together() -> None:
    edge = Edge()
    edge.be_many()
    edge.go_to(500 * US)
    edge.send("rig1", b"a")
    edge.go_to(700 * US)
    edge.send("rig2", b"b")
    assert edge.left == []
    edge.go_to(10_000 * US)
    assert edge.left == [(500 * US + GATHER_NS, {"rig1": b"a", "rig2": b"b"})]


def test_a_first_word_that_comes_near_the_tick_does_not_wait() -> None:
    edge = Edge()
    edge.be_many()
    now_ns = STEP_NS - NEAR_NS + 1
    edge.go_to(now_ns)
    edge.send("rig1", b"a")
    edge.send("rig2", b"b")
    assert edge.left == []
    # It is the next thing that the loop does.
    edge.go_to(now_ns)
    assert edge.left == [(now_ns, {"rig1": b"a", "rig2": b"b"})]


def test_of_a_controller_that_asks_again_and_again_the_newest_word_leaves_in_time_for_the_tick() -> None:
    edge = Edge()
    edge.be_many()
    edge.send("rig1", b"first")
    edge.go_to(GATHER_NS)
    assert edge.left == [(GATHER_NS, {"rig1": b"first"})]
    for number in range(3, 19):
        edge.go_to(number * 1000 * US)
        edge.send("rig1", b"%d" % number)
    edge.go_to(STEP_NS - LAST_NS)
    assert edge.left[1:] == [(STEP_NS - LAST_NS, {"rig1": b"18"})]


def test_what_is_fresh_takes_along_what_can_wait() -> None:
    edge = Edge()
    edge.be_many()
    edge.send("rig1", b"first")
    edge.go_to(GATHER_NS)
    edge.send("rig1", b"second")
    edge.go_to(5_000 * US)
    edge.send("rig2", b"first")
    edge.go_to(STEP_NS)
    assert edge.left[1:] == [(5_000 * US + GATHER_NS, {"rig1": b"second", "rig2": b"first"})]


def test_shortly_before_the_tick_the_words_of_one_who_says_few_leave_at_short_distances() -> None:
    edge = Edge()
    edge.be_many()
    first_ns = STEP_NS - LAST_NS
    edge.go_to(first_ns)
    for number in range(FEW):
        edge.go_to(first_ns + number * 100 * US)
        edge.send("rig1", b"%d" % number)
    edge.go_to(STEP_NS)
    times = [at_ns for at_ns, _ in edge.left]
    assert times[0] == first_ns
    distances = {after - before for before, after in itertools.pairwise(times)}
    # The next begins to wait with the first command after a departure.
    assert max(distances) <= STEP_NS // PARTS + 100 * US
    assert min(distances) >= STEP_NS // PARTS
    assert edge.left[-1][1] == {"rig1": b"%d" % (FEW - 1)}


def test_shortly_before_the_tick_one_who_asks_again_and_again_waits_for_the_next_states() -> None:
    edge = Edge()
    edge.be_many()
    for number in range(FEW):
        edge.send("rig1", b"%d" % number)
    edge.go_to(STEP_NS - LAST_NS)
    edge.left.clear()
    for number in range(FEW, 50):
        edge.go_to(STEP_NS - LAST_NS + number * 10 * US)
        edge.send("rig1", b"%d" % number)
    # The tick of the simulation, and its states.
    edge.go_to(STEP_NS)
    edge.tick()
    edge.send("rig1", b"first on the next states")
    edge.go_to(10_000 * US)
    assert edge.left == [(GATHER_NS, {"rig1": b"first on the next states"})]


def test_what_waits_for_the_next_states_leaves_though_they_do_not_come_and_nobody_writes_again() -> None:
    edge = Edge()
    edge.be_many()
    for _ in range(FEW):
        edge.send("rig1", b"before")
    edge.go_to(STEP_NS - 1_000 * US)
    edge.left.clear()
    edge.send("rig1", b"last")
    edge.go_to(2 * STEP_NS)
    assert edge.left == [(STEP_NS + GATHER_NS, {"rig1": b"last"})]


def test_while_the_tick_is_late_commands_leave_at_short_distances() -> None:
    edge = Edge()
    edge.be_many()
    for number in range(FEW):
        edge.send("rig1", b"%d" % number)
    edge.go_to(STEP_NS + GATHER_NS)
    edge.left.clear()
    for number in range(400):
        edge.go_to(STEP_NS + GATHER_NS + number * 10 * US)
        edge.send("rig1", b"%d" % number)
    edge.go_to(STEP_NS + 8_000 * US)
    times = [at_ns for at_ns, _ in edge.left]
    distances = {after - before for before, after in itertools.pairwise(times)}
    # The next begins to wait with the first command after a departure.
    assert max(distances) <= STEP_NS // PARTS + 10 * US
    assert min(distances) >= STEP_NS // PARTS
    assert edge.left[-1][1] == {"rig1": b"399"}


def test_the_moment_after_the_last_departure_is_the_nearest_one() -> None:
    edge = Edge()
    just_after_ns = edge.ticked_ns + STEP_NS - LAST_NS + JUST_AFTER_NS
    for steps in (0, 1, 2, 10):
        for off_ns in (-STEP_NS // 2 + 1, -1, 0, 1, STEP_NS // 2 - 1):
            at_ns = just_after_ns + steps * STEP_NS
            assert edge.departures.after_last("rig1", at_ns + off_ns) == at_ns


def test_while_no_state_has_come_every_moment_is_as_good() -> None:
    assert Edge().departures.after_last("a rig without a state", 12_345) == 12_345


@pytest.mark.parametrize("step_ns", [1_000_000, 5_000_000])
def test_at_a_short_step_a_first_word_leaves_at_once_and_the_newest_a_little_later(step_ns: int) -> None:
    edge = Edge(step_ns)
    edge.be_many()
    late_ns = max(0, step_ns - NEAR_NS) + 1
    edge.go_to(late_ns)
    edge.send("rig1", b"first")
    edge.go_to(late_ns)
    assert edge.left == [(late_ns, {"rig1": b"first"})]
    edge.send("rig1", b"second")
    edge.go_to(max(late_ns + step_ns // PARTS, step_ns - LAST_NS))
    assert edge.left[1][1] == {"rig1": b"second"}


def test_each_rig_has_the_tick_of_its_own_simulation() -> None:
    edge = Edge()
    edge.be_many()
    edge.go_to(9_000 * US)
    edge.tick("rig2")
    # 2 ms before the next tick of rig1's simulation, 11 ms before that of rig2's.
    edge.go_to(9_000 * US)
    edge.send("rig2", b"far")
    edge.send("rig1", b"near")
    edge.go_to(9_000 * US)
    assert edge.left == [(9_000 * US, {"rig1": b"near", "rig2": b"far"})]
    edge.send("rig2", b"far again")
    edge.send("rig1", b"near again")
    edge.go_to(STEP_NS)
    assert edge.left[1:] == [(11_000 * US - LAST_NS, {"rig1": b"near again", "rig2": b"far again"})]


def test_while_the_simulation_is_silent_commands_leave_as_seldom_as_they_can() -> None:
    edge = Edge()
    edge.be_many()
    edge.send("rig1", b"first")
    edge.go_to(2 * STEP_NS)
    edge.left.clear()
    for number in range(1, 1001):
        edge.go_to(2 * STEP_NS + number * 100 * US)
        edge.send("rig1", b"%d" % number)
    # 100 ms of them.
    assert 4 <= len(edge.left) <= 6
    # It comes back.
    edge.tick()
    edge.send("rig1", b"now")
    edge.go_to(GATHER_NS)
    assert edge.left[-1][1] == {"rig1": b"now"}


def test_timers_do_not_become_more() -> None:
    edge = Edge()
    edge.be_many()
    for step in range(20):
        for number in range(200):
            edge.go_to(number * 100 * US)
            edge.send(f"rig{number % 7}", b"%d" % number)
            assert len(edge.pending) == 1
        edge.departures.look()
        edge.clock.advance(STEP_NS - edge.since_tick_ns)
        edge.tick()
        # A first word and a last one.
        assert len(edge.left) <= (step + 1) * 2 + 1


def test_when_there_are_few_again_what_waits_leaves_at_once() -> None:
    edge = Edge()
    edge.be_many()
    edge.send("rig1", b"a")
    edge.departures.look()
    edge.send("rig1", b"b")
    assert [commands for _, commands in edge.left] == [{"rig1": b"a"}, {"rig1": b"b"}]
    assert edge.pending == []


def test_the_moments_fit_each_other() -> None:
    assert departures.LAST_NS < departures.NEAR_NS
    assert departures.GATHER_NS < departures.NEAR_NS
