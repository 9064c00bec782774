"""Loop latency and age of a recording: samples with their stages, statistics, data quality and diagnosis.

A sample is a state at which a new command took effect. Its loop latency is t_k − t_b on the clock of the simulation,
where b is the last state that was served to the controller. Each stage except `transport` is a difference of two
timestamps of one clock; `transport`, the time on the bus in both directions, is the remainder. The stages therefore add
up exactly, and timestamps of different clocks are never compared (docs/timing.md).

A sample is only as good as its basis. A command of a connection that did not read itself is based on the state that
another connection of the same controller was served. Its latency is measured only if the torques follow the positions.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from hilrig_replay.analysis.age import AgeTable
from hilrig_replay.analysis.client_role.device_scan import DeviceScan, device_scan
from hilrig_replay.analysis.client_role.older_positions import OlderPositions, older_positions
from hilrig_replay.analysis.data_quality import NO_ECHO, NO_SAMPLES, OPEN_LOOP, DataQuality, Lost, Reason
from hilrig_replay.analysis.diagnosis.diagnose import diagnose
from hilrig_replay.analysis.diagnosis.edge_stalls import edge_stalls
from hilrig_replay.analysis.diagnosis.evidence import Evidence, Finding, windows_of
from hilrig_replay.analysis.distribution import Statistics, percentiles
from hilrig_replay.analysis.feedback import follows_positions, rounding_gains
from hilrig_replay.analysis.intervals import Interval, percentile_intervals
from hilrig_replay.analysis.network import NetworkShare, network_share
from hilrig_replay.analysis.samples import CommandMatcher, SampleTable
from hilrig_replay.analysis.stages import CONTROLLER, Stage, stages_of_role
from hilrig_replay.geometry.scene import parameters_of
from hilrig_replay.io.disk_table import Blocks
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run
from hilrig_replay.io.sequence_order import Repairs
from hilrig_runtime.config.task import TaskConfig
from hilrig_sim.arm.model import ArmParameters


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
    client_role: bool
    """Whether the edge was the client of the controller."""
    stages_ms: dict[str, Statistics]
    """By the key of each of `stages`."""
    intervals_ms: dict[str, dict[str, Interval]]
    """95 % confidence intervals of the percentiles of `loop`, each stage and `age`, by percentile (`intervals.SHARES`);
    an infinite bound is not supported by the samples."""
    age_ms: Statistics | None
    """Age of the loop at each step; None: no command that is based on a state took effect."""
    control_period_ms: float | None
    """Mean time from a command's effect to that of the next command."""
    longest_hold_ms: float | None
    """Longest time that one command acted."""
    uncontrolled_share: float | None
    """Share of the steps without an age, 0 to 1."""
    older_than_steps: dict[str, float]
    """Share of the steps whose age exceeds a number of steps, by this number."""
    read_on_other_connection: bool
    """Whether positions were read on another connection than torques were written."""
    kernel_timestamps: bool
    """Whether the kernel's timestamps separate *controller* from *edge*; else *controller* includes the wake-up of the
    edge."""
    device_scan: DeviceScan | None
    """Scan time of the controller's program in the client role; None: not measured."""
    is_lower_bound: bool
    """Whether loop latency and age are lower bounds: in the client role without an echo register."""
    older_positions: OlderPositions | None
    """Estimate of the mean time by which the latency exceeds that bound; None: it is exact, or the torques do not show
    it."""
    network: NetworkShare | None
    """Share of the network in *controller*; None: not recorded."""
    jitter_ms: Jitter
    lost: Lost
    repaired: Repairs
    """Duplicates that were dropped, and messages that were put in order."""
    fit: bool
    """Whether the recording is valid for latency measurements."""
    reasons: tuple[Reason, ...]
    """Reasons why it is not valid; empty: it is valid."""
    findings: tuple[Finding, ...]
    """Timing causes, the most important first, then control observations; empty: no cause was found."""
    table: SampleTable = field(repr=False, compare=False)
    """The samples, fields as `samples.SAMPLE_DTYPE`; `table["loop"]` is a column, shape (samples,)."""
    ages: AgeTable | None = field(repr=False, compare=False)
    """The age at each step; None: no loop, or removed."""

    def without_table(self) -> "LatencyReport":
        """Copy without the samples and ages, to save memory when many reports are kept."""
        return replace(self, table=SampleTable(), ages=None)

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Stages of the loop in the role of the edge."""
        return stages_of_role(self.client_role)

    @property
    def qualifier(self) -> str:
        """What follows the names of loop latency and age in texts: whether they are lower bounds."""
        return ", at least" if self.is_lower_bound else ""

    def notes(self) -> list[str]:
        """Sentences on holding times, provenance and limits of the figures, for tables and reports."""
        notes = []
        if self.older_positions is not None:
            notes.append(str(self.older_positions))
        if self.age_ms is not None and self.control_period_ms is not None and self.longest_hold_ms is not None:
            older = ", ".join(f"{share:.1%} > {steps}" for steps, share in self.older_than_steps.items())
            notes.append(
                f"control period {self.control_period_ms:.1f} ms, longest hold {self.longest_hold_ms:.0f} ms; "
                f"age in steps: {older}; uncontrolled {self.uncontrolled_share or 0.0:.1%}"
            )
        if self.network is not None and str(self.network):
            notes.append(str(self.network))
        if self.loop_ms is not None and self.read_on_other_connection:
            notes.append("read on another connection: positions and torques of the controller have one each")
        if self.device_scan is not None:
            notes.append(str(self.device_scan))
        if self.client_role:
            notes.append("client of the controller: position write and torque read include the wake-up of the edge")
        elif self.loop_ms is not None and not self.kernel_timestamps:
            notes.append("without kernel timestamps: controller includes the wake-up of the edge")
        if self.repaired.duplicates:
            notes.append(f"dropped duplicate messages: {self.repaired.duplicates}")
        if self.repaired.reordered:
            notes.append(f"messages put in order by their sequence number: {self.repaired.reordered}")
        return notes

    def reason_text(self) -> str:
        """Reasons why the recording is not valid, as one text; empty: it is valid."""
        return "; ".join(reason.text for reason in self.reasons)

    def frame(self, library: str = "pandas") -> Any:
        """The samples as a data frame, one row per new command that took effect; times in ns as in `SAMPLE_DTYPE`.

        Args:
            library: `pandas` or `polars`.

        Raises:
            InputError: unknown library.
            OperationError: the library is not installed.
        """
        import pyarrow as pa

        from hilrig_replay.io.frames.tables import frame

        return frame(pa.table({name: self.table[name] for name in self.table.dtype.names or ()}), library)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, without the samples; None for an infinite bound."""
        plain = asdict(self.without_table())
        del plain["table"], plain["ages"]
        for of_quantity in plain["intervals_ms"].values():
            for name, bounds in of_quantity.items():
                of_quantity[name] = [bound if math.isfinite(bound) else None for bound in bounds]
        return plain


