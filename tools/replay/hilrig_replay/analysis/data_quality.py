"""Data-quality checks: whether a recording is valid for latency measurements, and the reasons if it is not."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.disk_table import DiskTable
from hilrig_replay.analysis.distribution import Statistics, median
from hilrig_replay.analysis.stages import STAGES
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.run import Losses, Run
from hilrig_sim.arm.model import JOINT_SCALE
from hilrig_sim.arm.stability import ERROR_BOUND

MIN_SAMPLES: Final = 500
"""Required number of samples; with fewer, p99 depends on fewer than five samples."""
NO_CONTROLLER: Final = "no closed loop: no controller wrote commands in this session"
NO_LOOP: Final = "no closed loop: no torque was applied that a controller wrote after it had read a state"
MAX_BACKLOG_NS: Final = 1_000_000_000
"""Maximum variation of the time between the sending of a state and its arrival at the recorder."""
WALL_CLOCK_STEP_NS: Final = 10_000_000
"""Change of wall clock minus monotonic clock between two states that counts as a clock step; slewing changes it by
microseconds."""

_TICK: Final = np.dtype([("lateness_ns", "<i8")])
_WRITE: Final = np.dtype([("cycle_ns", "<i8")])


@dataclass(frozen=True, slots=True)
class Lost:
    """Number of messages that are missing in a recording."""

    transport: int
    """Lost in transport to the recorder."""
    recorder: int
    """Lost in the recorder."""
    file: int = 0
    """Lost in the damaged file."""

    @property
    def total(self) -> int:
        """Sum of all losses."""
        return self.transport + self.recorder + self.file


@dataclass(frozen=True, slots=True)
class Stalls:
    """Ticks that were late by more than one step."""

    count: int = 0
    longest_ns: int = 0
    at_ns: int = 0
    """Time of the longest stall, from the first state of the run."""


def tick_lateness_ns(states: Rows, step_ns: int) -> NDArray[np.int64]:
    """Lateness of each tick against its original deadline, ns, shape (n,).

    After a stall the simulation skips the missed deadlines, and the recorded `lateness_ns` refers to the next deadline.
    """
    return np.asarray(states["lateness_ns"] + states["missed_steps"].astype(np.int64) * step_ns)


class DataQuality:
    """Data-quality checks of a recording, computed block by block."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._ticks, self._writes = DiskTable(_TICK), DiskTable(_WRITE)
        self.stalls = Stalls()
        self._samples = self._negative = self._written = 0
        self._gaps = 0
        self._missed = 0
        self._delay_ns: tuple[int, int] | None = None
        self._clock_steps = 0
        self._inaccurate, self._worst_error = 0, np.zeros(4)
        self._last_state: Rows | None = None
        self._last_command: Rows | None = None
        self._last_write_ns = np.empty(0, np.int64)

    def add(self, states: Rows, commands: Rows, samples: Rows) -> None:
        """Add the next block, fields as `STATE_DTYPE`, `COMMAND_DTYPE` and `SAMPLE_DTYPE`."""
        if len(states):
            self._add_states(states)
        if len(commands):
            self._add_commands(commands)
        self._samples += len(samples)
        self._negative += sum(int((samples[stage] < 0).sum()) for stage in STAGES)

    def _add_commands(self, commands: Rows) -> None:
        self._gaps += _gaps(commands, self._last_command)
        self._last_command = commands[-1:].copy()
        # Internal commands of the edge were not written by a controller.
        written = commands["write_arrived_ns"][~commands["safe"]]
        self._written += len(written)
        write_ns = np.concatenate((self._last_write_ns, written))
        self._writes.add(np.diff(write_ns).view(_WRITE))
        self._last_write_ns = write_ns[-1:].copy()

    def _add_states(self, states: Rows) -> None:
        lateness = tick_lateness_ns(states, self._run.step_ns)
        self._ticks.add(lateness.view(_TICK))
        self._missed += int(states["missed_steps"].sum())
        error = np.abs(states["integration_error"])
        self._inaccurate += int((error > ERROR_BOUND).any(axis=1).sum())
        self._worst_error = np.maximum(self._worst_error, error.max(axis=0))
        self._add_stalls(states, lateness)
        delay = states["log_ns"] - states["wall_ns"]
        low, high = int(delay.min()), int(delay.max())
        if self._delay_ns is not None:
            low, high = min(low, self._delay_ns[0]), max(high, self._delay_ns[1])
        self._delay_ns = (low, high)
        followed = states if self._last_state is None else np.concatenate((self._last_state, states))
        same = np.diff(followed["incarnation"]) == 0
        drift = np.abs(np.diff(followed["wall_ns"] - followed["sampled_ns"]))
        self._clock_steps += int((drift[same] > WALL_CLOCK_STEP_NS).sum())
        self._gaps += _gaps(states, self._last_state)
        self._last_state = states[-1:].copy()

    def _add_stalls(self, states: Rows, lateness: NDArray[np.int64]) -> None:
        stalls, worst = self.stalls, int(np.argmax(lateness))
        count = stalls.count + int((lateness > self._run.step_ns).sum())
        longest_ns, at_ns = stalls.longest_ns, stalls.at_ns
        if lateness[worst] > max(longest_ns, self._run.step_ns):
            longest_ns, at_ns = int(lateness[worst]), int(self._run.time_ns(states[worst : worst + 1])[0])
        self.stalls = Stalls(count, longest_ns, at_ns)

    def lateness(self) -> Statistics:
        """Statistics of the lateness of all ticks."""
        return Statistics.of(self._ticks.column("lateness_ns"))

    def cycle_ns(self) -> float:
        """Median time between two writes of a controller at the edge, ns; 0: fewer than two writes."""
        return median(self._writes.column("cycle_ns")) if len(self._writes) else 0.0

    def lost(self) -> Lost:
        """Lost messages: the recorder's counts or the gaps in the sequence numbers, whichever is larger."""
        counted = self._run.losses or Losses(0, 0)
        uncounted = max(0, self._gaps - counted.transport - counted.recorder)
        if self._run.damaged:
            return Lost(counted.transport, counted.recorder, max(counted.file, uncounted))
        return Lost(counted.transport + uncounted, counted.recorder)

    def reasons(self, unmatched: int) -> Iterator[str]:
        """Reasons why the recording is not valid for latency measurements; empty if it is valid.

        Args:
            unmatched: number of samples whose command is not in the recording.
        """
        run, lost = self._run, self.lost()
        overruns = max(self.stalls.count, run.number("summary", "overruns") or 0)
        clock_steps = max(self._clock_steps, run.number("summary", "clock_steps") or 0)
        if lost.transport:
            yield f"{_count(lost.transport, 'message')} lost in transport to the recorder"
        if lost.recorder:
            yield f"{_count(lost.recorder, 'message')} lost in the recorder"
        if lost.file:
            yield f"{_count(lost.file, 'message')} lost in the damaged file"
        if run.losses is None:
            yield "unknown number of lost messages: the recording was not closed properly"
        if overruns:
            steps = f"{_count(self._missed, 'step')} missed, at most {self.stalls.longest_ns / 1e6:.0f} ms late"
            yield f"{_count(overruns, 'overrun')} of the simulation, {steps}"
        if self._inaccurate:
            joint = int(np.argmax(self._worst_error / ERROR_BOUND))
            error = f"{self._worst_error[joint] * JOINT_SCALE[joint]:.3g} {'mm' if joint == 2 else '°'}"
            yield f"{_count(self._inaccurate, 'inaccurate step')} of the simulation, estimated error up to {error}"
        if self._delay_ns is not None and self._delay_ns[1] - self._delay_ns[0] > MAX_BACKLOG_NS:
            backlog_s = (self._delay_ns[1] - self._delay_ns[0]) / 1e9
            yield f"the recorder lagged by up to {backlog_s:.1f} s"
        if clock_steps:
            yield f"{_count(clock_steps, 'step')} of the wall clock during the run"
        if unmatched:
            yield f"the commands of {_count(unmatched, 'sample')} are not in the recording"
        if self._negative:
            yield f"{_count(self._negative, 'negative stage duration')}: the timestamps contradict each other"
        if not self._samples and not unmatched:
            yield NO_LOOP if self._written else NO_CONTROLLER
        elif self._samples < MIN_SAMPLES:
            yield f"only {_count(self._samples, 'sample')}: {MIN_SAMPLES} are required for a 99th percentile"


def _gaps(rows: Rows, last: Rows | None) -> int:
    """Number of messages missing in the sequence numbers; a restart of the numbering is a restart of the sender."""
    sequence = (rows if last is None else np.concatenate((last, rows)))["sequence"].astype(np.int64)
    steps = np.diff(sequence)
    return int((steps[steps > 1] - 1).sum())


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
