"""Loop latency out of a recording: samples with their six stages, their statistics, whether they can be trusted.

A sample is a state at which a new command took effect. Its loop latency is t_k − t_b on the simulation's clock, b the
state that the controller had last been served. Five stages are differences of two stamps of one clock; transport,
both ways over the bus, is what remains. So the six add up exactly, and no clocks are compared (docs/timing.md).
"""

import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.columns import COMMAND, STATE, Rows
from hilrig_replay.diagnosis import Evidence, Finding, diagnose
from hilrig_replay.fitness import FitnessWatch, Lost
from hilrig_replay.records import Records
from hilrig_replay.run import Run
from hilrig_runtime.errors import InputError

STAGES: Final = ("register_wait", "controller", "edge", "injected", "tick_wait", "transport")
"""In the order in which a state's news goes round, `transport` last because it is the remainder."""

SAMPLE: Final = np.dtype(
    [
        ("step", "<u8"),
        ("incarnation", "<u8"),
        ("sampled_ns", "<i8"),
        ("wall_ns", "<i8"),
        ("basis_step", "<u8"),
        ("command_seq", "<u8"),
        ("loop", "<i8"),
        *((stage, "<i8") for stage in STAGES),
        ("write_arrived_ns", "<i8"),
        ("state_served_ns", "<i8"),
    ]
)
"""One row a sample: `loop` and the stages in ns, `sampled_ns` on the simulation's clock, the two last on the edge's."""


@dataclass(frozen=True, slots=True)
class Statistics:
    """How a quantity is distributed; ms. Percentiles are interpolated between samples."""

    p50: float
    p95: float
    p99: float
    p999: float
    max: float
    mean: float
    std: float

    @classmethod
    def of(cls, values_ns: NDArray[np.int64]) -> "Statistics":
        """Statistics of an array of ns, shape (n,), n at least 1."""
        p50, p95, p99, p999 = np.percentile(values_ns, (50, 95, 99, 99.9)) / 1e6
        return cls(
            p50=float(p50),
            p95=float(p95),
            p99=float(p99),
            p999=float(p999),
            max=float(values_ns.max() / 1e6),
            mean=float(values_ns.mean() / 1e6),
            std=float(values_ns.std() / 1e6),
        )


@dataclass(frozen=True, slots=True)
class Jitter:
    """How far the loop strays; ms."""

    loop_std: float
    loop_p99_p1: float
    """From the 1st to the 99th percentile of the loop latency."""
    tick_lateness: Statistics
    """Of the simulation's ticks behind their deadlines."""


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """What `hilrig latency` says of one run."""

    session: str
    rig: str
    controller: str
    samples: int
    step_ms: float
    loop_ms: Statistics | None
    """None: there are no samples."""
    stages_ms: dict[str, Statistics]
    jitter_ms: Jitter
    lost: Lost
    fit: bool
    """Whether the recording supports claims about latency."""
    reasons: tuple[str, ...]
    """Why it is not fit; empty: it is."""
    findings: tuple[Finding, ...]
    """Why the loop took what it took, in words."""
    table: NDArray[np.void] = field(repr=False, compare=False)
    """The samples themselves, shape (samples,), fields as `SAMPLE`."""

    def as_dict(self) -> dict[str, Any]:
        """As plain values, for JSON: everything but the samples themselves."""
        plain = asdict(replace(self, table=self.table[:0]))
        del plain["table"]
        return plain


class Matcher:
    """Finds the command behind each sample, from blocks in which the one can come before or after the other."""

    WINDOW: Final = 4096
    """At least so many rows before a block are still looked at."""

    def __init__(self) -> None:
        self._commands = np.empty(0, COMMAND)
        self._waiting = np.empty(0, STATE)
        self._given_up = 0

    @property
    def unmatched(self) -> int:
        """Samples whose command has not come, count."""
        return self._given_up + len(self._waiting)

    def add(self, states: Rows, commands: Rows) -> NDArray[np.void]:
        """Take in the next block, fields as `columns.STATE` and `columns.COMMAND`; the samples found with it."""
        effective = np.concatenate((self._waiting, states[states["basis_step"] != 0]))
        known = np.concatenate((self._commands, commands))
        rows, found = join_commands(effective, known)
        if len(known):
            found &= known["basis_step"][rows] == effective["basis_step"]
        missing = effective[~found]
        self._waiting = missing[-self.WINDOW :]
        self._given_up += len(missing) - len(self._waiting)
        self._commands = known[-max(self.WINDOW, len(commands)) :].copy()
        return _stages(effective[found], known[rows[found]])


