"""Study file: swept parameters, controllers and motion task, validated with one error per invalid key.

The name of a key contains its unit where it is not obvious (`delay_ms`). Joint vectors are degrees, degrees, mm,
degrees, as in `lab.toml`; gains are in SI units.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hilrig_runtime.config.impairment import ImpairmentSetting, LinkImpairments
from hilrig_runtime.config.lab import ArmConfig, LabConfig, RigSettings, SimConfig
from hilrig_runtime.config.scene import SceneConfig
from hilrig_runtime.config.types import NotNegative, Number, Positive, Section, Vector4
from hilrig_runtime.config.validation import parse_toml, read_text, validate
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.joints import JOINT_NAMES
from hilrig_sim.arm.model import RigParameters, joints_si
from hilrig_sim.parameters import rig_parameters
from hilrig_study.controllers.control_laws import ComputedTorque, Controller, Pid
from hilrig_study.controllers.lqr import PredictiveLqr
from hilrig_study.controllers.user_controller import UserController
from hilrig_study.linear_model import LinearPlant, linearize
from hilrig_study.simulation.simulated_loop import Scenario
from hilrig_study.simulation.timing import LoopTiming

Floats = NDArray[np.float64]

Gains = tuple[NotNegative, NotNegative, NotNegative, NotNegative]
Swept = Literal["gain", "delay_ms", "jitter_ms", "loss", "step_ms", "poll_ms"]
MAX_RUNS: Final = 1_000_000
_LABELS: Final[dict[str, str]] = {
    "gain": "gain factor",
    "delay_ms": "added delay, ms",
    "jitter_ms": "added jitter, ms",
    "loss": "fraction of commands lost",
    "step_ms": "simulation step, ms",
    "poll_ms": "poll period, ms",
}


class LoopConfig(Section):
    """Timing of the loop without injected delays."""

    step_ms: Annotated[float, Field(ge=0.5, le=1000)] = SimConfig().step_ms
    """Step of the simulation, ms."""
    poll_ms: Positive = 20.0
    """Poll period of the controller, ms."""
    phase_ms: NotNegative = 5.0
    """Time from a tick to the first read, ms."""
    compute_ms: NotNegative = 1.0
    """Time from a read to its write at the edge: computation and network round trip of the controller, ms."""
    transport_ms: NotNegative = 0.4
    """Transport time over the bus, per direction, ms."""
    duration_s: Annotated[float, Field(gt=0, le=3600)] = 10.0
    """Length of a run, s."""

    def timing(self, step_ms: float | None = None, poll_ms: float | None = None) -> LoopTiming:
        """Return the timing in ns; `step_ms` and `poll_ms` override the configured values.

        Raises:
            InputError: the time from read to write is longer than the poll period.
        """
        times = (step_ms or self.step_ms, poll_ms or self.poll_ms, self.phase_ms, self.compute_ms, self.transport_ms)
        return LoopTiming(*(round(ms * 1e6) for ms in times))


class MotionTaskConfig(Section):
    """Motion task of a study."""

    pose: Vector4 = (17.0, 46.0, 80.0, 11.0)
    """Target pose; degrees, degrees, mm, degrees."""
    offset: Vector4 = (3.0, 3.0, 5.0, 3.0)
    """Start position relative to the pose."""
    amplitude: Vector4 = (0.0, 0.0, 0.0, 0.0)
    """Amplitude of a set-point sine around the pose."""
    frequency_hz: NotNegative = 0.0
    """Frequency of the set-point sine, Hz."""
    limit: tuple[Positive, Positive, Positive, Positive] = (30.0, 30.0, 50.0, 30.0)
    """Failure limit: a run fails when an error exceeds it."""

    def scenario(self) -> Scenario:
        """Return the task in SI units."""
        pose, offset, amplitude, limit = map(joints_si, (self.pose, self.offset, self.amplitude, self.limit))
        return Scenario(pose, offset, amplitude, self.frequency_hz, limit)


class ControllerConfig(Section):
    """One controller and the impairment of its links; the kind determines which keys are used."""

    name: str = Field(default="PD", min_length=1, max_length=40)
    kind: Literal["pd", "pid", "computed_torque", "lqr", "file"] = "pd"
    kp: Gains = (23.0, 14.0, 30.0, 0.25)
    """pd, pid: N·m/rad, N·m/rad, N/m, N·m/rad. The gain factor multiplies kp, kd and ki."""
    kd: Gains = (4.6, 2.9, 2.0, 0.03)
    """pd, pid: N·m·s/rad, joint 3 in N·s/m."""
    ki: Gains = (0.0, 0.0, 0.0, 0.0)
    """pid: N·m/(rad·s), joint 3 in N/(m·s)."""
    filter_ms: NotNegative = 20.0
    """Time constant of the velocity filter, ms; 0: no filter."""
    omega: Positive = 8.0
    """computed_torque: natural frequency of each joint, rad/s. The gain factor multiplies it."""
    zeta: Positive = 1.0
    """computed_torque: damping ratio."""
    effort_weight: Positive = 1.0
    """lqr: weight of (1 N·m)² relative to (1°)². It is divided by the square of the gain factor."""
    compensate: bool = True
    """lqr: whether to predict over the measured loop latency."""
    impairment: ImpairmentSetting | None = None
    """Impairment of its links; default: the study's."""
    file: Path | None = None
    """file: Python file with a class Controller, relative to the study file; the gain factor is passed to it."""

    @model_validator(mode="after")
    def _require_file_for_its_kind(self) -> "ControllerConfig":
        if (self.kind == "file") != (self.file is not None):
            raise ValueError('kind = "file" requires the key file, and file requires kind = "file"')
        return self

    def build(
        self, rig: RigParameters, plant_model: LinearPlant, period_s: float, gain: Floats, folder: Path = Path()
    ) -> Controller:
        """Build the controller for runs with these gain factors, (N,).

        Raises:
            InputError: the controller file is not usable.
        """
        filter_s = self.filter_ms / 1e3
        match self.kind:
            case "computed_torque":
                return ComputedTorque(rig.arm, period_s, self.omega * np.tile(gain, (4, 1)), self.zeta, filter_s)
            case "lqr":
                return PredictiveLqr(plant_model, period_s, self.effort_weight / gain**2, compensate=self.compensate)
            case "file":
                assert self.file is not None
                return UserController(folder / self.file, period_s, gain)
        kp, kd, ki = (np.array(values)[:, np.newaxis] * gain for values in (self.kp, self.kd, self.ki))
        return Pid(rig.arm, period_s, kp, kd, ki if self.kind == "pid" else np.zeros_like(kp), filter_s)


