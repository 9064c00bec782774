"""Outputs of the commands for recordings."""

from typing import Any, Literal

from pydantic import Field

from hilrig_cli.json_output.model import JsonOutput, Values
from hilrig_replay.analysis.client_role.device_scan import DeviceScan
from hilrig_replay.analysis.client_role.older_positions import OlderPositions
from hilrig_replay.analysis.compare import Difference
from hilrig_replay.analysis.data_quality import Lost, Reason
from hilrig_replay.analysis.diagnosis.evidence import Finding
from hilrig_replay.analysis.distribution import Statistics
from hilrig_replay.analysis.latency import Jitter
from hilrig_replay.analysis.network import NetworkShare
from hilrig_replay.analysis.summary import Motion
from hilrig_replay.grading.grade import PlaceResult
from hilrig_replay.grading.path_goal import PathResult
from hilrig_replay.grading.placement import PartPlacement
from hilrig_replay.grading.pose_goal import PoseResult
from hilrig_replay.io.columns import JointValues
from hilrig_replay.io.sequence_order import Repairs

Interval = tuple[float | None, float | None]
"""Bounds of a 95 % confidence interval; null: not supported by the samples."""


class LatencyValues(Values):
    """Loop latency and age of a recording (docs/timing.md)."""

    session: str
    rig: str
    controller: str
    samples: int
    """Number of commands that took effect."""
    step_ms: float
    """Step of the simulation."""
    loop_ms: Statistics | None
    """Loop latency; null: no closed loop (see `reasons`)."""
    client_role: bool
    """Whether the edge was the client of the controller."""
    stages_ms: dict[str, Statistics]
    """Stages of the loop latency, by name."""
    intervals_ms: dict[str, dict[str, Interval]]
    """95 % confidence intervals of the percentiles of loop, each stage, age and tick_lateness, by percentile; a bound
    is null if the samples do not support it."""
    age_ms: Statistics | None
    """Age of the basis of the acting torque at each step; null: no command that is based on a state took effect."""
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
    """Whether the kernel's timestamps separate the stages of controller and edge."""
    device_scan: DeviceScan | None
    """Scan time of the controller's program in the client role; null: not measured."""
    is_lower_bound: bool
    """Whether loop latency and age are lower bounds: in the client role without an echo register."""
    older_positions: OlderPositions | None
    """Estimate of the mean time by which the latency exceeds that bound; null: it is exact, or unknown."""
    network: NetworkShare | None
    """Share of the network in the stage of the controller; null: not recorded."""
    jitter_ms: Jitter
    lost: Lost
    """Number of messages that are missing in the recording."""
    repaired: Repairs
    """Number of messages that were dropped as duplicates, or put in order."""
    fit: bool
    """Whether the recording is valid for latency measurements."""
    reasons: tuple[Reason, ...]
    """Reasons why it is not valid."""
    findings: tuple[Finding, ...]
    """Timing causes, the most important first, then control observations."""


class LatencyOutput(LatencyValues, JsonOutput):
    """Loop latency and age of one recording."""

    schema_id: Literal["hilrig.latency/1"] = Field(default="hilrig.latency/1", alias="schema")


class LatencyOfRun(LatencyValues):
    """Loop latency and age of one of several recordings."""

    path: str


class OverRuns(Values):
    """Median of a figure over several recordings."""

    runs: int
    median: float
    interval: tuple[float, float] | None
    """95 % confidence interval; null: fewer than six recordings."""


class Unreadable(Values):
    """A recording that can't be read."""

    path: str
    reason: str


class LatencyRunsOutput(JsonOutput):
    """Loop latency and age of several recordings."""

    schema_id: Literal["hilrig.latency-runs/1"] = Field(default="hilrig.latency-runs/1", alias="schema")
    runs: list[LatencyOfRun]
    aggregate: dict[str, dict[str, OverRuns]]
    """Of loop_ms and age_ms, by the name of the figure, in ms."""
    unreadable: list[Unreadable]


