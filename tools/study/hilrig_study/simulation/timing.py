"""When things happen in the loop: which state each poll is served, and from which tick each command acts.

The times do not depend on what the arm does, so a run's whole timeline is made before its first step: as arrays, from
the controller's period and phase, the ways' transport and the injected delays. The rules are those of docs/timing.md. A
state leaves at its tick; a read is served the newest state that has been released; a write acts from the first tick at
or after its command's arrival; what arrives late behind a newer one acts no more.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.errors import InputError

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

NEVER: Final = np.iinfo(np.int64).max
"""Arrival of what is lost, ns."""
NO_POLL: Final = -1
"""`in_force` before the first command acts."""


@dataclass(frozen=True, slots=True)
class LoopTiming:
    """The loop's own times, without what is injected; ns."""

    step_ns: int = 20_000_000
    """Of the simulation."""
    period_ns: int = 20_000_000
    """Between two polls of the controller."""
    phase_ns: int = 5_000_000
    """From tick 0 to the first read."""
    compute_ns: int = 1_000_000
    """From a read to its write, at the edge: the controller's own time and its network, both ways."""
    transport_ns: int = 400_000
    """Over the bus, each way."""

    def __post_init__(self) -> None:
        for name in ("step_ns", "period_ns"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name} must be positive, found {getattr(self, name)}")
        for name in ("phase_ns", "compute_ns", "transport_ns"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} must not be negative, found {getattr(self, name)}")
        if self.compute_ns >= self.period_ns:
            raise InputError(
                f"the controller takes {self.compute_ns / 1e6:g} ms from reading to writing and polls every "
                f"{self.period_ns / 1e6:g} ms: its period must be longer"
            )

    def basis(self, poll: int, state_delay_ns: int = 0) -> int:
        """Step of the state that a poll is served under a constant delay of the state's way, ns."""
        read_ns = self.phase_ns + poll * self.period_ns
        return (read_ns - self.transport_ns - state_delay_ns) // self.step_ns

    def acts(self, poll: int, command_delay_ns: int = 0) -> int:
        """Tick from which a poll's command acts under a constant delay of the command's way, ns."""
        arrived_ns = self.phase_ns + poll * self.period_ns + self.compute_ns + self.transport_ns + command_delay_ns
        return -(-arrived_ns // self.step_ns)

    def latency_steps(self, state_delay_ns: int = 0, command_delay_ns: int = 0) -> tuple[int, int]:
        """Smallest and largest loop latency under constant delays, steps, over the pattern's period."""
        polls = range(math.lcm(self.step_ns, self.period_ns) // self.period_ns)
        steps = [self.acts(p, command_delay_ns) - self.basis(p, state_delay_ns) for p in polls]
        return min(steps), max(steps)


@dataclass(frozen=True, slots=True)
class Timeline:
    """One run's times, over T ticks and P polls."""

    step_ns: int
    poll_ns: Ints
    """When each poll reads, from tick 0, ns, (P,)."""
    poll_tick: Ints
    """Tick in whose step it does, (P,)."""
    basis: Ints
    """Step of the state that it is served; negative: none has come yet, and the controller does not write, (P,)."""
    in_force: Ints
    """Poll whose command acts from each tick on, or `NO_POLL`, (T,)."""
    latency: Ints
    """Loop latency of the command that is new at a tick, in steps; 0: none is, (T,)."""
    shown_latency: Ints
    """Last loop latency that the served state tells of, steps; 0: none yet, (P,)."""

    @property
    def samples_ns(self) -> Ints:
        """Loop latencies as `hilrig latency` takes them, one each new command, ns, (samples,)."""
        return self.latency[self.latency > 0] * self.step_ns

    def ages(self) -> Ints:
        """Age of what acts at each tick, steps, (T',), from the first tick at which a command acts."""
        ticks = np.flatnonzero(self.in_force != NO_POLL)
        return np.asarray(ticks - self.basis[self.in_force[ticks]], dtype=np.int64)


def poll_count(timing: LoopTiming, ticks: int) -> int:
    """Polls that read before tick `ticks`."""
    return max(0, -(-(ticks * timing.step_ns - timing.phase_ns) // timing.period_ns))


def timeline(
    timing: LoopTiming,
    ticks: int,
    state_delay_ns: Ints | int = 0,
    command_delay_ns: Ints | int = 0,
    state_lost: Bools | None = None,
    command_lost: Bools | None = None,
) -> Timeline:
    """One run's timeline.

    Args:
        timing: the loop's own times.
        ticks: T.
        state_delay_ns: injected into each state's way, ns, one number or (T,).
        command_delay_ns: injected into each command's way, ns, one number or (P,), P of `poll_count`.
        state_lost: which states never get to the edge, (T,).
        command_lost: which commands never get to the simulation, (P,).

    Raises:
        InputError: a delay is negative.
    """
    if np.min(state_delay_ns) < 0 or np.min(command_delay_ns, initial=0) < 0:
        raise InputError("a delay must not be negative: nothing arrives before it was sent")
    step_ns, polls = timing.step_ns, poll_count(timing, ticks)
    tick_ns = np.arange(ticks, dtype=np.int64) * step_ns
    released = tick_ns + timing.transport_ns + state_delay_ns
    poll_ns = timing.phase_ns + np.arange(polls, dtype=np.int64) * timing.period_ns
    arrived = poll_ns + timing.compute_ns + timing.transport_ns + command_delay_ns
    if state_lost is not None:
        released = np.where(state_lost, NEVER, released)
    if command_lost is not None:
        arrived = np.where(command_lost, NEVER, arrived)
    basis = _newest(released, poll_ns)
    # Before the first state has come there is nothing to answer to.
    arrived = np.where(basis < 0, NEVER, arrived)
    in_force = _newest(arrived, tick_ns)
    changed = np.diff(in_force, prepend=NO_POLL) != 0
    latency = np.zeros(ticks, dtype=np.int64)
    new = np.flatnonzero(changed)
    latency[new] = new - basis[in_force[new]]
    # A state tells of the last command that took effect at or before its own tick.
    last = np.maximum.accumulate(np.where(latency > 0, np.arange(ticks), -1))
    told = np.where(last >= 0, latency[last], 0)
    shown = np.where(basis >= 0, told[np.maximum(basis, 0)], 0)
    return Timeline(step_ns, poll_ns, poll_ns // step_ns, basis, in_force, latency, shown)


def _newest(available_ns: Ints, asked_ns: Ints) -> Ints:
    """For each time asked, the index of the newest of what is available by then; -1: nothing is."""
    if not len(available_ns):
        return np.full(len(asked_ns), -1, dtype=np.int64)
    order = np.argsort(available_ns, kind="stable")
    newest = np.maximum.accumulate(np.where(available_ns[order] == NEVER, -1, order))
    count = np.searchsorted(available_ns[order], asked_ns, side="right")
    return np.where(count > 0, newest[np.maximum(count - 1, 0)], -1).astype(np.int64)
