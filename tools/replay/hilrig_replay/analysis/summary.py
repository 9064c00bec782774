"""Summary of a run, computed in one pass: latency, motion, events, grade, and a downsampled trajectory for plots."""

from collections import Counter, defaultdict
from dataclasses import asdict, dataclass, field
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.distribution import percentiles
from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.analysis.similarity import TorqueSketch
from hilrig_replay.geometry.scene import parameters_of
from hilrig_replay.grading.grade import Grade, Grader
from hilrig_replay.grading.overlap import Span
from hilrig_replay.grading.placement import PlacementReport, evaluate_placement
from hilrig_replay.grading.task_loading import recorded_task
from hilrig_replay.io.columns import JointValues, Rows, joint_values
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run
from hilrig_runtime.config.task import TaskConfig
from hilrig_schemas import Event
from hilrig_sim.arm.kinematics import forward, jacobian
from hilrig_sim.arm.model import LARGEST_REGISTER_FORCE, RigParameters

TRAJECTORY_POINTS: Final = 4000
"""Approximate number of states in a downsampled trajectory."""
_SATURATED: Final = LARGEST_REGISTER_FORCE - 1e-9

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of the arm in a run while a controller acts: its command holds, and an effort is not zero."""

    tool_path_m: float
    """Path length of the tool, m."""
    top_speed: float
    """Maximum speed of the tool, m/s."""
    work_j: float
    """Mechanical work of the drives, |effort · velocity| integrated over time and summed over the joints, J."""
    peak_effort: JointValues
    """Largest magnitude of the applied effort; N·m, N·m, N, N·m."""
    saturated_share: JointValues
    """Share of the steps with the effort at the limit of its register, by joint, 0 to 1."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Downsampled trajectory of a run; each array has one row per selected state."""

    time_s: Floats
    position: Floats
    """Shape (n, 4); rad, rad, m, rad."""
    velocity: Floats
    """Shape (n, 4)."""
    effort: Floats
    """Shape (n, 4); N·m, N·m, N, N·m."""
    tip: Floats
    """Position of the tool, world, m, shape (n, 3)."""


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Summary of one run, for reports and comparisons."""

    name: str
    """Name of the file without suffix: the session id unless the file was renamed."""
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
    latency: LatencyReport
    motion: Motion
    events: dict[str, dict[str, int]]
    """Number of events by kind and severity."""
    alarms: int
    """Number of events of severity WARNING and above."""
    placement: PlacementReport | None
    """Placement of the parts at the end of the run; None: the scene has no parts or no places."""
    grade: Grade | None
    """None: the run has no task."""
    box_ms: tuple[float, ...]
    """Percentiles 1, 25, 50, 75 and 99 of the loop latency; empty: no samples."""
    trajectory: Trajectory = field(repr=False, compare=False)
    torques: TorqueSketch = field(repr=False, compare=False)
    """Torques written by the controllers, to be compared with other runs."""
    span: Span = field(repr=False, compare=False)
    """When the session was recorded."""
    overlaps: tuple[str, ...] = ()
    """Sessions of the same rig at the same time, among the runs of a report."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, without the data for plots."""
        return {
            "name": self.name,
            "session": self.session,
            "rig": self.rig,
            "lab": self.lab,
            "controller": self.controller,
            "certificate": self.certificate,
            "start": self.start,
            "duration_s": self.duration_s,
            "ended": self.ended,
            "latency": self.latency.as_dict(),
            "motion": asdict(self.motion),
            "events": self.events,
            "alarms": self.alarms,
            "parts_placed": None if self.placement is None else self.placement.placed,
            "largest_placing_error_mm": None if self.placement is None else self.placement.largest_error_mm,
            "grade": None if self.grade is None else self.grade.as_dict(),
            "overlaps": self.overlaps,
        }


def summarize(run: Run, task: TaskConfig | None = None) -> RunSummary:
    """Summarize a run in one pass.

    Args:
        run: the recording.
        task: task to grade the run by; None: the recorded task of its lab.

    Raises:
        InputError: the file is damaged, or its parameters or its task are invalid.
    """
    task = task or recorded_task(run)
    collector = _Collector(run, parameters_of(run.parameters_json), task)
    latency = measure(run, collector.add, task)
    return RunSummary(
        name=run.path.stem,
        session=run.session,
        rig=run.rig,
        lab=run.lab,
        controller=run.controller,
        certificate=run.certificate,
        start=run.started,
        duration_s=run.duration_s,
        ended=run.ended,
        latency=latency,
        motion=collector.motion(),
        events={kind: dict(sorted(counts.items())) for kind, counts in sorted(collector.events.items())},
        alarms=collector.alarms,
        placement=collector.placement(),
        grade=collector.grade(),
        box_ms=_box_ms(latency),
        trajectory=collector.trajectory(),
        torques=collector.torques,
        span=_span(run),
    )


def _span(run: Run) -> Span:
    states = run.file.states
    return Span(
        session=run.session,
        rig=run.rig,
        is_manual=not run.controller,
        start_ns=run.number("session", "start_wall_ns") or 0,
        end_ns=run.number("summary", "end_wall_ns") or 0,
        incarnations=() if states is None else tuple(one.incarnation for one in states),
    )


def under_command(run: Run, states: Rows) -> NDArray[np.bool_]:
    """Whether a command of the session's controller acts at each state, shape (n,).

    Commands before the start of the session can belong to the previous session.
    """
    if run.controller:
        return np.asarray((states["command_seq"] > 0) & (states["session"] == run.names.code(run.session)))
    # A manual recording can contain several controllers; without one, the internal zero-torque command acts.
    return np.asarray((states["basis_step"] != 0) | (states["effort"] != 0).any(axis=1))