class VerifyValues(Values):
    """Result of a re-simulation."""

    same: bool
    """Whether the re-simulation reproduces the recorded states."""
    steps: int
    """Number of steps that were re-simulated and compared."""
    skipped: int
    """Number of steps that could not be re-simulated, because states around them are missing."""
    gaps: int
    """Number of gaps in the recorded states."""
    exact: bool
    """Whether all compared fields are bit-identical to the recording."""
    tolerance: float
    """Allowed deviation; rad, m, rad/s, m/s."""
    largest_deviation: JointValues
    """Largest position deviation of each joint; rad, rad, m, rad."""
    largest_velocity_deviation: JointValues
    """Largest velocity deviation of each joint; rad/s, rad/s, m/s, rad/s."""
    largest_part_deviation: float
    """Largest deviation of the center of a part, m."""
    first_diverging_step: int | None
    """First step that does not lead to the next recorded state; null: no divergence."""
    differing: dict[str, int]
    """Number of states with a deviation beyond the tolerance, by field; without the fields that agree."""
    not_checked: tuple[str, ...]
    """Fields that the recording lacks."""
    machine: str
    """Platform on which the run was recorded."""


class VerifyOutput(VerifyValues, JsonOutput):
    """Re-simulation of one recording."""

    schema_id: Literal["hilrig.verify/1"] = Field(default="hilrig.verify/1", alias="schema")


class VerifyRunsOutput(JsonOutput):
    """Re-simulation of several recordings."""

    schema_id: Literal["hilrig.verify-runs/1"] = Field(default="hilrig.verify-runs/1", alias="schema")
    runs: list[VerifyValues]
    """In the order of the recordings, without those that can't be read."""
    unreadable: list[Unreadable]


class GradeValues(Values):
    """Grade of a recording by the task of its lab."""

    title: str
    score: float
    """Share of the goals that were reached in time, 0 to 1."""
    passed: bool
    """Whether all goals were reached."""
    done_s: float | None
    """Time at which the last goal was reached, from the start of the task; null: a goal is missing."""
    time_limit_s: float
    """0: no limit."""
    poses: tuple[PoseResult, ...]
    path: PathResult | None
    parts: tuple[PlaceResult, ...]
    error_mm: float | None
    """Largest error of the held poses, the path (root mean square) and the placed parts."""


class RunSummaryValues(Values):
    """Summary of a recording."""

    name: str
    """Name of the file without suffix."""
    session: str
    rig: str
    lab: str
    controller: str
    certificate: str
    """Name in the controller's certificate; empty: it had none."""
    start: str
    """Start time as recorded, UTC."""
    duration_s: float
    ended: str
    """How the recording ended."""
    latency: LatencyValues
    motion: Motion
    events: dict[str, dict[str, int]]
    """Number of events by kind and severity."""
    alarms: int
    """Number of events of severity warning and above."""
    parts_placed: int | None
    """Number of parts on a place; null: the scene has no parts or no places."""
    largest_placing_error_mm: float | None
    grade: GradeValues | None
    """null: the lab has no task."""
    overlaps: tuple[str, ...]
    """Sessions of the same rig at the same time, among those of the command."""


class ReportedRun(RunSummaryValues):
    """Summary of a recording in a report."""

    verify: VerifyValues | None = None
    """Result of the re-simulation; null: without --verify."""


class ReportOutput(JsonOutput):
    """Content of a report."""

    schema_id: Literal["hilrig.report/1"] = Field(default="hilrig.report/1", alias="schema")
    page: str
    """Path of the page."""
    runs: tuple[ReportedRun, ...]
    """In the order of the ranking."""
    left_out: tuple[str, ...]
    """Reason why a recording is not in the report, one sentence each."""
    alike: tuple[str, ...]
    """Pairs of runs with the same torques, one sentence each."""
    overlaps: tuple[str, ...]
    """Manual recordings of other runs, which are not graded, one sentence each."""


