"""A study's file: what is swept, by which controllers, in which task. Validated; every mistake is named with its place.

Units are those in which people type, in the name where there may be doubt (`delay_ms`); joint vectors are degrees,
degrees, mm, degrees, as in `lab.toml`; gains are SI.
"""

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from hilrig_runtime.config.impairment import ImpairmentSetting, LinkImpairments
from hilrig_runtime.config.lab import ArmConfig, LabConfig, RigSettings, SimConfig
from hilrig_runtime.config.scene import SceneConfig
from hilrig_runtime.config.types import NotNegative, Number, Positive, Section, Vector4
from hilrig_runtime.config.validation import format_validation_error
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import JOINT_NAMES, RigParameters
from hilrig_sim.parameters import rig_parameters
from hilrig_study.controllers.controllers import ComputedTorque, Controller, Pid
from hilrig_study.controllers.lqr import PredictiveLqr
from hilrig_study.controllers.user_controller import StudentController
from hilrig_study.simulation.simulated_loop import Scenario
from hilrig_study.simulation.timing import LoopTiming
from hilrig_study.theory.linear import LinearPlant, linearise

Floats = NDArray[np.float64]

Gains = tuple[NotNegative, NotNegative, NotNegative, NotNegative]
Swept = Literal["gain", "delay_ms", "jitter_ms", "loss", "step_ms", "poll_ms"]
MOST_CELLS: Final = 1_000_000
_LABELS: Final[dict[str, str]] = {
    "gain": "gain factor",
    "delay_ms": "added delay, ms",
    "jitter_ms": "added jitter, ms",
    "loss": "share of commands lost",
    "step_ms": "step of the simulation, ms",
    "poll_ms": "period of the polls, ms",
}


class LoopConfig(Section):
    """The loop's own times, before anything is added."""

    step_ms: Annotated[float, Field(ge=0.5, le=1000)] = 20.0
    """Step of the simulation, ms."""
    poll_ms: Positive = 20.0
    """From one poll of the controller to the next, ms."""
    phase_ms: NotNegative = 5.0
    """From a tick to the first read, ms."""
    compute_ms: NotNegative = 1.0
    """From a read to its write at the edge: the controller's time and its network, ms."""
    transport_ms: NotNegative = 0.4
    """Over the bus, each way, ms."""
    duration_s: Annotated[float, Field(gt=0, le=3600)] = 10.0
    """Length of a run, s."""

    def timing(self, step_ms: float | None = None, poll_ms: float | None = None) -> LoopTiming:
        """The same in ns; a step or a period from elsewhere.

        Raises:
            InputError: the controller takes longer than its period.
        """
        times = (step_ms or self.step_ms, poll_ms or self.poll_ms, self.phase_ms, self.compute_ms, self.transport_ms)
        return LoopTiming(*(round(ms * 1e6) for ms in times))


class TaskConfig(Section):
    """What the arm is to do."""

    pose: Vector4 = (17.0, 46.0, 80.0, 11.0)
    """Where it is to be; degrees, degrees, mm, degrees."""
    offset: Vector4 = (3.0, 3.0, 5.0, 3.0)
    """Where it starts, from the pose."""
    amplitude: Vector4 = (0.0, 0.0, 0.0, 0.0)
    """Of a sine about the pose that is to be followed."""
    frequency_hz: NotNegative = 0.0
    """Of that sine."""
    limit: tuple[Positive, Positive, Positive, Positive] = (30.0, 30.0, 50.0, 30.0)
    """A run whose error gets larger has failed."""

    def scenario(self) -> Scenario:
        """The same in SI units."""
        return Scenario(_si(self.pose), _si(self.offset), _si(self.amplitude), self.frequency_hz, _si(self.limit))


