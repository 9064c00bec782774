"""Loop latency of a recording: samples with their stages, statistics, data quality and diagnosis.

A sample is a state at which a new command took effect. Its loop latency is t_k − t_b on the clock of the simulation,
where b is the last state that was served to the controller. Each stage except `transport` is a difference of two
timestamps of one clock; `transport`, the time on the bus in both directions, is the remainder. The stages therefore add
up exactly, and timestamps of different clocks are never compared (docs/timing.md).
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from hilrig_replay.analysis.data_quality import DataQuality, Lost
from hilrig_replay.analysis.diagnosis import Evidence, Finding, diagnose
from hilrig_replay.analysis.distribution import Statistics, percentiles
from hilrig_replay.analysis.samples import CommandMatcher, SampleTable
from hilrig_replay.analysis.stages import STAGES
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run


@dataclass(frozen=True, slots=True)
class Jitter:
    """Variation of the loop latency, and lateness of the simulation's ticks; ms."""

    loop_std: float
    loop_p99_p1: float
    """99th minus 1st percentile of the loop latency."""
    tick_lateness: Statistics
    """Lateness of the simulation's ticks against their deadlines."""


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """Result of a latency measurement of one run, as `hilrig latency` reports it."""

    session: str
    rig: str
    controller: str
    samples: int
    step_ms: float
    loop_ms: Statistics | None
    """None: no closed loop (see `reasons`)."""
    stages_ms: dict[str, Statistics]
    jitter_ms: Jitter
    lost: Lost
    fit: bool
    """Whether the recording is valid for latency measurements."""
    reasons: tuple[str, ...]
    """Reasons why it is not valid; empty: it is valid."""
    findings: tuple[Finding, ...]
    """Probable causes of the latency."""
    table: SampleTable = field(repr=False, compare=False)
    """The samples, fields as `samples.SAMPLE_DTYPE`; `table["loop"]` is a column, shape (samples,)."""

    def without_table(self) -> "LatencyReport":
        """Copy without the samples, to save memory when many reports are kept."""
        return replace(self, table=SampleTable())

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, without the samples."""
        plain = asdict(self.without_table())
        del plain["table"]
        return plain


def measure(run: Run, on_block: Callable[[Records], None] | None = None) -> LatencyReport:
    """Measure the loop latency of a run in one pass, block by block.

    Args:
        run: the recording.
        on_block: called with each block (states, commands, parts, events), so that one pass serves several evaluations.

    Raises:
        InputError: the file is damaged.
    """
    matcher, table, quality = CommandMatcher(), SampleTable(), DataQuality(run)
    for block in run.blocks(frozenset({"state", "command", "event"})):
        if on_block is not None:
            on_block(block)
        samples = matcher.add(block.states, block.commands)
        table.add(samples)
        quality.add(block.states, block.commands, samples)
    table.finish()
    reasons = tuple(quality.reasons(matcher.unmatched))
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
        stalls=quality.stalls,
        cycle_ns=quality.cycle_ns(),
    )
    return LatencyReport(
        session=run.session,
        rig=run.rig,
        controller=run.controller,
        samples=len(table),
        step_ms=run.step_ns / 1e6,
        loop_ms=loop,
        stages_ms=stages,
        jitter_ms=Jitter(loop.std if loop else 0.0, spread, quality.lateness()),
        lost=quality.lost(),
        fit=not reasons,
        reasons=reasons,
        findings=tuple(diagnose(evidence)),
        table=table,
    )
