"""A rig in the rerun viewer: the arm in three dimensions, its curves, its latency, its events.

`RigView` writes one rig into a rerun recording, block by block and column by column, and does not care whether the
blocks come out of a file (`replay`) or off the bus (`live`). Everything of a rig is under one entity path, so that
several runs stand beside each other in one viewer.
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

from hilrig_replay.analysis.data_quality import tick_lateness_ns
from hilrig_replay.analysis.request_rates import BIN_NS, MAX_CLIENTS, OTHER_CLIENTS, Rate, RequestRates
from hilrig_replay.analysis.samples import STAGES, CommandMatcher, join_commands
from hilrig_replay.io.columns import Rows, StringTable
from hilrig_replay.io.records import Records
from hilrig_replay.io.timebase import Timebase
from hilrig_replay.plots.palette import (
    EFFORT_SYMBOLS,
    EVENT_COLORS,
    JOINT_COLORS,
    JOINT_SYMBOLS,
    PALE_JOINT_COLORS,
    RUN_COLORS,
    SEVERITY_COLORS,
    STAGE_COLORS,
    STAGE_NAMES,
    rgb,
)
from hilrig_replay.rerun_view.layout import SIM_TIME, STEP, WALL, arm_path
from hilrig_replay.rerun_view.scene import ArmPicture, parameters_of, reach_outline, read_arm, tips
from hilrig_runtime.config.task import TaskConfig
from hilrig_sim.arm.model import JOINT_SCALE, PartParameters, RigParameters
from hilrig_sim.arm.urdf import urdf

_SAFE: Final = "safe zero"
_NOBODY: Final = "nobody"
_TRAIL_COLOR: Final = "#f2b134"
_BASELINE_COLOR: Final = "#5b6570"
_REACH_COLOR: Final = "#3f6f8f"
_TASK_COLOR: Final = "#6fd08c"
_SMALLEST_TARGET: Final = 0.004
"""A pose's target is drawn as large as its tolerance, but no smaller than this, m."""
_YAW_ARROW: Final = 0.04
_PART_COLOR: Final = "#c8ccd0"
_PART_SIZE: Final = (0.03, 0.03, 0.03)
_OTHER_EVENT: Final = "#9aa5b1"
_UNSAFE: Final = re.compile(r"[^\w.-]")
"""What does not belong into an entity path."""
_KIND_COLORS: Final = {"reads": "#4c78a8", "writes": "#f58518"}


@dataclass(frozen=True, slots=True)
class Drawn:
    """What of a rig does not change while it runs."""

    arm: ArmPicture
    parameters: RigParameters
    step_ns: int
    task: TaskConfig | None = None

    @classmethod
    def of(cls, urdf_text: str, parameters_json: str, step_ns: int, task: TaskConfig | None = None) -> "Drawn":
        """What a recording or a running simulation says of its rig; what it does not say is as by default.

        Raises:
            InputError: it says something that is not understood.
        """
        parameters = parameters_of(parameters_json)
        return cls(read_arm(urdf_text or urdf(parameters)), parameters, step_ns, task)