class ControllerConfig(Section):
    """One controller, and its ways; which keys count depends on its kind."""

    name: str = Field(default="PD", min_length=1, max_length=40)
    kind: Literal["pd", "pid", "computed_torque", "lqr", "file"] = "pd"
    kp: Gains = (23.0, 14.0, 30.0, 0.25)
    """pd, pid: N·m/rad, N·m/rad, N/m, N·m/rad. A gain factor multiplies kp, kd and ki."""
    kd: Gains = (4.6, 2.9, 2.0, 0.03)
    """pd, pid: N·m·s/rad and so on."""
    ki: Gains = (0.0, 0.0, 0.0, 0.0)
    """pid: N·m/(rad·s) and so on."""
    filter_ms: NotNegative = 20.0
    """Time constant of the filter on velocities, ms; 0: plain differences."""
    omega: Positive = 8.0
    """computed_torque: natural frequency of each joint, rad/s. A gain factor multiplies it."""
    zeta: Positive = 1.0
    """computed_torque: damping ratio."""
    effort_weight: Positive = 1.0
    """lqr: what (1 N·m)² costs beside (1°)². A gain factor divides it by its square."""
    compensate: bool = True
    """lqr: predict over the measured loop latency."""
    impairment: ImpairmentSetting | None = None
    """What is on its ways; default: the study's."""
    file: Path | None = None
    """file: a Python file with a class Controller, relative to the study's file; it gets the gain factor."""

    @model_validator(mode="after")
    def _file_goes_with_its_kind(self) -> "ControllerConfig":
        if (self.kind == "file") != (self.file is not None):
            raise ValueError('kind = "file" and a file go together')
        return self

    def build(
        self, rig: RigParameters, near: LinearPlant, period_s: float, gain: Floats, folder: Path = Path()
    ) -> Controller:
        """The controller for runs with these gain factors, (N,).

        Raises:
            InputError: a student's file can't be used.
        """
        filter_s = self.filter_ms / 1e3
        match self.kind:
            case "computed_torque":
                return ComputedTorque(rig.arm, period_s, self.omega * np.tile(gain, (4, 1)), self.zeta, filter_s)
            case "lqr":
                return PredictiveLqr(near, period_s, self.effort_weight / gain**2, compensate=self.compensate)
            case "file":
                assert self.file is not None
                return StudentController(folder / self.file, period_s, gain)
        kp, kd, ki = (np.array(values)[:, np.newaxis] * gain for values in (self.kp, self.kd, self.ki))
        return Pid(rig.arm, period_s, kp, kd, ki if self.kind == "pid" else np.zeros_like(kp), filter_s)


class AxisConfig(Section):
    """What is swept, over which values."""

    what: Swept
    values: tuple[Number, ...] = ()
    """The values themselves; or:"""
    range: tuple[Number, Number] | None = None
    """First and last of `count` values."""
    count: Annotated[int, Field(ge=2, le=2000)] = 21
    spacing: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _values_make_sense(self) -> "AxisConfig":
        if bool(self.values) == (self.range is not None):
            raise ValueError("give either values or a range")
        least = 0.0 if self.what in ("delay_ms", "jitter_ms", "loss") else math.ulp(0.0)
        for value in self.values or self.range or ():
            if value < least:
                what = f"{self.what} must {'not be negative' if least == 0 else 'be positive'}"
                raise ValueError(f"{what}, found {value:g}")
            if self.what == "loss" and value > 1:
                raise ValueError(f"loss is a share from 0 to 1, found {value:g}")
        if self.spacing == "log" and self.range is not None and min(self.range) <= 0:
            raise ValueError("a logarithmic range has no 0 in it")
        return self

    @property
    def points(self) -> Floats:
        """The values, (count,)."""
        if self.range is None:
            return np.array(self.values)
        space = np.geomspace if self.spacing == "log" else np.linspace
        return np.asarray(space(*self.range, self.count), dtype=np.float64)

    @property
    def label(self) -> str:
        """For an axis of a picture."""
        return _LABELS[self.what]


class PointConfig(Section):
    """A point of the plane that is looked at more closely: its traces are drawn, or it is run live."""

    x: Number
    y: Number
    controller: str = ""
    """Default: the first."""