def _box_ms(latency: LatencyReport) -> tuple[float, ...]:
    if not latency.samples:
        return ()
    return tuple((percentiles(latency.table.column("loop"), (1, 25, 50, 75, 99)) / 1e6).tolist())


class _Collector:
    """Accumulates the summary of a run block by block."""

    def __init__(self, run: Run, parameters: RigParameters, task: TaskConfig | None) -> None:
        self._run = run
        self._parameters = parameters
        self._grader = None if task is None else Grader(task, parameters)
        self._every = max(1, run.file.counts["state"] // TRAJECTORY_POINTS)
        self._pieces: list[tuple[Floats, Rows, Floats]] = []
        self._seen = 0
        self._acting = 0
        self._last: tuple[Rows, Floats] | None = None
        self._path = self._top_speed = self._work = 0.0
        self._peak, self._saturated = np.zeros(4), np.zeros(4)
        self._poses: dict[str, Any] = {}
        self._held = ""
        self.events: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self.alarms = 0
        self.torques = TorqueSketch()

    def add(self, block: Records) -> None:
        for event in block.events:
            self.events[event["kind"]][event["severity"]] += 1
            self.alarms += event["message"].severity >= Event.WARNING
        names = self._run.names
        written = block.commands[(block.commands["controller"] != names.code("")) & ~block.commands["safe"]]
        self.torques.add(written["effort"])
        if self._grader is not None:
            dropped = block.events[block.events["kind"] == Event.Kind.Name(Event.PART_DROPPED)]
            for event, time_s in zip(dropped, self._run.time_s(dropped), strict=True):
                self._grader.add_drop(event["message"].part_data.part, float(time_s))
        for row in _last_of_each_part(block.parts):
            name = names[int(row["part"])]
            self._poses[name] = SimpleNamespace(name=name, x=float(row["x"]), y=float(row["y"]), z=float(row["z"]))
        if len(block.states):
            self._add_states(block.states)

    def _add_states(self, states: Rows) -> None:
        self._held = self._run.names[int(states["held_part"][-1])]
        time_s = self._run.time_s(states)
        pose = np.ascontiguousarray(forward(self._parameters.arm, states["position"].T).T)
        tip = pose[:, :3]
        if self._grader is not None:
            jacobians = jacobian(self._parameters.arm, states["position"].T)
            velocity = np.einsum("ijn,nj->ni", jacobians, states["velocity"])
            self._grader.add_states(time_s, pose, velocity, under_command(self._run, states))
        self._add_motion(states, tip)
        first = -self._seen % self._every
        self._pieces.append(
            (
                # Copied, because a view would keep the complete block in memory.
                time_s[first :: self._every].copy(),
                states[first :: self._every].copy(),
                tip[first :: self._every].copy(),
            )
        )
        self._seen += len(states)

    def _add_motion(self, states: Rows, tip: Floats) -> None:
        """Add path, speed, work and efforts while a controller acts: from each such state to the next one."""
        if self._last is not None:
            states, tip = np.concatenate((self._last[0], states)), np.concatenate((self._last[1], tip))
        self._last = states[-1:].copy(), tip[-1:].copy()
        acts = under_command(self._run, states) & (states["effort"] != 0).any(axis=1)
        follows = np.diff(states["step"].astype(np.int64)) == 1
        follows &= states["incarnation"][1:] == states["incarnation"][:-1]
        rows = np.flatnonzero(acts[:-1] & follows)
        lengths = np.linalg.norm(tip[rows + 1] - tip[rows], axis=1)
        step_s = self._run.step_ns / 1e9
        self._path += float(lengths.sum())
        self._top_speed = max(self._top_speed, float(lengths.max(initial=0.0)) / step_s)
        # The effort is constant over a step: trapezoidal rule for the speed.
        effort, velocity = np.abs(states["effort"][rows]), np.abs(states["velocity"])
        self._work += float((effort * (velocity[rows] + velocity[rows + 1]) / 2).sum()) * step_s
        self._acting += len(rows)
        self._peak = np.maximum(self._peak, effort.max(axis=0, initial=0.0))
        self._saturated += (effort >= _SATURATED).sum(axis=0)

    def grade(self) -> Grade | None:
        return None if self._grader is None else self._grader.grade(self.placement())

    def motion(self) -> Motion:
        return Motion(
            tool_path_m=self._path,
            top_speed=self._top_speed,
            work_j=self._work,
            peak_effort=joint_values(self._peak),
            saturated_share=joint_values(self._saturated / max(self._acting, 1)),
        )

    def placement(self) -> PlacementReport | None:
        scene = self._parameters.scene
        if not scene.parts or not any(tray.places for tray in scene.trays):
            return None
        return evaluate_placement(scene, list(self._poses.values()), held=self._held)

    def trajectory(self) -> Trajectory:
        states = np.concatenate([states for _, states, _ in self._pieces])
        return Trajectory(
            time_s=np.concatenate([time_s for time_s, _, _ in self._pieces]),
            position=np.ascontiguousarray(states["position"]),
            velocity=np.ascontiguousarray(states["velocity"]),
            effort=np.ascontiguousarray(states["effort"]),
            tip=np.concatenate([tip for _, _, tip in self._pieces]),
        )


def _last_of_each_part(parts: Rows) -> list[np.void]:
    codes, last = np.unique(parts["part"][::-1], return_index=True)
    return [parts[len(parts) - 1 - at] for at in last[: len(codes)]]