class SampleTable:
    """Samples as they are found, in one array: a long run's are never held twice.

    The array is made as long as it can get. What is not written of it takes no memory, and pieces that are joined at
    the end would, for what they are made of is not given back before. A very long run's is a file without a name, of
    which the system keeps in memory what there is room for.
    """

    LARGE: Final = 500_000
    """Samples from which on they are kept in a file, count: nearly three hours at a step of 20 ms."""

    def __init__(self, most: int) -> None:
        """For up to `most` samples; should there be more, it grows."""
        self._rows = _in_file(most) if most >= self.LARGE else np.empty(most, SAMPLE)
        self._end = 0

    def add(self, samples: NDArray[np.void]) -> None:
        """Take in some more, fields as `SAMPLE`."""
        begin, self._end = self._end, self._end + len(samples)
        if self._end > len(self._rows):
            self._rows = np.concatenate((self._rows[:begin], np.empty(self._end, SAMPLE)))
        self._rows[begin : self._end] = samples

    def in_order(self) -> NDArray[np.void]:
        """All of them in the order of their states, shape (n,), fields as `SAMPLE`."""
        samples = self._rows[: self._end]
        same = np.diff(samples["incarnation"]) == 0
        if (same & (np.diff(samples["sampled_ns"]) >= 0)).all():
            return samples
        return samples[np.lexsort((samples["sampled_ns"], samples["incarnation"]))]


def _in_file(rows: int) -> NDArray[np.void]:
    try:
        with tempfile.TemporaryFile() as file:
            # Reserved, for a disk that is found full later would end the process.
            os.posix_fallocate(file.fileno(), 0, rows * SAMPLE.itemsize)
            return np.asarray(np.memmap(file, SAMPLE, "r+", shape=(rows,)))
    except (OSError, AttributeError):
        # No room on the disk, or a system that can't reserve it.
        return np.empty(rows, SAMPLE)


def match(states: Rows, commands: Rows) -> NDArray[np.void]:
    """The samples of a whole run, shape (n,), fields as `SAMPLE`."""
    table = SampleTable(len(states))
    table.add(Matcher().add(states, commands))
    return table.in_order()


def join_commands(states: Rows, commands: Rows) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The command in force at each state, by (session, seq): its row, and whether it is there; shapes (states,)."""
    if not len(commands):
        return np.zeros(len(states), np.intp), np.zeros(len(states), np.bool_)
    # A code has 16 bits, a sequence number far fewer than 48.
    keys = (commands["session"].astype(np.uint64) << np.uint64(48)) | commands["seq"]
    wanted = (states["session"].astype(np.uint64) << np.uint64(48)) | states["command_seq"]
    order = np.argsort(keys, kind="stable")
    rows = order[np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)]
    return rows, keys[rows] == wanted


def _stages(states: Rows, commands: Rows) -> NDArray[np.void]:
    """Samples of states and their commands, row by row; the table of docs/timing.md."""
    samples = np.empty(len(states), SAMPLE)
    for name in ("step", "incarnation", "sampled_ns", "wall_ns", "basis_step", "command_seq"):
        samples[name] = states[name]
    for name in ("write_arrived_ns", "state_served_ns"):
        samples[name] = commands[name]
    served, written = commands["state_served_ns"], commands["write_arrived_ns"]
    state_injected, command_injected = commands["state_injected_ns"], commands["command_injected_ns"]
    samples["loop"] = states["loop_latency_ns"]
    samples["register_wait"] = served - commands["state_arrived_ns"] - state_injected
    samples["controller"] = written - served
    samples["edge"] = commands["sent_ns"] - written - command_injected
    samples["injected"] = state_injected + command_injected
    samples["tick_wait"] = states["sampled_ns"] - states["command_arrived_ns"]
    samples["transport"] = samples["loop"] - sum(samples[stage] for stage in STAGES[:-1])
    return samples


def measure(run: Run, also: Callable[[Records], None] | None = None) -> LatencyReport:
    """Go through a run once, a block at a time: its samples, their statistics and the judgement.

    Args:
        run: the recording.
        also: gets each block on the way, with states, commands, parts and events, so that one pass serves several.

    Raises:
        InputError: nothing was commanded in it, or the file is damaged.
    """
    if not run.file.counts["command"]:
        raise InputError(
            f"{run.path}: a recording without commands: no controller wrote in this session, so it has no loop latency"
        )
    matcher = Matcher()
    table = SampleTable(run.file.counts["state"])
    watch = FitnessWatch(run)
    for block in run.blocks(frozenset({"state", "command", "event"})):
        if also is not None:
            also(block)
        table.add(matcher.add(block.states, block.commands))
        watch.add(block.states, block.commands)
    samples = table.in_order()
    evidence = Evidence(
        run=run,
        samples=samples,
        step_ns=run.step_ns,
        lateness_ns=watch.lateness_ns(),
        stalls=tuple(watch.stalls),
        write_ns=watch.write_ns(),
    )
    reasons = tuple(watch.reasons(samples, STAGES, matcher.unmatched))
    loop = Statistics.of(samples["loop"]) if len(samples) else None
    low, high = np.percentile(samples["loop"], (1, 99)) if len(samples) else (0.0, 0.0)
    return LatencyReport(
        session=run.session,
        rig=run.rig,
        controller=run.controller,
        samples=len(samples),
        step_ms=run.step_ns / 1e6,
        loop_ms=loop,
        stages_ms={stage: Statistics.of(samples[stage]) for stage in STAGES} if len(samples) else {},
        jitter_ms=Jitter(loop.std if loop else 0.0, float(high - low) / 1e6, Statistics.of(evidence.lateness_ns)),
        lost=watch.lost(),
        fit=not reasons,
        reasons=reasons,
        findings=tuple(diagnose(evidence)),
        table=samples,
    )