class RigView:
    """Writes one rig; `root` is the entity path that all of it goes under, empty for the only one."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        drawn: Drawn,
        timebase: Timebase,
        names: StringTable,
        *,
        root: str = "",
        color: str | None = None,
    ) -> None:
        self._stream = stream
        self._drawn = drawn
        self._timebase = timebase
        self._names = names
        self._root = root
        self._color = color
        self._matcher = CommandMatcher()
        self._lanes: dict[str, str] = {}
        self._holder = ""
        self._holders = {_SAFE: "#e45756", _NOBODY: "#3a424c"}
        self._rates = RequestRates(names)
        self._clients: set[str] = set()
        self._last_tip: NDArray[np.float64] | None = None
        self._placed: set[str] = set()
        self._marked: set[str] = set()
        self._write_scene()
        self._write_legends()

    def draw(self, drawn: Drawn) -> None:
        """Draw the rig anew where it has become another one."""
        before, self._drawn = self._drawn, drawn
        if (drawn.arm.urdf, drawn.parameters, drawn.task) != (before.arm.urdf, before.parameters, before.task):
            self._write_scene()

    # -- what does not change ---------------------------------------------------------------------------------------

    def _write_scene(self) -> None:
        self._static("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        scene = self._drawn.parameters.scene
        self._write_arm(self._drawn.arm)
        for part in scene.parts:
            self._place_part(part)
        outline = reach_outline(self._drawn.parameters.arm, scene.table_height + 0.002)
        trail = rgb(self._color or _TRAIL_COLOR)
        self._static("scene/trail", rr.LineStrips3D.from_fields(colors=[trail], radii=[0.002]))
        self._static("scene/reach", rr.LineStrips3D(outline, colors=[rgb(_REACH_COLOR)], radii=[0.0012]))
        if self._drawn.task is not None:
            self._write_task(self._drawn.task)

    def _write_task(self, task: TaskConfig) -> None:
        for pose in task.poses:
            at = [length / 1000 for length in pose.position_mm]
            path, color = f"scene/task/{pose.name}", rgb(_TASK_COLOR)
            radius = max(pose.tolerance_mm / 1000, _SMALLEST_TARGET)
            self._static(path, rr.Points3D([at], radii=[radius], colors=[color], labels=[pose.name]))
            if pose.yaw_deg is not None:
                yaw = np.radians(pose.yaw_deg)
                arrow = [_YAW_ARROW * np.cos(yaw), _YAW_ARROW * np.sin(yaw), 0.0]
                self._static(f"{path}/yaw", rr.Arrows3D(origins=[at], vectors=[arrow], radii=[0.001], colors=[color]))
        if task.path is not None:
            points = np.array(task.path.points_mm) / 1000
            self._static("scene/task/path", rr.LineStrips3D([points], radii=[0.0015], colors=[rgb(_TASK_COLOR)]))

    def _write_arm(self, arm: ArmPicture) -> None:
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
        # The URDF has named frames, all else the tree of paths: this hangs the arm's root into the scene.
        self._static(
            "scene/arm_root",
            rr.Transform3D(parent_frame=f"tf#/{self._path('scene')}", child_frame=frames + arm.root),
        )
        self._frames = frames
        for link, number, shape in arm.solids:
            paths = tree.get_visual_geometry_paths(link)
            if number < len(paths):
                # As it comes, a primitive is drawn transparent with its edges.
                solid: Any = {"box": rr.Boxes3D, "cylinder": rr.Cylinders3D, "sphere": rr.Ellipsoids3D}[shape]
                # Of several arms in one scene each has its run's colour; what stands still is the same for all.
                own = None if self._color is None or link == arm.root else [rgb(self._color)]
                self._stream.log(paths[number], solid.from_fields(fill_mode="solid", colors=own), static=True)

    def _place_part(self, part: PartParameters) -> None:
        path = f"scene/parts/{part.name}"
        self._placed.add(part.name)
        color = rgb(part.colour)
        if part.shape == "cylinder":
            shape: Any = rr.Cylinders3D(
                lengths=[part.size[2]], radii=[part.size[0] / 2], colors=[color], fill_mode="solid"
            )
        else:
            half = tuple(length / 2 for length in part.size)
            shape = rr.Boxes3D(half_sizes=[half], colors=[color], fill_mode="solid")
        self._static(path, shape)
        self._static(path, rr.Transform3D(translation=part.position, rotation=_about_z(part.yaw)))

    def _write_legends(self) -> None:
        self._legend("position", JOINT_SYMBOLS, JOINT_COLORS)
        self._legend("velocity", JOINT_SYMBOLS, JOINT_COLORS)
        self._legend("effort/commanded", [f"{name} commanded" for name in EFFORT_SYMBOLS], PALE_JOINT_COLORS, 0.8)
        self._legend("effort/applied", [f"{name} applied" for name in EFFORT_SYMBOLS], JOINT_COLORS)
        ends = ["state sampled", *(f"+ {STAGE_NAMES[stage]}" for stage in STAGES[:-1]), "+ transport = loop"]
        self._legend("stages", ends, [_BASELINE_COLOR, *(STAGE_COLORS[stage] for stage in STAGES)])
        self._legend("loop", ["loop latency"], ["#e0e4e8"])
        self._lane_legend("magnet", {"on": "#e45756", "off": "#3a424c"})
        self._lane_legend("part", {part.name: part.colour for part in self._drawn.parameters.scene.parts})
        self._legend("lateness", ["tick lateness"], ["#e45756"])

    def _legend(self, path: str, names: Sequence[str], colors: Iterable[str], width: float = 1.5) -> None:
        shades = [rgb(color) for color in colors] if self._color is None else [rgb(self._color)] * len(names)
        whose = f"{self._root} " if self._root else ""
        lines = rr.SeriesLines(names=[whose + name for name in names], colors=shades, widths=[width] * len(names))
        self._static(path, lines)

    def _lane_legend(self, lane: str, colors: Mapping[str, str]) -> None:
        shades = [rgb(color) for color in colors.values()]
        self._static(f"lanes/{lane}", rr.StateConfiguration(values=list(colors), colors=shades))

    # -- what changes -----------------------------------------------------------------------------------------------

    def add(self, records: Records) -> None:
        """Write the next piece; its states must be known to the timebase."""
        if len(records.commands):
            self._add_commands(records.commands)
        if len(records.states):
            self._add_states(records.states)
            self._lane("torque", records.states, self._torque_source(records.states, records.commands))
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
        """Write what waited for more: nothing comes any more."""
        self._add_rates(self._rates.end())

    def _add_states(self, states: Rows) -> None:
        times = self._times(states)
        q = np.ascontiguousarray(states["position"])
        self._scalars("position", times, q * JOINT_SCALE)
        self._scalars("velocity", times, states["velocity"] * JOINT_SCALE)
        self._scalars("effort/applied", times, states["effort"])
        self._scalars("lateness", times, tick_lateness_ns(states, self._drawn.step_ns)[:, None] / 1e6)
        self._add_pose(times, q)
        self._lane("magnet", states, np.where(states["magnet"], "on", "off").astype(object))
        self._lane("part", states, self._names.texts(states["held_part"]))
        self._lane("stops", states, _stops(states["limit_flags"]))

    def _add_pose(self, times: list[rr.TimeColumn], q: NDArray[np.float64]) -> None:
        for joint, values in zip(self._drawn.arm.joints, q.T, strict=True):
            translations, rotations = joint.transforms(values)
            columns = rr.Transform3D.columns(
                translation=translations,
                quaternion=rotations,
                parent_frame=[self._frames + joint.parent] * len(values),
                child_frame=[self._frames + joint.child] * len(values),
            )
            self._send(f"scene/joints/{joint.name}", times, columns)
        points = tips(self._drawn.parameters.arm, q)
        before = points[:1] if self._last_tip is None else self._last_tip
        # As one array: strips given one by one take rerun thirty times as long.
        segments: Any = np.stack((np.concatenate((before, points[:-1])), points), axis=1)
        self._last_tip = points[-1:]
        self._send("scene/trail", times, rr.LineStrips3D.columns(strips=segments))

    def _add_parts(self, parts: Rows) -> None:
        for code in np.unique(parts["part"]):
            name = self._names[int(code)]
            rows = parts[parts["part"] == code]
            if name not in self._placed:
                unknown = PartParameters(name, "box", _PART_SIZE, 0.1, True, _PART_COLOR, (0.0, 0.0, 0.0), 0.0)
                self._place_part(unknown)
            half = rows["yaw"] / 2
            zero = np.zeros(len(rows))
            self._send(
                f"scene/parts/{name}",
                self._times(rows),
                rr.Transform3D.columns(
                    translation=np.stack((rows["x"], rows["y"], rows["z"]), axis=1),
                    quaternion=np.stack((zero, zero, np.sin(half), np.cos(half)), axis=1),
                ),
            )

    def _add_commands(self, commands: Rows) -> None:
        times = self._times(commands)
        self._scalars("effort/commanded", times, commands["effort"])

    def _add_latency(self, samples: Rows) -> None:
        times = self._times(samples)
        self._scalars("loop", times, samples["loop"][:, None] / 1e6)
        ends = np.cumsum(np.stack([samples[stage] for stage in STAGES], axis=1), axis=1) / 1e6
        self._scalars("stages", times, np.hstack((np.zeros((len(ends), 1)), ends)))

    def _add_rates(self, rates: Iterable[Rate]) -> None:
        for client, kind, begins_ns, counts in rates:
            path = f"modbus/{_UNSAFE.sub('_', client)}/{kind}"
            if path not in self._clients:
                self._clients.add(path)
                line = rr.SeriesLines(names=[f"{client} {kind}"], colors=[rgb(_KIND_COLORS[kind])], widths=[1.5])
                self._static(path, line)
            at = np.zeros(len(counts), np.dtype([("wall_ns", "<i8")]))
            at["wall_ns"] = begins_ns
            self._scalars(path, self._times(at), counts[:, None] * (1e9 / BIN_NS))

    def _add_events(self, events: Rows) -> None:
        texts = [
            f"{kind.replace('_', ' ').lower()}: {text}"
            for kind, text in zip(events["kind"], events["text"], strict=True)
        ]
        levels = ["WARN" if severity == "WARNING" else severity for severity in events["severity"]]
        colors = [rgb(SEVERITY_COLORS.get(severity, _OTHER_EVENT)) for severity in events["severity"]]
        self._send("events", self._times(events), rr.TextLog.columns(text=texts, level=levels, color=colors))
        for kind in np.unique(events["kind"]):
            mine = events[events["kind"] == kind]
            if kind not in self._marked:
                self._marked.add(kind)
                color = rgb(EVENT_COLORS.get(kind, SEVERITY_COLORS.get(mine["severity"][0], _OTHER_EVENT)))
                marks = rr.SeriesPoints(
                    names=[kind.replace("_", " ").lower()], colors=[color], markers=["diamond"], marker_sizes=[6.0]
                )
                self._static(f"marks/{kind.lower()}", marks)
            # On the axis: what an event says stands in the log below.
            self._scalars(f"marks/{kind.lower()}", self._times(mine), np.zeros((len(mine), 1)))

    def _torque_source(self, states: Rows, commands: Rows) -> NDArray[np.object_]:
        """Whose torque acts, for each state: the address of who wrote the command in force."""
        # The command of a state may be in the block before: what was known last holds until a newer one is found.
        source = np.full(len(states), self._holder, dtype=object)
        rows, found = join_commands(states, commands)
        if found.any():
            at = np.maximum.accumulate(np.where(found, np.arange(len(states)), -1))
            known = self._names.texts(commands["controller"][rows])
            known[commands["safe"][rows]] = _SAFE
            source[at >= 0] = known[at[at >= 0]]
            self._holder = str(source[-1])
        source[states["command_seq"] == 0] = _NOBODY
        source[states["safe"]] = _SAFE
        self._tell_apart(source)
        return source

    def _tell_apart(self, holders: NDArray[np.object_]) -> None:
        """Give each holder a colour; those beyond the first `MOST` are one, as their requests are."""
        new = sorted(set(holders) - {""} - self._holders.keys())
        room = max(MAX_CLIENTS - len(self._holders), 0)
        if new[room:]:
            holders[[holder in new[room:] for holder in holders]] = OTHER_CLIENTS
            new = new[:room] if OTHER_CLIENTS in self._holders else [*new[:room], OTHER_CLIENTS]
        if new:
            for holder in new:
                self._holders[holder] = RUN_COLORS[len(self._holders) % len(RUN_COLORS)]
            self._lane_legend("torque", self._holders)

    # -- the recording ----------------------------------------------------------------------------------------------

    def _lane(self, name: str, rows: Rows, values: NDArray[np.object_]) -> None:
        """A lane of states over time: only its changes are written."""
        changed = np.ones(len(values), np.bool_)
        changed[0] = values[0] != self._lanes.get(name)
        changed[1:] = values[1:] != values[:-1]
        self._lanes[name] = values[-1]
        if changed.any():
            states = [str(value) for value in values[changed]]
            self._send(f"lanes/{name}", self._times(rows[changed]), rr.StateChange.columns(state=states))

    def _times(self, rows: Rows) -> list[rr.TimeColumn]:
        return [
            rr.TimeColumn(SIM_TIME, duration=self._timebase.time_ns(rows).astype("timedelta64[ns]")),
            rr.TimeColumn(WALL, timestamp=rows["wall_ns"].astype("datetime64[ns]")),
            rr.TimeColumn(STEP, sequence=self._timebase.steps(rows, self._drawn.step_ns)),
        ]

    def _scalars(self, path: str, times: list[rr.TimeColumn], values: NDArray[np.floating]) -> None:
        self._send(path, times, rr.Scalars.columns(scalars=np.ascontiguousarray(values)))

    def _send(self, path: str, times: list[rr.TimeColumn], columns: Any) -> None:
        rr.send_columns(self._path(path), times, columns, recording=self._stream)

    def _static(self, path: str, what: Any) -> None:
        self._stream.log(self._path(path), what, static=True)

    def _path(self, path: str) -> str:
        return f"{self._root}/{path}" if self._root else path


def _about_z(angle: float) -> Any:
    return rr.Quaternion(xyzw=[0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2))])


def _stops(flags: NDArray[np.uint16]) -> NDArray[np.object_]:
    unique, inverse = np.unique(flags, return_inverse=True)
    return np.array([_stop_names(int(value)) for value in unique], dtype=object)[inverse]


def _stop_names(flags: int) -> str:
    found = [f"{symbol} lower" for joint, symbol in enumerate(JOINT_SYMBOLS) if flags >> joint & 1]
    found += [f"{symbol} upper" for joint, symbol in enumerate(JOINT_SYMBOLS) if flags >> (joint + 4) & 1]
    if flags >> 8 & 1:
        found.append("tool on something")
    return ", ".join(found)
