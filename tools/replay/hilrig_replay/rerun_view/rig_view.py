"""Writes a rig as rerun entities: the arm in three dimensions, time series, loop latency, and events.

`RerunRigWriter` writes one rig into a rerun recording, block by block, as columns. The blocks are read from a file
(`view`) or received from the bus (`live`). All entities of a rig have a common root path, so that one viewer can show
several runs.
"""

import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.urdf import UrdfTree

from hilrig_replay.analysis.age import AgeTracker
from hilrig_replay.analysis.data_quality import tick_lateness_ns
from hilrig_replay.analysis.samples import CommandMatcher, join_commands
from hilrig_replay.analysis.stages import Stage, stages_of_role
from hilrig_replay.geometry.quaternion import about_z
from hilrig_replay.geometry.scene import ArmGeometry, parameters_of, parse_arm, tool_positions, workspace_outline
from hilrig_replay.io.columns import Rows, StringTable
from hilrig_replay.io.records import Records
from hilrig_replay.io.timebase import Timebase
from hilrig_replay.plots.palette import (
    AGE_COLOR,
    EFFORT_SYMBOLS,
    EVENT_COLORS,
    JOINT_COLORS,
    JOINT_SYMBOLS,
    PALE_JOINT_COLORS,
    RUN_COLORS,
    event_title,
    rgb,
    severity_color,
)
from hilrig_replay.rerun_view import entity_paths as paths
from hilrig_replay.rerun_view.entity_paths import arm_path, entity_path
from hilrig_replay.rerun_view.layout import SIM_TIME, STEP, WALL
from hilrig_replay.rerun_view.request_rates import BIN_NS, KINDS, MAX_CLIENTS, OTHER_CLIENTS, Rate, RequestRates
from hilrig_runtime.config.task import TaskConfig
from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_sim.arm.model import PartParameters, RigParameters
from hilrig_sim.arm.urdf import urdf

_SAFE: Final = "safe zero"
_NO_CONTROLLER: Final = "no controller"
_TRAIL_COLOR: Final = "#f2b134"
_BASELINE_COLOR: Final = "#5b6570"
_WORKSPACE_COLOR: Final = "#3f6f8f"
_TASK_COLOR: Final = "#6fd08c"
_MIN_TARGET_RADIUS_M: Final = 0.004
"""A pose target is drawn with its tolerance as radius, but at least with this one, m."""
_YAW_ARROW_LENGTH_M: Final = 0.04
_UNKNOWN_PART_COLOR: Final = "#c8ccd0"
_UNKNOWN_PART_SIZE_M: Final = (0.03, 0.03, 0.03)
_NOT_IN_PATH: Final = re.compile(r"[^\w.-]")
"""Characters that an entity path must not contain."""
_REQUEST_COLORS: Final = dict(zip(KINDS, ("#4c78a8", "#f58518", "#e45756"), strict=True))


@dataclass(frozen=True, slots=True)
class RigGeometry:
    """Static description of a rig: arm, parameters, step and task."""

    arm: ArmGeometry
    parameters: RigParameters
    step_ns: int
    task: TaskConfig | None = None

    @classmethod
    def of(cls, urdf_text: str, parameters_json: str, step_ns: int, task: TaskConfig | None = None) -> "RigGeometry":
        """Build from the texts of a recording or a running simulation; empty texts give the defaults.

        Raises:
            InputError: a text is invalid.
        """
        parameters = parameters_of(parameters_json)
        return cls(parse_arm(urdf_text or urdf(parameters)), parameters, step_ns, task)