class AxisConfig(Section):
    """Swept parameter and its values."""

    what: Swept
    values: tuple[Number, ...] = ()
    """List of values; alternative to `range`."""
    range: tuple[Number, Number] | None = None
    """First and last of `count` values."""
    count: Annotated[int, Field(ge=2, le=2000)] = 21
    spacing: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _check_values(self) -> "AxisConfig":
        if bool(self.values) == (self.range is not None):
            raise ValueError("give exactly one of values and range")
        least = 0.0 if self.what in ("delay_ms", "jitter_ms", "loss") else math.ulp(0.0)
        for value in self.values or self.range or ():
            if value < least:
                bound = "≥ 0" if least == 0 else "> 0"
                raise ValueError(f"{self.what} must be {bound}, got {value:g}")
            if self.what == "loss" and value > 1:
                raise ValueError(f"loss must be between 0 and 1, got {value:g}")
        if self.spacing == "log" and self.range is not None and min(self.range) <= 0:
            raise ValueError(f"a logarithmic range must be > 0, got {min(self.range):g}")
        return self

    @property
    def points(self) -> Floats:
        """Values, (count,)."""
        if self.range is None:
            return np.array(self.values)
        space = np.geomspace if self.spacing == "log" else np.linspace
        return np.asarray(space(*self.range, self.count), dtype=np.float64)

    @property
    def label(self) -> str:
        """Axis label of a plot."""
        return _LABELS[self.what]


class PointConfig(Section):
    """Selected point of the plane, whose trace is plotted or which is measured live."""

    x: Number
    y: Number
    controller: str = ""
    """Name of the controller; default: the first one."""


