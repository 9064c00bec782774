"""Outputs of the commands for studies and for the timing of a host."""

from typing import Literal

from pydantic import Field

from hilrig_cli.json_output.model import JsonOutput, Values
from hilrig_replay.analysis.distribution import Statistics
from hilrig_study.live.from_recording import GainVerdict
from hilrig_study.study_config import StudyConfig


class JitterCondition(Values):
    """Timing of the host under one condition."""

    loaded: bool
    """Whether CPU load kept every processor busy."""
    step_ms: float
    seconds: float
    """Duration of the measurement, s."""
    ticks: int
    overruns: int
    """Ticks that began more than a step late."""
    missed_steps: int
    tick_lateness_ms: Statistics
    """Lateness of the simulation's ticks."""
    bus_ms: Statistics
    """State link and command link together."""
    modbus_ms: Statistics
    """Round trip of a Modbus request."""
    loop_ms: Statistics
    """Loop latency of a fast controller."""
    stolen: float | None
    """CPU steal time as a share of the processors' time, 0 to 1; null: not reported by this system."""
    fit: bool
    """Whether the host is suitable for a study at this step."""
    reasons: list[str]
    """Reasons why it is not."""
    fit_from_step_ms: float
    """Shortest step for which the measured times are suitable."""


class JitterOutput(JsonOutput):
    """Timing benchmark of the host."""

    schema_id: Literal["hilrig.jitter/1"] = Field(default="hilrig.jitter/1", alias="schema")
    machine: str
    step_ms: float
    conditions: list[JitterCondition]
    fit: bool
    """Whether the host is suitable under all conditions."""


class MarginValues(Values):
    """Stability margins of a loop with one poll per step."""

    stable: bool
    """Whether the loop is stable at the nominal loop latency."""
    radius: float | None
    """Spectral radius at the nominal loop latency."""
    delay_margin_s: float | None
    """Largest constant additional delay for which the loop is stable; 0: unstable; null: stable for any delay."""
    crossover: float | None
    """Crossover frequency of the delay margin, rad/s; null: none."""
    jitter_margin_s: float | None
    """Bound of an additional time-varying delay for which the loop is stable; sufficient, not necessary."""


class TheoryValues(Values):
    """Stability limits of a controller at one gain, step and poll period."""

    gain: float
    step_ms: float
    poll_ms: float
    stable_until_ms: float | None
    """Largest constant delay of the command link for which the loop is stable; -1: unstable without delay; null: stable
    at all swept delays."""
    nominal: MarginValues | None
    """Margins at the nominal latency; null: the controller does not poll once per step."""
    nominal_latency_ms: float | None
    mean_square_until: float | None
    """Largest value of the other swept parameter for which the loop is mean-square stable; -1: unstable at all; null:
    stable at all, nothing is random, or unknown."""


class CostValues(Values):
    """Mean cost of each cell: a row per y, a column per x."""

    mean: list[list[float | None]]
    half_width: list[list[float | None]]
    """Half of the 95 % confidence interval."""


class StudyController(Values):
    """Results of a controller."""

    name: str
    runs: int
    settled_share: float
    """Share of the runs that settled, 0 to 1."""
    settled_interval: tuple[float, float] | None
    """95 % confidence interval of that share; null: no run has random values."""
    cost: CostValues | None
    """null: no run has random values."""
    theory: list[TheoryValues]


class LiveRun(Values):
    """Loop latency and tracking error of a run, live or simulated."""

    loop_p50_ms: float | None
    loop_p95_ms: float | None
    loop_mean_ms: float | None
    error_rms_deg: float | None
    """Tracking error of joints 1 and 2, root mean square over the run."""
    settled: bool


class LivePoint(Values):
    """A point that was measured over Modbus TCP."""

    x: float
    y: float
    controller: str
    recording: str
    live: LiveRun
    virtual: LiveRun
    """Means over the simulated runs; `settled`: whether most of them settled."""
    phase_ms: float | None
    """Phase of the controller's reads relative to the ticks."""
    compute_ms: float | None
    """Time from read to write."""
    latency_ks: float | None
    """Kolmogorov-Smirnov distance between the two distributions of the loop latency, 0 to 1."""
    as_predicted: bool


class StudyOutput(JsonOutput):
    """Result of a study, as in study.json."""

    schema_id: Literal["hilrig.study/1"] = Field(default="hilrig.study/1", alias="schema")
    title: str
    study: StudyConfig
    """The study file with all defaults (docs/studies.md)."""
    software: str
    versions: dict[str, str]
    machine: str
    date: str
    """UTC."""
    seed: int
    controller_sha256: dict[str, str]
    """SHA-256 of each controller file, by the name of the controller."""
    units: dict[str, str]
    """Unit of each column of runs.parquet."""
    runs: int
    simulated_s: float
    seconds: float
    """Duration of the computation, s."""
    times_real_time: float
    controllers: list[StudyController]
    pictures: list[str]
    """Paths of the plots."""
    live: list[LivePoint]


class RecordedLatency(Values):
    """Loop latency of the recording."""

    samples: int
    p50_ms: float
    p99_ms: float
    max_ms: float


class StudyFromOutput(JsonOutput):
    """Gains under the latency of a recording."""

    schema_id: Literal["hilrig.study-from/1"] = Field(default="hilrig.study-from/1", alias="schema")
    session: str
    step_ms: float
    latency: RecordedLatency
    age_ms: Statistics
    """Age of the basis of the acting torque at each step."""
    gains: list[GainVerdict]
