"""Loop latency out of a recording: samples with their six stages, their statistics, whether they can be trusted.

A sample is a state at which a new command took effect. Its loop latency is t_k − t_b on the simulation's clock, b the
state that the controller had last been served. Five stages are differences of two stamps of one clock; transport,
both ways over the bus, is what remains. So the six add up exactly, and no clocks are compared (docs/timing.md).
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from hilrig_replay.analysis.data_quality import FitnessWatch, Lost
from hilrig_replay.analysis.diagnosis import Evidence, Finding, diagnose
from hilrig_replay.analysis.distribution import Statistics, percentiles
from hilrig_replay.analysis.samples import STAGES, Matcher, SampleTable
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run


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
    """None: nothing closed a loop; the reasons say so."""
    stages_ms: dict[str, Statistics]
    jitter_ms: Jitter
    lost: Lost
    fit: bool
    """Whether the recording supports claims about latency."""
    reasons: tuple[str, ...]
    """Why it is not fit; empty: it is."""
    findings: tuple[Finding, ...]
    """Why the loop took what it took, in words."""
    table: SampleTable = field(repr=False, compare=False)
    """The samples themselves, fields as `samples.SAMPLE`: a column is `table["loop"]`, shape (samples,)."""

    def without_table(self) -> "LatencyReport":
        """The same without the samples, for who keeps many reports."""
        return replace(self, table=SampleTable())

    def as_dict(self) -> dict[str, Any]:
        """As plain values, for JSON: everything but the samples themselves."""
        plain = asdict(self.without_table())
        del plain["table"]
        return plain


def measure(run: Run, also: Callable[[Records], None] | None = None) -> LatencyReport:
    """Go through a run once, a block at a time: its samples, their statistics and the judgement.

    Args:
        run: the recording.
        also: gets each block on the way, with states, commands, parts and events, so that one pass serves several.

    Raises:
        InputError: the file is damaged.
    """
    matcher, table, watch = Matcher(), SampleTable(), FitnessWatch(run)
    for block in run.blocks(frozenset({"state", "command", "event"})):
        if also is not None:
            also(block)
        samples = matcher.add(block.states, block.commands)
        table.add(samples)
        watch.add(block.states, block.commands, samples)
    table.end()
    reasons = tuple(watch.reasons(matcher.unmatched))
    loop, stages, spread = None, {}, 0.0
    if len(table):
        loop = Statistics.of(table.column("loop"))
        stages = {stage: Statistics.of(table.column(stage)) for stage in STAGES}
        low, high = percentiles(table.column("loop"), (1, 99)) / 1e6
        spread = float(high - low)
    evidence = Evidence(
        run=run,
        samples=table,
        loop_ms=loop,
        stages_ms=stages,
        step_ns=run.step_ns,
        stalls=watch.stalls,
        cycle_ns=watch.cycle_ns(),
    )
    return LatencyReport(
        session=run.session,
        rig=run.rig,
        controller=run.controller,
        samples=len(table),
        step_ms=run.step_ns / 1e6,
        loop_ms=loop,
        stages_ms=stages,
        jitter_ms=Jitter(loop.std if loop else 0.0, spread, watch.lateness()),
        lost=watch.lost(),
        fit=not reasons,
        reasons=reasons,
        findings=tuple(diagnose(evidence)),
        table=table,
    )