class StudyConfig(Section):
    """A whole study."""

    title: str = "Study"
    plant: Literal["arm", "linear"] = "arm"
    """The arm itself with its registers and stops, or the linear system near the pose."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1
    runs: Annotated[int, Field(ge=1, le=1000)] = 1
    """Runs of each cell, which differ in what is drawn: more than one where something is random."""
    arm: ArmConfig = ArmConfig()
    loop: LoopConfig = LoopConfig()
    task: TaskConfig = TaskConfig()
    impairment: ImpairmentSetting = ImpairmentSetting()
    """What is on both ways before the sweep adds to the command's."""
    controllers: Annotated[tuple[ControllerConfig, ...], Field(min_length=1)] = (ControllerConfig(),)
    x: AxisConfig
    y: AxisConfig
    traces: tuple[PointConfig, ...] = ()
    live: tuple[PointConfig, ...] = ()
    """Points that --live runs over Modbus TCP."""
    live_duration_s: Annotated[float, Field(ge=2, le=600)] = 10.0

    @model_validator(mode="after")
    def _fits_together(self) -> "StudyConfig":
        if self.x.what == self.y.what:
            raise ValueError(f"x and y both sweep {self.x.what}")
        names = [controller.name for controller in self.controllers]
        if len(set(names)) < len(names):
            raise ValueError("two controllers have the same name")
        for point in (*self.traces, *self.live):
            if point.controller and point.controller not in names:
                raise ValueError(f"no controller is called {point.controller!r}; there are {', '.join(names)}")
        cells = len(self.x.points) * len(self.y.points) * len(names) * self.runs
        if cells > MOST_CELLS:
            raise ValueError(f"{cells:,} runs are more than {MOST_CELLS:,}: take fewer values")
        return self

    @model_validator(mode="after")
    def _starts_between_its_stops(self) -> "StudyConfig":
        joints = zip(
            JOINT_NAMES,
            self.task.pose,
            self.task.offset,
            self.arm.lower_limits,
            self.arm.upper_limits,
            strict=True,
        )
        for joint, pose, offset, lower, upper in joints:
            if not lower <= pose + offset <= upper:
                raise ValueError(
                    f"task: {joint} would start at {pose + offset:g} (pose {pose:g}, offset {offset:g}): "
                    f"expected {lower:g} to {upper:g}"
                )
        return self

    def with_files(self, paths: Sequence[Path]) -> "StudyConfig":
        """The same with more controllers, each out of a Python file and called like it.

        Raises:
            InputError: there is no such file.
        """
        for path in paths:
            if not path.is_file():
                raise InputError(f"--controller {path}: no such file")
        more = [ControllerConfig(name=path.stem[:40], kind="file", file=path.resolve()) for path in paths]
        return self.model_copy(update={"controllers": (*self.controllers, *more)})

    def rig(self, step_ms: float | None = None) -> RigParameters:
        """The arm's parameters with this step; it starts where the task does, with nothing around it.

        Raises:
            InputError: they do not fit together.
        """
        lab = self.lab(step_ms)
        return rig_parameters(lab, lab.rigs[0])

    def lab(self, step_ms: float | None = None) -> LabConfig:
        """A lab with this arm alone, which starts where the task does."""
        step = step_ms or self.loop.step_ms
        substeps = max(1, math.ceil(step / 20.0))
        start = tuple(p + o for p, o in zip(self.task.pose, self.task.offset, strict=True))
        try:
            arm = ArmConfig.model_validate({**self.arm.model_dump(), "start_position": start})
            return LabConfig(
                name="study",
                sim=SimConfig(step_ms=step, substeps=substeps),
                rigs=(RigSettings(arm=arm, scene=SceneConfig(trays=(), parts=())),),
            )
        except ValidationError as error:
            raise InputError("; ".join(format_validation_error(error))) from error

    def links(self, controller: int) -> LinkImpairments:
        """What is on a controller's ways before the sweep adds to the command's."""
        own = self.controllers[controller].impairment
        return (self.impairment if own is None else own).links

    def near(self) -> LinearPlant:
        """The arm near the task's pose.

        Raises:
            InputError: the pose is at or beyond a stop.
        """
        return linearise(self.rig().arm, _si(self.task.pose))

    def discretised(self, step_ms: float) -> tuple[Floats, Floats]:
        """Φ, (8, 8), and Γ, (8, 4), of the arm near the task's pose, as the study steps it: by the simulation's
        integrator, or exactly."""
        sim = self.rig(step_ms).sim
        how = (sim.integrator, sim.substeps) if self.plant == "arm" else ()
        return self.near().discretise(sim.step_ns * 1e-9, *how)


def load_study(path: Path) -> StudyConfig:
    """Read a study's file.

    Raises:
        InputError: it can't be read, is no TOML, or says something that is no study; every mistake is named.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise InputError(f"{path}: can't be read: {reason}") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: no valid TOML: {error}") from error
    try:
        study = StudyConfig.model_validate(values)
    except ValidationError as error:
        raise InputError("\n".join(f"{path}: {mistake}" for mistake in format_validation_error(error))) from error
    study.near()
    study.loop.timing()
    return study


def _si(joints: Sequence[float]) -> tuple[float, float, float, float]:
    theta1, theta2, d3, theta4 = joints
    return math.radians(theta1), math.radians(theta2), d3 / 1e3, math.radians(theta4)