def measure(
    run: Run, on_block: Callable[[Records], None] | None = None, task: TaskConfig | None = None
) -> LatencyReport:
    """Measure the loop latency of a run in one pass, block by block.

    Args:
        run: the recording.
        on_block: called with each block (states, commands, parts, events), so that one pass serves several evaluations.
        task: task whose poses a steady-state error refers to; None: none.

    Raises:
        InputError: the file is damaged, or its parameters are invalid.
    """
    matcher, table, quality, ages = CommandMatcher(), SampleTable(), DataQuality(run), AgeTable(run)
    for block in run.blocks(frozenset({"state", "command", "event"}), repairs=quality.repairs):
        if on_block is not None:
            on_block(block)
        samples = matcher.add(block.states, block.commands)
        table.add(samples)
        ages.add(block)
        quality.add(block, samples)
    table.finish()
    ages.finish()
    age, loop, stages, spread = ages.statistics(), None, {}, 0.0
    intervals: dict[str, dict[str, Interval]] = {}
    windows = windows_of(run)
    other_connection = _share(table, "basis_on_other_connection") >= 0.5
    client_role = _share(table, "polled") >= 0.5
    open_loop = other_connection and not follows_positions((window.states, window.commands) for window in windows)
    if open_loop:
        # The basis of the commands is not their basis.
        table, age = SampleTable(), None
    if len(table):
        loop = Statistics.of(table.column("loop"))
        stages = {stage.key: Statistics.of(table.column(stage.key)) for stage in stages_of_role(client_role)}
        low, high = percentiles(table.column("loop"), (1, 99)) / 1e6
        spread = float(high - low)
        intervals = {name: _intervals_ms(table.column(name)) for name in ("loop", *stages)}
    if age is not None:
        intervals["age"] = _intervals_ms(ages.ages_ns)
    # In the client role the requests are those of the edge, whose answers wait for the controller.
    stalled = edge_stalls(quality.edge_stalls, table, () if client_role else windows, run.time_ns)
    reasons = tuple(quality.reasons(matcher.unmatched, loop, age, stalled))
    if open_loop:
        reasons = (*(reason for reason in reasons if reason not in NO_SAMPLES), OPEN_LOOP)
    is_lower_bound = _share(table, "basis_is_bound") > 0
    if is_lower_bound:
        reasons = (*reasons, NO_ECHO)
    network = network_share(windows, stages[CONTROLLER.key].p50 if CONTROLLER.key in stages else None)
    evidence = Evidence(
        step_ns=run.step_ns,
        samples=table,
        windows=windows,
        duration_s=run.duration_s,
        client_role=client_role,
        age=age,
        stalls=quality.stalls,
        edge_stalls=stalled,
        watchdog_gaps=quality.watchdog_gaps,
        gains=rounding_gains((window.states, window.commands) for window in windows),
        bases=quality.bases,
        open_loop=open_loop,
        min_rtt_ns=0.0 if network is None or network.min_ms is None else network.min_ms * 1e6,
        arm=ArmParameters() if task is None else parameters_of(run.parameters_json).arm,
        poses=() if task is None else task.poses,
    )
    return LatencyReport(
        session=run.session,
        rig=run.rig,
        controller=run.controller,
        samples=len(table),
        step_ms=run.step_ns / 1e6,
        loop_ms=loop,
        client_role=client_role,
        stages_ms=stages,
        intervals_ms=intervals,
        age_ms=age.age_ms if age else None,
        control_period_ms=age.control_period_ms if age else None,
        longest_hold_ms=age.longest_hold_ms if age else None,
        uncontrolled_share=age.uncontrolled_share if age else None,
        older_than_steps=age.older_than_steps if age else {},
        read_on_other_connection=other_connection,
        kernel_timestamps=_kernel_timestamps(table),
        device_scan=device_scan(np.concatenate([window.commands for window in windows])),
        is_lower_bound=is_lower_bound,
        older_positions=(
            older_positions((window.commands for window in windows), evidence.gains, run.step_ns)
            if is_lower_bound
            else None
        ),
        network=network,
        jitter_ms=Jitter(loop.std if loop else 0.0, spread, quality.lateness()),
        lost=quality.lost(),
        repaired=quality.repairs,
        fit=not reasons,
        reasons=reasons,
        findings=diagnose(evidence),
        table=table,
        ages=ages if age else None,
    )


def _intervals_ms(values_ns: Blocks) -> dict[str, Interval]:
    found = percentile_intervals(values_ns)
    return {name: (low / 1e6, high / 1e6) for name, (low, high) in found.items()}


def _share(samples: SampleTable, name: str) -> float:
    """Share of the samples with a property, a column of `SAMPLE_DTYPE`."""
    marked = sum(int(values.sum()) for values in samples.column(name)())
    return marked / max(len(samples), 1)


def _kernel_timestamps(samples: SampleTable) -> bool:
    """Whether the kernel's timestamp of each write is recorded."""
    if not len(samples):
        return False
    rows = samples.blocks("write_received_ns", "write_arrived_ns")
    return all(bool((block["write_received_ns"] != block["write_arrived_ns"]).all()) for block in rows)
