"""Timing of the simulated loop: the state served to each poll, and the tick from which each command acts.

The timing does not depend on the motion of the arm, so the timeline of a run is computed before its first step, as
arrays, from period and phase of the controller, transport times and injected delays. The rules are those of
docs/timing.md: a state is published at its tick; a read is served the newest state released by then; a command acts
from the first tick at or after its arrival; a command that arrives after a newer one is discarded.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LOST_NS: Final = np.iinfo(np.int64).max
"""Arrival time of a lost message, ns."""
NO_POLL: Final = -1
"""Value of `in_force` before the first command acts."""


@dataclass(frozen=True, slots=True)
class LoopTiming:
    """Timing of the loop without injected delays; ns."""

    step_ns: int = 20_000_000
    """Step of the simulation."""
    period_ns: int = 20_000_000
    """Poll period of the controller."""
    phase_ns: int = 5_000_000
    """Time from tick 0 to the first read."""
    compute_ns: int = 1_000_000
    """Time from a read to its write at the edge: computation and network round trip of the controller."""
    transport_ns: int = 400_000
    """Transport time over the bus, per direction."""

    def __post_init__(self) -> None:
        for name in ("step_ns", "period_ns"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("phase_ns", "compute_ns", "transport_ns"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} must be ≥ 0, got {getattr(self, name)}")
        if self.compute_ns >= self.period_ns:
            raise InputError(
                f"the poll period must be longer than the time from read to write, {self.compute_ns / 1e6:g} ms, "
                f"got {self.period_ns / 1e6:g} ms"
            )

    def basis(self, poll: int, state_delay_ns: int = 0) -> int:
        """Return the step of the state served to a poll under a constant delay of the state link, ns."""
        read_ns = self.phase_ns + poll * self.period_ns
        return (read_ns - self.transport_ns - state_delay_ns) // self.step_ns

    def acts(self, poll: int, command_delay_ns: int = 0) -> int:
        """Return the tick from which the command of a poll acts under a constant delay of the command link, ns."""
        arrival_ns = self.phase_ns + poll * self.period_ns + self.compute_ns + self.transport_ns + command_delay_ns
        return -(-arrival_ns // self.step_ns)

    def latency_steps(self, state_delay_ns: int = 0, command_delay_ns: int = 0) -> tuple[int, int]:
        """Return the smallest and largest loop latency over a period of the poll pattern, in steps."""
        polls = range(math.lcm(self.step_ns, self.period_ns) // self.period_ns)
        steps = [self.acts(poll, command_delay_ns) - self.basis(poll, state_delay_ns) for poll in polls]
        return min(steps), max(steps)


@dataclass(frozen=True, slots=True)
class Timeline:
    """Timing of one run, over T ticks and P polls."""

    step_ns: int
    poll_ns: Ints
    """Read time of each poll relative to tick 0, ns, (P,)."""
    poll_tick: Ints
    """Tick of the step into which the read falls, (P,)."""
    basis: Ints
    """Step of the served state, (P,); negative: no state has arrived yet, and the controller does not write."""
    in_force: Ints
    """Poll whose command acts from each tick on, (T,); `NO_POLL`: none."""
    latency: Ints
    """Loop latency of the command that takes effect at a tick, steps, (T,); 0: no new command."""
    shown_latency: Ints
    """Latest loop latency contained in the served state, steps, (P,); 0: none yet."""

    @property
    def samples_ns(self) -> Ints:
        """Loop latency samples as defined by `hilrig latency`, one per new command, ns, (samples,)."""
        return self.latency[self.latency > 0] * self.step_ns

    def ages(self) -> Ints:
        """Return the age of the acting command at each tick, steps, (T',), from the first tick with a command."""
        ticks = np.flatnonzero(self.in_force != NO_POLL)
        return np.asarray(ticks - self.basis[self.in_force[ticks]], dtype=np.int64)


def poll_count(timing: LoopTiming, ticks: int) -> int:
    """Return the number of polls that read before tick `ticks`."""
    return max(0, -(-(ticks * timing.step_ns - timing.phase_ns) // timing.period_ns))


def timeline(
    timing: LoopTiming,
    ticks: int,
    state_delay_ns: Ints | int = 0,
    command_delay_ns: Ints | int = 0,
    state_lost: Bools | None = None,
    command_lost: Bools | None = None,
) -> Timeline:
    """Compute the timeline of one run.

    Args:
        timing: timing of the loop without injected delays.
        ticks: T.
        state_delay_ns: injected delay of the state link, ns, one number or (T,).
        command_delay_ns: injected delay of the command link, ns, one number or (P,), P from `poll_count`.
        state_lost: which states are lost, (T,).
        command_lost: which commands are lost, (P,).

    Raises:
        InputError: a delay is negative.
    """
    smallest_ns = int(min(np.min(state_delay_ns), np.min(command_delay_ns, initial=0)))
    if smallest_ns < 0:
        raise InputError(f"injected delays must be ≥ 0 ns, got {smallest_ns}")
    step_ns, polls = timing.step_ns, poll_count(timing, ticks)
    tick_ns = np.arange(ticks, dtype=np.int64) * step_ns
    released = tick_ns + timing.transport_ns + state_delay_ns
    poll_ns = timing.phase_ns + np.arange(polls, dtype=np.int64) * timing.period_ns
    arrived = poll_ns + timing.compute_ns + timing.transport_ns + command_delay_ns
    if state_lost is not None:
        released = np.where(state_lost, LOST_NS, released)
    if command_lost is not None:
        arrived = np.where(command_lost, LOST_NS, arrived)
    basis = _newest(released, poll_ns)
    # Before the first state has arrived, the controller writes no command.
    arrived = np.where(basis < 0, LOST_NS, arrived)
    in_force = _newest(arrived, tick_ns)
    changed = np.diff(in_force, prepend=NO_POLL) != 0
    latency = np.zeros(ticks, dtype=np.int64)
    new = np.flatnonzero(changed)
    latency[new] = new - basis[in_force[new]]
    # A state contains the latency of the last command that took effect at or before its tick.
    last = np.maximum.accumulate(np.where(latency > 0, np.arange(ticks), -1))
    published = np.where(last >= 0, latency[last], 0)
    shown = np.where(basis >= 0, published[np.maximum(basis, 0)], 0)
    return Timeline(step_ns, poll_ns, poll_ns // step_ns, basis, in_force, latency, shown)


def _newest(available_ns: Ints, query_ns: Ints) -> Ints:
    """Return for each query time the largest index that is available by then; -1: none."""
    if not len(available_ns):
        return np.full(len(query_ns), -1, dtype=np.int64)
    order = np.argsort(available_ns, kind="stable")
    newest = np.maximum.accumulate(np.where(available_ns[order] == LOST_NS, -1, order))
    count = np.searchsorted(available_ns[order], query_ns, side="right")
    return np.where(count > 0, newest[np.maximum(count - 1, 0)], -1).astype(np.int64)