class AlignedRun(RunSummaryValues):
    """Summary of a recording in a comparison."""

    origin_s: float
    """Time zero of the comparison, on the time axis of the recording."""
    aligned_by: str
    """Criterion of `origin_s`: motion, command (no motion under command), start (no command), or a kind of event."""


class CompareOutput(JsonOutput):
    """Differences between recordings."""

    schema_id: Literal["hilrig.compare/1"] = Field(default="hilrig.compare/1", alias="schema")
    aligned_by: str
    """The requested criterion."""
    runs: list[AlignedRun]
    """The first one is the reference."""
    differences: list[Difference]
    """Of each run after the first."""
    left_out: tuple[str, ...]
    """Error message of each skipped recording."""


class ListedRun(Values):
    """A recording in a list."""

    path: str
    """Path of its file; of several the first."""
    size: int
    """Size of its files, bytes."""
    rig: str
    lab: str
    session: str
    segments: list[str]
    """Paths of all its files."""
    overlaps: tuple[str, ...]
    """Sessions of the same rig at the same time: a manual recording, or of controllers in it."""
    controller: str
    certificate: str
    """Name in the controller's certificate; empty: it had none."""
    start: str
    """Start, UTC; empty: unknown."""
    start_wall_ns: int
    """Time of the first state by the clock of its sender, since 1970-01-01 UTC."""
    duration_s: float
    messages: int
    ended: str
    """How the recording ended; recording: it is being written."""
    reason: str
    """Reason of that end."""
    lost_transport: int
    """Messages lost in transport to the recorder."""
    lost_recorder: int
    """Messages lost in the recorder."""
    lost_file: int
    """Messages that the file counts, but does not contain."""
    overruns: int
    missed_steps: int
    clock_steps: int
    """Steps of the wall clock."""
    error: str
    """Error that makes the file unusable; empty: no error."""
    loop_p50_ms: float | None
    """null: not measured, or no closed loop; so are the next figures."""
    loop_p99_ms: float | None
    age_p50_ms: float | None
    age_p99_ms: float | None
    control_period_ms: float | None
    fit: bool | None
    """Whether the recording is valid for latency measurements; null: not measured."""
    unfit_reasons: tuple[Reason, ...]
    verified: bool | None
    """Whether the re-simulation reproduced the states; null: not verified."""


class RunsOutput(JsonOutput):
    """Recordings of a folder."""

    schema_id: Literal["hilrig.runs/1"] = Field(default="hilrig.runs/1", alias="schema")
    folder: str
    total: int
    """Number of recordings that match; `runs` has at most --limit."""
    runs: list[ListedRun]


class RecoverOutput(JsonOutput):
    """Recovery of a file."""

    schema_id: Literal["hilrig.recover/1"] = Field(default="hilrig.recover/1", alias="schema")
    source: str
    path: str | None
    """The new file; null: the source is complete and intact, no file was written."""
    messages: int
    chunks: int
    attachments: int
    metadata: int
    damaged_chunks: int
    """Chunks with a wrong checksum or content."""
    damaged_bytes: int
    """Bytes of the source without a complete record: the truncated end and damaged ranges."""
    torn_bytes: int
    """The part of `damaged_bytes` that belongs to a record truncated by the end of the file."""
    orphans: int
    """Messages that were not copied because their channel is unknown."""
    reasons: list[str]


class DemoTask(Values):
    """Result of the task of the demo."""

    parts: list[PartPlacement]
    placed: int
    missing: list[str]
    """Parts that are not in a tray."""
    why: str
    """Reason why parts are missing; empty: none is."""
    largest_error_mm: float | None
    """Largest error of the placed parts; null: no part is placed."""


class DemoOutput(JsonOutput):
    """Result of the demo."""

    schema_id: Literal["hilrig.demo/1"] = Field(default="hilrig.demo/1", alias="schema")
    recording: str
    rrd: str
    """Path of the rerun file."""
    plot: str
    latency: LatencyValues
    verify: VerifyValues
    task: DemoTask
    controller: dict[str, Any]
    """Result of the example controller, examples/pick_and_place.py; empty: it failed."""
