"""Scheduling of commands: sent at once where they are rare, coalesced where they are many, in time for the tick."""

import itertools

import pytest

from hilrig_modbus_edge.command_scheduler import (
    COALESCE_WINDOW_NS,
    DEADLINE_MARGIN_NS,
    CommandScheduler,
)
from hilrig_modbus_edge.registers.map import SEPARATE_WRITES
from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import RigBatch

STEP_NS = 20_000_000
US = 1_000
RIGS = ("other", *(f"rig{number}" for number in range(7)))


class Call:
    """A scheduled call."""

    def __init__(self, at_ns: int, call: object) -> None:
        self.at_ns, self.call, self.cancelled = at_ns, call, False

    def cancel(self) -> None:
        self.cancelled = True


class Edge:
    """A scheduler on a clock of its own; `sent` are its messages, with the time since the last states, ns."""

    def __init__(self, step_ns: int = STEP_NS) -> None:
        self.clock = ManualClock()
        self.states = LatestValueCache(self.clock, Counters(), {})
        self.timers: list[Call] = []
        self.sent: list[tuple[int, dict[str, bytes]]] = []
        scheduler = CommandScheduler("edge/1", self, self.states, step_ns, self.clock, self._call_at)  # type: ignore[arg-type]
        self.scheduler, self.flush = scheduler, scheduler.flush
        self.clock.advance(10 * STEP_NS)
        self.tick()

    def send(self, rig: str, command: bytes) -> None:
        self.scheduler.send(rig, command, self.clock.monotonic_ns())

    def put(self, payload: bytes) -> None:
        batch = RigBatch.FromString(payload)
        assert batch.source == "edge/1"
        self.sent.append((self.since_tick_ns, dict(zip(batch.rigs, batch.messages, strict=True))))

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
        """States arrive: those of the named rigs, or of all."""
        self.ticked_ns = self.clock.monotonic_ns()
        batch = RigBatch(rigs=rigs or RIGS, messages=[b""] * len(rigs or RIGS))
        self.states.on_message("", batch.SerializeToString())

    def advance_to(self, since_tick_ns: int) -> None:
        """Advance the clock, with the scheduled calls that become due."""
        until_ns = self.ticked_ns + since_tick_ns
        while (due := min(self.pending, key=lambda timer: timer.at_ns, default=None)) and due.at_ns <= until_ns:
            self.timers.remove(due)
            self.clock.advance(max(0, due.at_ns - self.clock.monotonic_ns()))
            due.call()  # type: ignore[operator]
        self.clock.advance(until_ns - self.clock.monotonic_ns())


def test_sends_rare_commands_at_once() -> None:
    edge = Edge()
    for number in range(100):
        edge.advance_to(number * COALESCE_WINDOW_NS)
        edge.tick()
        edge.send("rig1", b"%d" % number)
        edge.clock.advance(COALESCE_WINDOW_NS)
    assert [commands for _, commands in edge.sent] == [{"rig1": b"%d" % number} for number in range(100)]
    assert edge.timers == []


def test_coalesces_commands_within_the_window() -> None:
    edge = Edge()
    edge.advance_to(500 * US)
    edge.send("rig1", b"a")
    edge.advance_to(700 * US)
    edge.send("rig2", b"b")
    edge.advance_to(900 * US)
    edge.send("rig3", b"c")
    assert edge.sent == [(500 * US, {"rig1": b"a"})]
    edge.advance_to(10_000 * US)
    assert edge.sent[1:] == [(500 * US + COALESCE_WINDOW_NS, {"rig2": b"b", "rig3": b"c"})]


@pytest.mark.parametrize("step_ns", [1_000_000, 5_000_000, STEP_NS])
def test_delays_no_prompt_command_beyond_the_deadline(step_ns: int) -> None:
    edge = Edge(step_ns)
    deadline_ns = step_ns - DEADLINE_MARGIN_NS
    edge.advance_to(max(0, deadline_ns - 100 * US))
    edge.send("rig1", b"a")
    edge.send("rig2", b"b")
    edge.advance_to(max(0, deadline_ns))
    edge.send("rig3", b"c")
    edge.send("rig4", b"d")
    edge.advance_to(step_ns)
    assert [at_ns for at_ns, _ in edge.sent] in (
        [deadline_ns - 100 * US, deadline_ns, deadline_ns, deadline_ns],
        [0, 0, 0, 0],
    )
    assert {rig for _, commands in edge.sent for rig in commands} == {"rig1", "rig2", "rig3", "rig4"}


def test_separate_writes_before_the_tick_are_sent_at_once() -> None:
    edge = Edge()
    edge.advance_to(STEP_NS - DEADLINE_MARGIN_NS)
    for number in range(SEPARATE_WRITES):
        edge.advance_to(STEP_NS - DEADLINE_MARGIN_NS + number * 100 * US)
        edge.send("rig1", b"%d" % number)
    assert [commands["rig1"] for _, commands in edge.sent] == [b"%d" % number for number in range(SEPARATE_WRITES)]


