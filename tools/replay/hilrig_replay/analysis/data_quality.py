"""Whether a recording supports claims about latency; otherwise why not, in words."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.disk_table import Spool
from hilrig_replay.analysis.distribution import Statistics, median
from hilrig_replay.analysis.samples import STAGES
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.run import Losses, Run

ENOUGH_SAMPLES: Final = 500
"""Below, p99 rests on fewer than five samples."""
NO_CONTROLLER: Final = "nothing closed a loop, for no controller wrote in this session"
NO_LOOP: Final = "nothing closed a loop, for no torque acted that a controller wrote after it had read"
BACKLOG_NS: Final = 1_000_000_000
"""A recording whose messages waited longer than this to be taken in is not trusted."""
CLOCK_STEP_NS: Final = 10_000_000
"""Wall clock against monotonic clock from one state to the next: slewing moves it by microseconds."""

_TICK: Final = np.dtype([("behind_ns", "<i8")])
_WRITE: Final = np.dtype([("cycle_ns", "<i8")])


@dataclass(frozen=True, slots=True)
class Lost:
    """Messages that are missing in a recording, count."""

    transport: int
    """On the way to the recorder."""
    recorder: int
    """In the recorder."""
    file: int = 0
    """In the file, which was damaged."""

    @property
    def total(self) -> int:
        """All of them."""
        return self.transport + self.recorder + self.file


@dataclass(frozen=True, slots=True)
class Stalls:
    """Ticks that were late by more than a step."""

    count: int = 0
    longest_ns: int = 0
    at_ns: int = 0
    """When the longest was, time in the run."""


def behind_ns(states: Rows, step_ns: int) -> NDArray[np.int64]:
    """How late each tick was for the deadline that it was meant for, shape (n,), ns.

    After a stall the loop gives up the deadlines that are over, and `lateness_ns` is against the one it took up again.
    """
    return np.asarray(states["lateness_ns"] + states["missed_steps"].astype(np.int64) * step_ns)


class FitnessWatch:
    """What speaks against a recording, collected block by block."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._ticks, self._writes = Spool(_TICK), Spool(_WRITE)
        self.stalls = Stalls()
        self._samples = self._negative = self._written = 0
        self._gaps = 0
        self._missed = 0
        self._delay_ns: tuple[int, int] | None = None
        self._clock_steps = 0
        self._last_state: Rows | None = None
        self._last_command: Rows | None = None
        self._last_write_ns = np.empty(0, np.int64)

    def add(self, states: Rows, commands: Rows, samples: Rows) -> None:
        """Take in the next block, fields as `columns.STATE`, `columns.COMMAND` and `samples.SAMPLE`."""
        if len(states):
            self._add_states(states)
        if len(commands):
            self._add_commands(commands)
        self._samples += len(samples)
        self._negative += sum(int((samples[stage] < 0).sum()) for stage in STAGES)

    def _add_commands(self, commands: Rows) -> None:
        self._gaps += _gaps(commands, self._last_command)
        self._last_command = commands[-1:].copy()
        # What the edge says of itself was written by nobody.
        written = commands["write_arrived_ns"][~commands["safe"]]
        self._written += len(written)
        write_ns = np.concatenate((self._last_write_ns, written))
        self._writes.add(np.diff(write_ns).view(_WRITE))
        self._last_write_ns = write_ns[-1:].copy()

    def _add_states(self, states: Rows) -> None:
        behind = behind_ns(states, self._run.step_ns)
        self._ticks.add(behind.view(_TICK))
        self._missed += int(states["missed_steps"].sum())
        self._add_stalls(states, behind)
        delay = states["log_ns"] - states["wall_ns"]
        low, high = int(delay.min()), int(delay.max())
        if self._delay_ns is not None:
            low, high = min(low, self._delay_ns[0]), max(high, self._delay_ns[1])
        self._delay_ns = (low, high)
        followed = states if self._last_state is None else np.concatenate((self._last_state, states))
        same = np.diff(followed["incarnation"]) == 0
        drift = np.abs(np.diff(followed["wall_ns"] - followed["sampled_ns"]))
        self._clock_steps += int((drift[same] > CLOCK_STEP_NS).sum())
        self._gaps += _gaps(states, self._last_state)
        self._last_state = states[-1:].copy()

    def _add_stalls(self, states: Rows, behind: NDArray[np.int64]) -> None:
        stalls, worst = self.stalls, int(np.argmax(behind))
        count = stalls.count + int((behind > self._run.step_ns).sum())
        longest_ns, at_ns = stalls.longest_ns, stalls.at_ns
        if behind[worst] > max(longest_ns, self._run.step_ns):
            longest_ns, at_ns = int(behind[worst]), int(self._run.time_ns(states[worst : worst + 1])[0])
        self.stalls = Stalls(count, longest_ns, at_ns)

    def lateness(self) -> Statistics:
        """Of every tick behind its deadline."""
        return Statistics.of(self._ticks.column("behind_ns"))

    def cycle_ns(self) -> float:
        """From one write of a controller to the next at the edge, median, ns; 0: there are not two."""
        return median(self._writes.column("cycle_ns")) if len(self._writes) else 0.0

    def lost(self) -> Lost:
        """What is missing: as the recorder counted, or as the senders' numbers show, whichever is more."""
        said = self._run.losses or Losses(0, 0)
        untold = max(0, self._gaps - said.transport - said.recorder)
        if self._run.damaged:
            return Lost(said.transport, said.recorder, max(said.file, untold))
        return Lost(said.transport + untold, said.recorder)

    def reasons(self, unmatched: int) -> Iterator[str]:
        """Why the recording is not fit, once all of it was taken in, `unmatched` samples apart; none: it is."""
        run, lost = self._run, self.lost()
        overruns = max(self.stalls.count, run.number("summary", "overruns") or 0)
        clock_steps = max(self._clock_steps, run.number("summary", "clock_steps") or 0)
        if lost.transport:
            yield f"{_count(lost.transport, 'message')} lost on the way to the recorder"
        if lost.recorder:
            yield f"{_count(lost.recorder, 'message')} lost in the recorder"
        if lost.file:
            yield f"{_count(lost.file, 'message')} lost in the file, which was damaged"
        if run.losses is None:
            yield "the recording does not say whether something was lost (it did not end in order)"
        if overruns:
            steps = f"{_count(self._missed, 'step')} missed, at most {self.stalls.longest_ns / 1e6:.0f} ms late"
            yield f"{_count(overruns, 'overrun')} of the simulation, {steps}"
        if self._delay_ns is not None and self._delay_ns[1] - self._delay_ns[0] > BACKLOG_NS:
            behind = (self._delay_ns[1] - self._delay_ns[0]) / 1e9
            yield f"the recorder was behind by up to {behind:.1f} s"
        if clock_steps:
            yield f"the wall clock was set {clock_steps} times during the run"
        if unmatched:
            yield f"the commands of {_count(unmatched, 'sample')} are not in the recording"
        if self._negative:
            yield f"{_count(self._negative, 'stage')} came out negative: the stamps contradict each other"
        if not self._samples and not unmatched:
            yield NO_LOOP if self._written else NO_CONTROLLER
        elif self._samples < ENOUGH_SAMPLES:
            yield f"{_count(self._samples, 'sample')} only: {ENOUGH_SAMPLES} are needed for a 99th percentile"


def _gaps(rows: Rows, last: Rows | None) -> int:
    """Messages missing within one sender's numbers; where they begin anew, its process did."""
    sequence = (rows if last is None else np.concatenate((last, rows)))["sequence"].astype(np.int64)
    steps = np.diff(sequence)
    return int((steps[steps > 1] - 1).sum())


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
