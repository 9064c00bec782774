"""Values that the rules of the diagnosis evaluate, and the findings that they return.

A rule is a total function of rows: it accepts empty windows, commands without a basis and a single row.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.age import LoopAge
from hilrig_replay.analysis.data_quality import Stalls
from hilrig_replay.analysis.feedback import MAX_POLLS, RoundingGains
from hilrig_replay.analysis.samples import SAMPLE_DTYPE
from hilrig_replay.analysis.stages import TICK_WAIT
from hilrig_replay.io.columns import Rows, written
from hilrig_replay.io.disk_table import DiskTable
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run
from hilrig_runtime.config.task import PoseConfig
from hilrig_sim.arm.model import ArmParameters

MS: Final = 1e6
WINDOW_S: Final = 10.0
MAX_WINDOWS: Final = 6
"""Maximum number of windows, evenly spread over a run, whose messages are examined."""
PROGRAM_NS: Final = 1_000_000
"""Time between reading and writing that is no cause: a request of a small program on the same host."""
NO_PAUSE_NS: Final = 3 * MS
"""Time between a write and the next request of a program that does not wait there."""

NO_STALLS: Final = Stalls()
DEFAULT_ARM: Final = ArmParameters()
NO_GAINS: Final = RoundingGains(np.zeros((4, MAX_POLLS + 1)), np.zeros((4, MAX_POLLS + 1)), np.zeros(MAX_POLLS + 1))

Floats = NDArray[np.float64]

CYCLE_DTYPE: Final = np.dtype([("held_ns", "<f8"), ("pause_ns", "<f8"), ("cycle_ns", "<f8")])
"""One row per control cycle. `held_ns`: from the last read to the write that answers it; `pause_ns`: from that write to
the next read; `cycle_ns`: from that write to the next one."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A probable cause of the age, or an observation of the motion."""

    list: Literal["timing", "control"]
    """The list that it belongs to."""
    code: str
    """Machine-readable: a word that does not change."""
    text: str
    """Human-readable, with the measured values."""
    remedy: str
    """What to change."""
    gain_ms: float | None
    """Expected reduction of the mean age, ms; None: not expressed as an age."""
    evidence: dict[str, float]
    """Measured values behind the text, by name with unit. `share`: share of the age that a timing cause explains."""

    def sentence(self) -> str:
        """Text, remedy and expected gain."""
        text = f"{self.text}. Remedy: {self.remedy}."
        return text if self.gain_ms is None else f"{text} Expected gain: {_round(self.gain_ms)} ms"


@dataclass(frozen=True, slots=True)
class Evidence:
    """Measured values of a run that the rules evaluate; times in ns."""

    step_ns: int
    samples: DiskTable
    """Samples in the order of their states, fields as `SAMPLE_DTYPE`."""
    windows: Sequence[Records]
    """Messages of windows that are evenly spread over the run."""
    duration_s: float
    client_role: bool = False
    """Whether the edge was the client of the controller."""
    other_connection: bool = False
    """Whether positions are read on another connection than torques are written."""
    age: LoopAge | None = None
    """None: no command that is based on a state took effect."""
    stalls: Stalls = NO_STALLS
    """Ticks that were late by more than one step."""
    edge_stalls: Stalls = NO_STALLS
    """Stalls of the edge, reported by it or found in the request log."""
    watchdog_gaps: int = 0
    """Trips of the watchdog after which the controller wrote again."""
    gains: RoundingGains = NO_GAINS
    """Gains with which the torques contain the rounding errors of the positions."""
    bases: int = 0
    """Number of different states that the samples are based on."""
    open_loop: bool = False
    """Whether the torques do not follow the positions that were read on another connection."""
    min_rtt_ns: float = 0.0
    """Smallest round-trip time that TCP measured on a connection that wrote; 0: not recorded."""
    arm: ArmParameters = DEFAULT_ARM
    poses: tuple[PoseConfig, ...] = ()
    """Poses of the run's task."""

    @property
    def mean_age_ns(self) -> float:
        """Mean age; 0: none."""
        return 0.0 if self.age is None else self.age.age_ms.mean * MS

    @property
    def hidden_age_ns(self) -> float:
        """Mean age that the timestamps do not show, of torques that act on an earlier poll."""
        behind = self.gains.polls_behind
        return float(self.gains.older_steps[behind]) * self.step_ns if behind else 0.0

    def cycles(self) -> Rows:
        """Cycles of the controller in the windows, fields as `CYCLE_DTYPE`."""
        found = [_cycles(window.commands) for window in self.windows]
        return np.concatenate([np.empty(0, CYCLE_DTYPE), *found])

    def saved_ns(self, earlier: Callable[[Rows], Floats]) -> float:
        """Mean reduction of the loop latency if each command arrived earlier by a time, ns.

        A command acts from the first tick after its arrival, at least one step after its basis.

        Args:
            earlier: time for rows with the fields of `SAMPLE_DTYPE`, ns, shape (n,).
        """
        saved, count = 0.0, 0
        for rows in self.samples.blocks(*(SAMPLE_DTYPE.names or ())):
            steps = np.floor((rows[TICK_WAIT.key] + np.maximum(earlier(rows), 0.0)) / self.step_ns)
            # A tick wait of more than a step is a stall of the simulation.
            steps -= np.maximum(np.floor(rows[TICK_WAIT.key] / self.step_ns), 0)
            most = np.maximum(np.rint(rows["loop"] / self.step_ns) - 1, 0)
            saved += float(np.clip(steps, 0, most).sum()) * self.step_ns
            count += len(rows)
        return saved / count if count else 0.0