class StudyConfig(Section):
    """Complete study file."""

    title: str = "Study"
    plant: Literal["arm", "linear"] = "arm"
    """Nonlinear arm with hard stops, or linear model near the pose."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1
    runs: Annotated[int, Field(ge=1, le=1000)] = 1
    """Runs per cell with different random draws; a cell without random values is run once."""
    arm: ArmConfig = ArmConfig()
    loop: LoopConfig = LoopConfig()
    task: MotionTaskConfig = MotionTaskConfig()
    impairment: ImpairmentSetting = ImpairmentSetting()
    """Impairment of both links; swept delay, jitter and loss are added to the command link."""
    controllers: Annotated[tuple[ControllerConfig, ...], Field(min_length=1)] = (ControllerConfig(),)
    x: AxisConfig
    y: AxisConfig
    traces: tuple[PointConfig, ...] = ()
    live: tuple[PointConfig, ...] = ()
    """Points that --live measures over Modbus TCP."""
    live_duration_s: Annotated[float, Field(ge=2, le=600)] = 10.0

    @model_validator(mode="after")
    def _check_consistency(self) -> "StudyConfig":
        if self.x.what == self.y.what:
            raise ValueError(f"x and y sweep the same parameter {self.x.what}")
        names = [controller.name for controller in self.controllers]
        if len(set(names)) < len(names):
            raise ValueError(f"controller names must be unique, got {', '.join(names)}")
        for point in (*self.traces, *self.live):
            if point.controller and point.controller not in names:
                raise ValueError(f"unknown controller {point.controller!r}: expected one of {', '.join(names)}")
        cells = len(self.x.points) * len(self.y.points) * len(names) * self.runs
        if cells > MAX_RUNS:
            raise ValueError(f"too many runs: at most {MAX_RUNS:,}, got {cells:,}; use fewer values")
        return self

    @model_validator(mode="after")
    def _check_start_position(self) -> "StudyConfig":
        task, arm = self.task, self.arm
        joints = zip(JOINT_NAMES, task.pose, task.offset, arm.lower_limits, arm.upper_limits, strict=True)
        for joint, pose, offset, lower, upper in joints:
            if not lower <= pose + offset <= upper:
                raise ValueError(
                    f"task: {joint} must start between its stops {lower:g} and {upper:g}, "
                    f"got {pose + offset:g} (pose {pose:g} + offset {offset:g})"
                )
        return self

    def with_files(self, paths: Sequence[Path]) -> "StudyConfig":
        """Return the study with additional controllers from Python files, named after the files.

        Raises:
            InputError: a file does not exist.
        """
        for path in paths:
            if not path.is_file():
                raise InputError(f"--controller {path}: no such file")
        more = [ControllerConfig(name=path.stem[:40], kind="file", file=path.resolve()) for path in paths]
        return self.model_copy(update={"controllers": (*self.controllers, *more)})

    def rig(self, step_ms: float | None = None) -> RigParameters:
        """Return the rig parameters for a step, with the task's start position and an empty scene.

        Raises:
            InputError: the parameters are inconsistent.
        """
        lab = self.lab(step_ms)
        return rig_parameters(lab, lab.rigs[0])

    def lab(self, step_ms: float | None = None) -> LabConfig:
        """Return a lab with one rig, the task's start position and an empty scene."""
        step = step_ms or self.loop.step_ms
        start = tuple(p + o for p, o in zip(self.task.pose, self.task.offset, strict=True))
        arm = validate(ArmConfig, {**self.arm.model_dump(), "start_position": start})
        sim = validate(SimConfig, {"step_ms": step})
        return LabConfig(name="study", sim=sim, rigs=(RigSettings(arm=arm, scene=SceneConfig(trays=(), parts=())),))

    def link_impairments(self, controller: int) -> LinkImpairments:
        """Return the link impairments of a controller, without the swept values."""
        own = self.controllers[controller].impairment
        return (self.impairment if own is None else own).links

    def linear_plant(self) -> LinearPlant:
        """Return the linear model of the arm at the task's pose.

        Raises:
            InputError: the pose is at or beyond a stop.
        """
        return linearize(self.rig().arm, joints_si(self.task.pose))

    def discretized_plant(self, step_ms: float) -> tuple[Floats, Floats]:
        """Return Φ, (8, 8), and Γ, (8, 4), of the linear model, discretized as the study steps its plant.

        Automatic sub-steps resolve the modes of the arm, so the exact discretization describes them.
        """
        return self.linear_plant().discretize(self.rig(step_ms).sim.step)


def load_study(path: Path) -> StudyConfig:
    """Read and validate a study file.

    Raises:
        InputError: the file can't be read, is not valid TOML, or is not a valid study; the message has every error.
    """
    study = validate(StudyConfig, parse_toml(read_text(path), str(path)), str(path))
    study.linear_plant()
    study.loop.timing()
    return study
