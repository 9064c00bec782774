"""Schedules command transmission: coalesces the commands of all rigs of an edge into few messages.

The simulation latches only the newest command of each rig at its tick, so an older one can be dropped and the commands
of several rigs can share a message. Each message costs the sender, threads of the bus on both sides and the simulation
a wake-up (0.1 ms of processor time in all), which on a small machine is taken from the requests in progress. At 128
rigs, one message per command keeps 63 % of the loops within one step, this schedule 98 % (`bench/ablation.py`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from hilrig_modbus_edge.registers.map import SEPARATE_WRITES
from hilrig_runtime.bus.api import Publisher
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigBatch

COALESCE_WINDOW_NS: Final = 2_000_000
"""Shortest time between two messages before the deadline, ns: at most ten messages per step of 20 ms."""
DEADLINE_MARGIN_NS: Final = 1_500_000
"""Time before the estimated tick at which no command is delayed any further, ns.

It covers the latency of the state, by which the estimate is late (0.3 ms at the median, 0.7 ms at the 99th percentile
with 128 rigs), and that of the command (0.5 and 0.8 ms): `state link` and `command link` of `bench/scale.py`.
"""


class TimerHandle(Protocol):
    """Handle of a scheduled call."""

    def cancel(self) -> None:
        """Cancel the scheduled call."""


@dataclass(slots=True)
class _StateWrites:
    """Number of a rig's commands that are based on its newest state."""

    state_ns: int
    """Arrival of the state, ns, monotonic clock; 0: no state has arrived."""
    count: int = 0


class CommandScheduler:
    """Sends the commands of an edge's rigs; runs on the event loop of the edge.

    A command is sent at once, unless a message was sent within `COALESCE_WINDOW_NS`: then it waits for the rest of the
    window, but never beyond the deadline before the next tick. Further commands of a rig on the same state
    replace one another until that deadline: a busy-polling client causes one message per step instead of hundreds.

    Args:
        source: name of the edge, put into the messages.
        publisher: publisher of the batches of commands.
        states: newest state of each rig; its arrival is an estimate of the last tick of the simulation.
        step_ns: step of the simulation, ns.
        clock: monotonic time.
        call_at: calls a function on the event loop at a time of its clock, s.
    """

    def __init__(
        self,
        source: str,
        publisher: Publisher,
        states: LatestValueCache,
        step_ns: int,
        clock: Clock,
        call_at: Callable[[float, Callable[[], None]], TimerHandle],
    ) -> None:
        self._source = source
        self._publisher = publisher
        self._states = states
        self._step_ns = step_ns
        self._monotonic_ns = clock.monotonic_ns
        self._call_at = call_at
        self._pending: dict[str, bytes] = {}
        """By rig, its newest pending command, encoded."""
        self._writes: dict[str, _StateWrites] = {}
        self._flushed_ns = 0
        self._flush_due_ns = 0
        self._timer: TimerHandle | None = None

    def send(self, rig: str, command: bytes, now_ns: int) -> None:
        """Send an encoded command of a rig, now or in time for the next tick; ns, monotonic clock."""
        self._pending[rig] = command
        due_ns = self._send_time(rig, now_ns)
        if due_ns <= now_ns:
            self.flush()
        elif self._timer is None or due_ns < self._flush_due_ns:
            if self._timer is not None:
                self._timer.cancel()
            self._flush_due_ns = due_ns
            self._timer = self._call_at(due_ns * 1e-9, self.flush)

    def flush(self) -> None:
        """Send the pending commands."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        pending = self._pending
        if pending:
            batch = RigBatch(source=self._source, rigs=pending, messages=pending.values())
            self._publisher.put(batch.SerializeToString())
            pending.clear()
            self._flushed_ns = self._monotonic_ns()

    def _send_time(self, rig: str, now_ns: int) -> int:
        """Return the latest time at which a new command of a rig is sent, ns, monotonic clock."""
        window_end_ns = self._flushed_ns + COALESCE_WINDOW_NS
        state = self._states.get(rig)
        state_ns = 0 if state is None else state.arrived_ns
        writes = self._writes.get(rig)
        if writes is None or writes.state_ns != state_ns:
            writes = self._writes[rig] = _StateWrites(state_ns)
        writes.count += 1
        tick_ns = state_ns + self._step_ns
        if now_ns > tick_ns + self._step_ns:
            # The simulation publishes no states: there is no tick to estimate.
            return window_end_ns
        deadline_ns = tick_ns - DEADLINE_MARGIN_NS
        if writes.count <= SEPARATE_WRITES:
            return min(window_end_ns, deadline_ns)
        return deadline_ns if now_ns < deadline_ns else window_end_ns