def windows_of(run: Run) -> list[Records]:
    """Messages of up to `MAX_WINDOWS` windows, evenly spread over a run."""
    duration = run.duration_s
    count = min(MAX_WINDOWS, max(1, round(duration / WINDOW_S)))
    starts = np.linspace(0, max(duration - WINDOW_S, 0), count)
    return [run.between(float(start), float(start) + WINDOW_S) for start in starts]


def _cycles(commands: Rows) -> Rows:
    last = _answers(written(commands))
    cycles = np.empty(max(len(last) - 1, 0), CYCLE_DTYPE)
    if not len(cycles):
        return cycles
    served_ns: NDArray[np.int64] = last["state_served_ns"]
    received_ns: NDArray[np.int64] = last["write_received_ns"]
    arrived_ns: NDArray[np.int64] = last["write_arrived_ns"]
    cycles["held_ns"] = (received_ns - served_ns)[1:]
    cycles["pause_ns"] = served_ns[1:] - arrived_ns[:-1]
    cycles["cycle_ns"] = np.diff(arrived_ns)
    same = last["session"][1:] == last["session"][:-1]
    return np.asarray(cycles[same & (cycles["cycle_ns"] > 0) & (cycles["held_ns"] >= 0)])


def _answers(commands: Rows) -> Rows:
    """The write that answers each read: of several ones at once, such as one a register, the last.

    A later write without another read repeats or updates the torques.
    """
    if not len(commands):
        return commands
    served_ns: NDArray[np.int64] = commands["state_served_ns"]
    received_ns: NDArray[np.int64] = commands["write_received_ns"]
    arrived_ns: NDArray[np.int64] = commands["write_arrived_ns"]
    first = np.diff(served_ns, prepend=served_ns[:1] - 1) != 0
    begin = np.flatnonzero(first)[np.cumsum(first) - 1]
    answered_ns = (received_ns - served_ns)[begin]
    apart_ns = np.diff(arrived_ns, prepend=arrived_ns[:1])
    later = ~first & (apart_ns > answered_ns + NO_PAUSE_NS)
    # All writes of a read from the first later one on.
    count = np.cumsum(later)
    at_once = commands[count == count[begin]]
    return np.asarray(at_once[np.append(np.diff(at_once["state_served_ns"]) != 0, True)])


def controlled(evidence: Evidence) -> list[Rows]:
    """States of consecutive steps on which a command of a controller acts, one array per stretch and window.

    Zero torques before the first and after the last other one are not of the control.
    """
    found = []
    for states in (window.states for window in evidence.windows):
        commanded, safe, in_session = states["command_seq"] > 0, states["safe"], states["session"] != 0
        acts = commanded & ~safe & in_session
        used = np.flatnonzero(acts & (states["effort"] != 0).any(axis=1))
        if not len(used):
            continue
        begin, end = used[0], used[-1] + 1
        rows = states[begin:end][acts[begin:end]]
        apart = np.flatnonzero((np.diff(rows["step"].astype(np.int64)) != 1) | (np.diff(rows["incarnation"]) != 0)) + 1
        found += [stretch for stretch in np.split(rows, apart) if len(stretch) > 1]
    return found


def _round(value_ms: float) -> str:
    return f"{value_ms:.0f}" if value_ms >= 10 else f"{value_ms:.1f}"


def sections(findings: Sequence[Finding]) -> list[tuple[str, list[str]]]:
    """Title and sentences of both lists; a list without findings says so."""
    timing, control = ([one.sentence() for one in findings if one.list == name] for name in ("timing", "control"))
    return [("Timing causes", timing or ["no cause found"]), ("Control observations", control or ["none"])]