def test_replaces_further_commands_on_a_state_until_the_deadline() -> None:
    edge = Edge()
    for number in range(180):
        edge.advance_to(number * 100 * US)
        edge.send("rig1", b"%d" % number)
    edge.advance_to(STEP_NS - DEADLINE_MARGIN_NS)
    assert edge.sent[0] == (0, {"rig1": b"0"})
    assert edge.sent[-1] == (STEP_NS - DEADLINE_MARGIN_NS, {"rig1": b"179"})
    # The first command, the end of its window, the deadline.
    assert len(edge.sent) == 3


def test_further_commands_after_the_deadline_wait_for_the_window() -> None:
    edge = Edge()
    for number in range(SEPARATE_WRITES):
        edge.send("rig1", b"%d" % number)
    edge.advance_to(STEP_NS - DEADLINE_MARGIN_NS)
    edge.send("rig1", b"near")
    edge.send("rig1", b"nearer")
    edge.sent.clear()
    edge.advance_to(STEP_NS)
    edge.tick()
    edge.send("rig1", b"next state")
    edge.advance_to(10_000 * US)
    assert edge.sent == [(COALESCE_WINDOW_NS - DEADLINE_MARGIN_NS, {"rig1": b"next state"})]


def test_pending_command_is_sent_though_no_state_follows() -> None:
    edge = Edge()
    for _ in range(SEPARATE_WRITES):
        edge.send("rig1", b"before")
    edge.advance_to(STEP_NS - 1_000 * US)
    edge.sent.clear()
    edge.send("rig1", b"last")
    edge.advance_to(2 * STEP_NS)
    assert [commands for _, commands in edge.sent] == [{"rig1": b"last"}]


def test_prompt_command_carries_the_pending_ones() -> None:
    edge = Edge()
    for number in range(SEPARATE_WRITES + 1):
        edge.send("rig1", b"%d" % number)
    edge.advance_to(5_000 * US)
    edge.sent.clear()
    edge.send("rig1", b"further")
    edge.send("rig2", b"first")
    assert edge.sent == [(5_000 * US, {"rig1": b"further", "rig2": b"first"})]


def test_each_rig_has_the_deadline_of_its_own_simulation() -> None:
    edge = Edge()
    edge.advance_to(9_000 * US)
    edge.tick("rig2")
    # rig1's simulation has its next tick in 11 ms, rig2's in 20 ms.
    for rig in ("rig1", "rig2"):
        for _ in range(SEPARATE_WRITES):
            edge.send(rig, b"first")
    edge.advance_to(5_000 * US)
    edge.sent.clear()
    edge.send("rig2", b"far")
    edge.advance_to(6_000 * US)
    edge.send("rig1", b"near")
    edge.advance_to(STEP_NS)
    assert edge.sent == [(11_000 * US - DEADLINE_MARGIN_NS, {"rig1": b"near", "rig2": b"far"})]


def test_sends_once_a_window_while_the_simulation_is_silent() -> None:
    edge = Edge()
    edge.advance_to(3 * STEP_NS)
    for number in range(1, 1001):
        edge.advance_to(3 * STEP_NS + number * 100 * US)
        edge.send("rig1", b"%d" % number)
    distances = {after - before for (before, _), (after, _) in itertools.pairwise(edge.sent)}
    assert distances == {COALESCE_WINDOW_NS}
    edge.tick()
    edge.send("rig1", b"now")
    edge.advance_to(COALESCE_WINDOW_NS)
    assert edge.sent[-1][1] == {"rig1": b"now"}


def test_sends_at_once_before_the_first_state() -> None:
    edge = Edge()
    edge.send("a rig without a state", b"x")
    assert edge.sent == [(0, {"a rig without a state": b"x"})]


def test_schedules_one_timer_at_most() -> None:
    edge = Edge()
    for _ in range(20):
        for number in range(200):
            edge.advance_to(number * 100 * US)
            edge.send(f"rig{number % 7}", b"%d" % number)
            assert len(edge.pending) <= 1
        edge.clock.advance(STEP_NS - edge.since_tick_ns)
        edge.tick()


def test_flush_sends_pending_commands_at_once() -> None:
    edge = Edge()
    edge.send("rig1", b"a")
    edge.send("rig2", b"b")
    edge.flush()
    assert [commands for _, commands in edge.sent] == [{"rig1": b"a"}, {"rig2": b"b"}]
    assert edge.pending == []
    edge.flush()
    assert len(edge.sent) == 2


def test_busy_polling_never_delays_another_rig_beyond_a_window() -> None:
    edge = Edge()
    waits = []
    for number in range(370):
        edge.advance_to(number * 50 * US)
        edge.send("rig1", b"%d" % number)
        if number % 37 == 0:
            begin_ns = edge.since_tick_ns
            edge.send(f"rig{2 + number // 37 % 5}", b"x")
            edge.advance_to((number + 40) * 50 * US)
            sent = next(at_ns for at_ns, commands in edge.sent if at_ns >= begin_ns and b"x" in commands.values())
            waits.append(sent - begin_ns)
    assert max(waits) <= COALESCE_WINDOW_NS