class RerunRigWriter:
    """Writes one rig; `root` is the root of its entity paths, empty if it is the only rig."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        geometry: RigGeometry,
        timebase: Timebase,
        names: StringTable,
        *,
        root: str = "",
        color: str | None = None,
    ) -> None:
        self._stream = stream
        self._geometry = geometry
        self._timebase = timebase
        self._names = names
        self._root = root
        self._color = color
        self._matcher = CommandMatcher()
        self._ages = AgeTracker()
        self._had_age = False
        self._current_states: dict[str, str] = {}
        self._torque_source = ""
        self._source_colors = {_SAFE: "#e45756", _NO_CONTROLLER: "#3a424c"}
        self._rates = RequestRates(names)
        self._known_clients: set[str] = set()
        self.client_role = False
        """Whether the edge is the client of the controller; known with the first loop latency."""
        self.largest_age_ms = 0.0
        self._stages: tuple[Stage, ...] = ()
        """Stages of the role; empty: not known yet."""
        self._last_tip: NDArray[np.float64] | None = None
        self._known_parts: set[str] = set()
        self._known_event_kinds: set[str] = set()
        self._write_scene()
        self._write_legends()

    def update_geometry(self, geometry: RigGeometry) -> None:
        """Draw the rig again if its geometry has changed."""
        before, self._geometry = self._geometry, geometry
        changed = (geometry.arm.urdf, geometry.parameters, geometry.task)
        if changed != (before.arm.urdf, before.parameters, before.task):
            self._write_scene()

    # -- static entities --------------------------------------------------------------------------------------------

    def _write_scene(self) -> None:
        self._static(paths.SCENE, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        scene = self._geometry.parameters.scene
        self._write_arm(self._geometry.arm)
        for part in scene.parts:
            self._place_part(part)
        outline = workspace_outline(self._geometry.parameters.arm, scene.table_height + 0.002)
        trail = rgb(self._color or _TRAIL_COLOR)
        self._static(paths.TRAIL, rr.LineStrips3D.from_fields(colors=[trail], radii=[0.002]))
        self._static(paths.WORKSPACE, rr.LineStrips3D(outline, colors=[rgb(_WORKSPACE_COLOR)], radii=[0.0012]))
        if self._geometry.task is not None:
            self._write_task(self._geometry.task)

    def _write_task(self, task: TaskConfig) -> None:
        for pose in task.poses:
            at = [length / 1000 for length in pose.position_mm]
            path, color = f"{paths.TASK}/{pose.name}", rgb(_TASK_COLOR)
            radius = max(pose.tolerance_mm / 1000, _MIN_TARGET_RADIUS_M)
            self._static(path, rr.Points3D([at], radii=[radius], colors=[color], labels=[pose.name]))
            if pose.yaw_deg is not None:
                yaw = np.radians(pose.yaw_deg)
                arrow = [_YAW_ARROW_LENGTH_M * np.cos(yaw), _YAW_ARROW_LENGTH_M * np.sin(yaw), 0.0]
                self._static(f"{path}/yaw", rr.Arrows3D(origins=[at], vectors=[arrow], radii=[0.001], colors=[color]))
        if task.path is not None:
            points = np.array(task.path.points_mm) / 1000
            self._static(paths.TASK_PATH, rr.LineStrips3D([points], radii=[0.0015], colors=[rgb(_TASK_COLOR)]))

    def _write_arm(self, arm: ArmGeometry) -> None:
        path = arm_path(self._root)
        frames = f"{path}_"
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "arm.urdf"
            file.write_text(arm.urdf, encoding="utf-8")
            tree = UrdfTree.from_file_path(
                file,
                entity_path_prefix=path,
                frame_prefix=frames,
                static_transform_entity_path=f"{path}/fixed",
            )
        tree.log_urdf_to_recording(self._stream)
        # The URDF uses named frames, all other entities use the path tree: this attaches the arm's root to the scene.
        self._static(
            paths.ARM_ROOT,
            rr.Transform3D(parent_frame=f"tf#{entity_path(self._root, paths.SCENE)}", child_frame=frames + arm.root),
        )
        self._frames = frames
        for link, number, shape in arm.primitives:
            visuals = tree.get_visual_geometry_paths(link)
            if number < len(visuals):
                # By default rerun draws primitives as transparent shapes with edges.
                archetype: Any = {"box": rr.Boxes3D, "cylinder": rr.Cylinders3D, "sphere": rr.Ellipsoids3D}[shape]
                # With several arms in one scene, movable links have the color of their run.
                colors = None if self._color is None or link == arm.root else [rgb(self._color)]
                self._stream.log(visuals[number], archetype.from_fields(fill_mode="solid", colors=colors), static=True)

    def _place_part(self, part: PartParameters) -> None:
        path = f"{paths.PARTS}/{part.name}"
        self._known_parts.add(part.name)
        color = rgb(part.colour)
        if part.shape == "cylinder":
            shape: Any = rr.Cylinders3D(
                lengths=[part.size[2]], radii=[part.size[0] / 2], colors=[color], fill_mode="solid"
            )
        else:
            half = tuple(length / 2 for length in part.size)
            shape = rr.Boxes3D(half_sizes=[half], colors=[color], fill_mode="solid")
        self._static(path, shape)
        self._static(path, rr.Transform3D(translation=part.position, rotation=rr.Quaternion(xyzw=about_z(part.yaw))))

    def _write_legends(self) -> None:
        self._legend(paths.POSITION, JOINT_SYMBOLS, JOINT_COLORS)
        self._legend(paths.VELOCITY, JOINT_SYMBOLS, JOINT_COLORS)
        self._legend(paths.COMMANDED_EFFORT, [f"{name} commanded" for name in EFFORT_SYMBOLS], PALE_JOINT_COLORS, 0.8)
        self._legend(paths.APPLIED_EFFORT, [f"{name} applied" for name in EFFORT_SYMBOLS], JOINT_COLORS)
        self._legend(paths.LOOP_LATENCY, ["loop latency"], ["#e0e4e8"])
        self._state_legend("magnet", {"on": "#e45756", "off": "#3a424c"})
        self._state_legend("part", {part.name: part.colour for part in self._geometry.parameters.scene.parts})
        self._legend(paths.LOOP_AGE, ["age"], [AGE_COLOR])
        self._legend(paths.TICK_LATENESS, ["tick lateness"], ["#e45756"])

    def _legend(self, path: str, names: Sequence[str], colors: Iterable[str], width: float = 1.5) -> None:
        shades = [rgb(color) for color in colors] if self._color is None else [rgb(self._color)] * len(names)
        prefix = f"{self._root} " if self._root else ""
        lines = rr.SeriesLines(names=[prefix + name for name in names], colors=shades, widths=[width] * len(names))
        self._static(path, lines)

    def _state_legend(self, name: str, colors: Mapping[str, str]) -> None:
        shades = [rgb(color) for color in colors.values()]
        self._static(f"{paths.STATES}/{name}", rr.StateConfiguration(values=list(colors), colors=shades))

    # -- time-dependent entities ------------------------------------------------------------------------------------

    def add(self, records: Records) -> None:
        """Write the next block; the timebase must already include its states."""
        if len(records.commands):
            self._add_commands(records.commands)
        if len(records.states):
            self._add_states(records.states)
            self._add_ages(records.states)
            self._add_state("torque", records.states, self._torque_sources(records.states, records.commands))
        if len(records.parts):
            self._add_parts(records.parts)
        samples = self._matcher.add(records.states, records.commands)
        if len(samples):
            self._add_latency(samples)
        if len(records.traffic):
            self._add_rates(self._rates.add(records.traffic))
        if len(records.events):
            self._add_events(records.events)

    def end(self) -> None:
        """Write buffered data; no more blocks follow."""
        self._add_rates(self._rates.end())

    def _add_states(self, states: Rows) -> None:
        times = self._times(states)
        q = np.ascontiguousarray(states["position"])
        self._scalars(paths.POSITION, times, q * JOINT_SCALE)
        self._scalars(paths.VELOCITY, times, states["velocity"] * JOINT_SCALE)
        self._scalars(paths.APPLIED_EFFORT, times, states["effort"])
        self._scalars(paths.TICK_LATENESS, times, tick_lateness_ns(states, self._geometry.step_ns)[:, None] / 1e6)
        self._add_pose(times, q)
        self._add_state("magnet", states, np.where(states["magnet"], "on", "off").astype(object))
        self._add_state("part", states, self._names.texts(states["held_part"]))
        self._add_state("limits", states, _limits(states["limit_flags"]))

    def _add_ages(self, states: Rows) -> None:
        age_ns = self._ages.add(states)["age_ns"]
        aged = age_ns > 0
        # The first step without an age ends the line.
        shown = aged | np.concatenate(([self._had_age], aged[:-1]))
        self._had_age = bool(aged[-1])
        if shown.any():
            ages_ms = np.where(aged, age_ns / 1e6, np.nan)[shown]
            self.largest_age_ms = max(self.largest_age_ms, float(age_ns.max()) / 1e6)
            self._scalars(paths.LOOP_AGE, self._times(states[shown]), ages_ms[:, None])

    def _add_pose(self, times: list[rr.TimeColumn], q: NDArray[np.float64]) -> None:
        for joint, values in zip(self._geometry.arm.joints, q.T, strict=True):
            translations, rotations = joint.transforms(values)
            columns = rr.Transform3D.columns(
                translation=translations,
                quaternion=rotations,
                parent_frame=[self._frames + joint.parent] * len(values),
                child_frame=[self._frames + joint.child] * len(values),
            )
            self._send(f"{paths.JOINTS}/{joint.name}", times, columns)
        points = tool_positions(self._geometry.parameters.arm, q)
        before = points[:1] if self._last_tip is None else self._last_tip
        # One array: with a list of strips rerun takes thirty times as long.
        segments: Any = np.stack((np.concatenate((before, points[:-1])), points), axis=1)
        self._last_tip = points[-1:]
        self._send(paths.TRAIL, times, rr.LineStrips3D.columns(strips=segments))

    def _add_parts(self, parts: Rows) -> None:
        for code in np.unique(parts["part"]):
            name = self._names[int(code)]
            rows = parts[parts["part"] == code]
            if name not in self._known_parts:
                unknown = PartParameters(
                    name, "box", _UNKNOWN_PART_SIZE_M, 0.1, True, _UNKNOWN_PART_COLOR, (0.0, 0.0, 0.0), 0.0
                )
                self._place_part(unknown)
            self._send(
                f"{paths.PARTS}/{name}",
                self._times(rows),
                rr.Transform3D.columns(
                    translation=np.stack((rows["x"], rows["y"], rows["z"]), axis=1),
                    quaternion=about_z(rows["yaw"]),
                ),
            )

    def _add_commands(self, commands: Rows) -> None:
        times = self._times(commands)
        self._scalars(paths.COMMANDED_EFFORT, times, commands["effort"])

    def _add_latency(self, samples: Rows) -> None:
        times = self._times(samples)
        self._scalars(paths.LOOP_LATENCY, times, samples["loop"][:, None] / 1e6)
        if not self._stages:
            self.client_role = bool(samples["polled"].mean() >= 0.5)
            self._stages = stages_of_role(self.client_role)
            names = ["state sampled", *(f"+ {stage.title}" for stage in self._stages)]
            names[-1] += " = loop"
            self._legend(paths.LATENCY_STAGES, names, [_BASELINE_COLOR, *(stage.color for stage in self._stages)])
        ends = np.cumsum(np.stack([samples[stage.key] for stage in self._stages], axis=1), axis=1) / 1e6
        self._scalars(paths.LATENCY_STAGES, times, np.hstack((np.zeros((len(ends), 1)), ends)))

    def _add_rates(self, rates: Iterable[Rate]) -> None:
        for client, kind, begins_ns, counts in rates:
            path = f"{paths.MODBUS}/{_NOT_IN_PATH.sub('_', client)}/{kind}"
            if path not in self._known_clients:
                self._known_clients.add(path)
                line = rr.SeriesLines(names=[f"{client} {kind}"], colors=[rgb(_REQUEST_COLORS[kind])], widths=[1.5])
                self._static(path, line)
            at = np.zeros(len(counts), np.dtype([("wall_ns", "<i8")]))
            at["wall_ns"] = begins_ns
            self._scalars(path, self._times(at), counts[:, None] * (1e9 / BIN_NS))

    def _add_events(self, events: Rows) -> None:
        texts = [f"{event_title(kind)}: {text}" for kind, text in zip(events["kind"], events["text"], strict=True)]
        levels = ["WARN" if severity == "WARNING" else severity for severity in events["severity"]]
        colors = [rgb(severity_color(severity)) for severity in events["severity"]]
        self._send(paths.EVENTS, self._times(events), rr.TextLog.columns(text=texts, level=levels, color=colors))
        for kind in np.unique(events["kind"]):
            rows = events[events["kind"] == kind]
            if kind not in self._known_event_kinds:
                self._known_event_kinds.add(kind)
                color = rgb(EVENT_COLORS.get(kind, severity_color(rows["severity"][0])))
                markers = rr.SeriesPoints(
                    names=[event_title(kind)], colors=[color], markers=["diamond"], marker_sizes=[6.0]
                )
                self._static(f"{paths.EVENT_MARKERS}/{kind.lower()}", markers)
            # At zero: the texts are in the event log.
            self._scalars(f"{paths.EVENT_MARKERS}/{kind.lower()}", self._times(rows), np.zeros((len(rows), 1)))

    def _torque_sources(self, states: Rows, commands: Rows) -> NDArray[np.object_]:
        """Source of the applied torque for each state: the address of the controller that wrote the active command."""
        # The command of a state may be in an earlier block: the last known source holds until a newer one is found.
        source = np.full(len(states), self._torque_source, dtype=object)
        rows, found = join_commands(states, commands)
        if found.any():
            at = np.maximum.accumulate(np.where(found, np.arange(len(states)), -1))
            known = self._names.texts(commands["controller"][rows])
            known[commands["safe"][rows]] = _SAFE
            source[at >= 0] = known[at[at >= 0]]
            self._torque_source = str(source[-1])
        source[states["command_seq"] == 0] = _NO_CONTROLLER
        source[states["safe"]] = _SAFE
        self._assign_colors(source)
        return source

    def _assign_colors(self, sources: NDArray[np.object_]) -> None:
        """Assign a color to each source; those beyond the first `MOST` are merged, as in the request rates."""
        new = sorted(set(sources) - {""} - self._source_colors.keys())
        room = max(MAX_CLIENTS - len(self._source_colors), 0)
        if new[room:]:
            sources[[source in new[room:] for source in sources]] = OTHER_CLIENTS
            new = new[:room] if OTHER_CLIENTS in self._source_colors else [*new[:room], OTHER_CLIENTS]
        if new:
            for source in new:
                self._source_colors[source] = RUN_COLORS[len(self._source_colors) % len(RUN_COLORS)]
            self._state_legend("torque", self._source_colors)

    # -- helpers ----------------------------------------------------------------------------------------------------

    def _add_state(self, name: str, rows: Rows, values: NDArray[np.object_]) -> None:
        """Add to a state timeline; only changes are written."""
        changed = np.ones(len(values), np.bool_)
        changed[0] = values[0] != self._current_states.get(name)
        changed[1:] = values[1:] != values[:-1]
        self._current_states[name] = values[-1]
        if changed.any():
            states = [str(value) for value in values[changed]]
            self._send(f"{paths.STATES}/{name}", self._times(rows[changed]), rr.StateChange.columns(state=states))

    def _times(self, rows: Rows) -> list[rr.TimeColumn]:
        return [
            rr.TimeColumn(SIM_TIME, duration=self._timebase.time_ns(rows).astype("timedelta64[ns]")),
            # The smallest number of 64 bits means that there is no time.
            rr.TimeColumn(WALL, timestamp=np.maximum(rows["wall_ns"], -(1 << 62)).astype("datetime64[ns]")),
            rr.TimeColumn(STEP, sequence=self._timebase.steps(rows, self._geometry.step_ns)),
        ]

    def _scalars(self, path: str, times: list[rr.TimeColumn], values: NDArray[np.floating]) -> None:
        self._send(path, times, rr.Scalars.columns(scalars=np.ascontiguousarray(values)))

    def _send(self, path: str, times: list[rr.TimeColumn], columns: Any) -> None:
        rr.send_columns(entity_path(self._root, path), times, columns, recording=self._stream)

    def _static(self, path: str, archetype: Any) -> None:
        self._stream.log(entity_path(self._root, path), archetype, static=True)


def _limits(flags: NDArray[np.uint16]) -> NDArray[np.object_]:
    unique, inverse = np.unique(flags, return_inverse=True)
    return np.array([_limit_names(int(value)) for value in unique], dtype=object)[inverse]


def _limit_names(flags: int) -> str:
    found = [f"{symbol} lower" for joint, symbol in enumerate(JOINT_SYMBOLS) if flags >> joint & 1]
    found += [f"{symbol} upper" for joint, symbol in enumerate(JOINT_SYMBOLS) if flags >> (joint + 4) & 1]
    if flags >> 8 & 1:
        found.append("tool contact")
    return ", ".join(found)
