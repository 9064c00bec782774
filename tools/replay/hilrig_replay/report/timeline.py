"""Content of the interactive part of a report: the columns of a run as JSON values, arrays as base64.

The page draws the arm, the plots and the events from these values. The number of rows is bounded, so that the size of a
page does not depend on the length of a run: of each bin of states the first one is kept, and the largest age.
"""

from base64 import b64encode
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.latency import LatencyReport
from hilrig_replay.analysis.summary import under_command
from hilrig_replay.geometry.arm_picture import AT_STOP, HOLDS_PART, MAGNET_ON, scene_of
from hilrig_replay.grading.grade import Grade
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.run import Run
from hilrig_replay.plots.palette import (
    AGE_COLOR,
    EFFORT_SYMBOLS,
    EVENT_COLORS,
    JOINT_COLORS,
    JOINT_SYMBOLS,
    event_title,
    severity_color,
)
from hilrig_runtime.config.task import TaskConfig
from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_sim.arm.model import RigParameters

MAX_ROWS: Final = 33_000
"""Rows of a run: eleven minutes at a step of 20 ms."""
MAX_EVENTS: Final = 2000
"""Events of a run in its list."""

_NO_AGE: Final = np.nan


def timeline(
    run: Run,
    latency: LatencyReport,
    parameters: RigParameters,
    task: TaskConfig | None,
    grade: Grade | None,
    *,
    max_rows: int = MAX_ROWS,
) -> dict[str, Any]:
    """Collect the columns of a run in one pass.

    Times are in s from the first state. Angles are in °, lengths in mm, latencies and ages in ms.

    Args:
        run: the recording.
        latency: its latency report, with samples and ages.
        parameters: parameters of its rig.
        task: the task by which it is graded.
        grade: its grade.
        max_rows: largest number of states and of latency samples.

    Raises:
        InputError: the file is damaged.
    """
    every = -(-max(run.file.counts["state"], 1) // max_rows)
    states: list[Rows] = []
    times: list[NDArray[np.float64]] = []
    moved: dict[str, list[list[float]]] = {part.name: [] for part in parameters.scene.parts}
    events: list[dict[str, Any]] = []
    seen = count = 0
    began_s: float | None = None
    for block in run.blocks(frozenset({"state", "command", "event"})):
        if len(block.states):
            if began_s is None and (acts := under_command(run, block.states)).any():
                began_s = float(run.time_s(block.states[acts][:1])[0])
            first = -seen % every
            times.append(run.time_s(block.states)[first::every])
            states.append(block.states[first::every].copy())
            seen += len(block.states)
        _add_moves(run, block.parts, moved, every * run.step_ns / 2e9)
        count += len(block.events)
        events += _events(run, block.events[: max(MAX_EVENTS - len(events), 0)])
    table, time_s = np.concatenate(states), np.concatenate(times)
    return {
        "scene": scene_of(parameters),
        "joints": [
            {"symbol": symbol, "effort": effort, "color": color}
            for symbol, effort, color in zip(JOINT_SYMBOLS, EFFORT_SYMBOLS, JOINT_COLORS, strict=True)
        ],
        "stages": [{"title": stage.title, "color": stage.color} for stage in latency.stages],
        "colors": {"age": AGE_COLOR},
        "flags": {"magnet": MAGNET_ON, "holds": HOLDS_PART, "stop": AT_STOP},
        "every": every,
        "step_ms": run.step_ns / 1e6,
        "time": _encoded(time_s),
        "position": [_encoded(table["position"][:, joint] * JOINT_SCALE[joint]) for joint in range(4)],
        "velocity": [_encoded(table["velocity"][:, joint] * JOINT_SCALE[joint]) for joint in range(4)],
        "effort": [_encoded(table["effort"][:, joint]) for joint in range(4)],
        "state": b64encode(_flags(table).tobytes()).decode(),
        "age": _encoded(_ages(run, latency, time_s)),
        "samples": _samples(run, latency, max_rows),
        "moves": [
            [_encoded(np.array(column)) for column in zip(*rows, strict=True)] if rows else None
            for rows in moved.values()
        ],
        "events": events,
        "other_events": count - len(events),
        "goals": [] if grade is None or began_s is None else _goals(grade, began_s),
        "targets": _targets(task),
    }


def _flags(states: Rows) -> NDArray[np.uint8]:
    flags = (
        MAGNET_ON * states["magnet"] + HOLDS_PART * (states["held_part"] != 0) + AT_STOP * (states["limit_flags"] != 0)
    )
    return np.asarray(flags, np.uint8)


def _ages(run: Run, latency: LatencyReport, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest age of each bin of states, ms, shape as `time_s`; NaN: no age."""
    ages = np.full(len(time_s), _NO_AGE)
    if latency.ages is not None:
        for rows in latency.ages.rows("age_ns", "sampled_ns", "incarnation"):
            aged = rows[rows["age_ns"] > 0]
            # A state of the bin may be rounded to just before its first one.
            bins = np.searchsorted(time_s, run.time_s(aged) + 1e-6, side="right") - 1
            np.fmax.at(ages, np.maximum(bins, 0), aged["age_ns"] / 1e6)
    return ages


def _samples(run: Run, latency: LatencyReport, max_rows: int) -> dict[str, Any]:
    """Latency samples; of each bin of samples the slowest one."""
    every = -(-max(latency.samples, 1) // max_rows)
    names = ("loop", *(stage.key for stage in latency.stages))
    kept: list[Rows] = []
    held: Rows | None = None
    for rows in latency.table.blocks(*names, "sampled_ns", "incarnation"):
        held = rows if held is None else np.concatenate((held, rows))
        full = len(held) - len(held) % every
        bins = held[:full].reshape(-1, every)
        kept.append(bins[np.arange(len(bins)), bins["loop"].argmax(axis=1)])
        held = held[full:]
    if held is not None and len(held):
        kept.append(held[held["loop"].argmax()][np.newaxis])
    if not kept:
        return {"every": 1, "time": "", "loop": "", "stages": []}
    table = np.concatenate(kept)
    return {
        "every": every,
        "time": _encoded(run.time_s(table)),
        "loop": _encoded(table["loop"] / 1e6),
        "stages": [_encoded(table[stage.key] / 1e6) for stage in latency.stages],
    }


def _add_moves(run: Run, parts: Rows, moved: dict[str, list[list[float]]], spacing_s: float) -> None:
    """Add the poses of parts that differ from the pose before; of those within `spacing_s`, the last one."""
    if not len(parts):
        return
    time_s = run.time_s(parts)
    x_mm, y_mm, z_mm = 1e3 * parts["x"], 1e3 * parts["y"], 1e3 * parts["z"]
    yaw_deg = np.degrees(parts["yaw"])
    poses = np.column_stack((x_mm, y_mm, z_mm, yaw_deg)).round(1)
    for name, rows in moved.items():
        own = np.flatnonzero(parts["part"] == run.names.code(name))
        for at, pose in zip(time_s[own].tolist(), poses[own].tolist(), strict=True):
            if rows and at - rows[-1][0] < spacing_s:
                rows[-1][1:] = pose
            elif not rows or rows[-1][1:] != pose:
                rows.append([at, *pose])


def _events(run: Run, events: Rows) -> list[dict[str, Any]]:
    return [
        {
            "time": round(float(at), 3),
            "title": event_title(event["kind"]),
            "text": event["text"],
            "severity": event["severity"].lower(),
            "color": EVENT_COLORS.get(event["kind"], severity_color(event["severity"])),
        }
        for event, at in zip(events, run.time_s(events), strict=True)
    ]


def _goals(grade: Grade, began_s: float) -> list[dict[str, Any]]:
    """Goals with the time at which they were reached, on the time axis of the run; None: missed."""
    reached: list[tuple[str, float | None]] = [(pose.name, pose.reached_s) for pose in grade.poses]
    if grade.path is not None:
        reached.append(("path", grade.path.done_s))
    reached += [(f"part {part.part}", part.at_s if part.placed else None) for part in grade.parts]
    return [{"name": name, "time": None if at is None else round(began_s + at, 3)} for name, at in reached]


def _targets(task: TaskConfig | None) -> dict[str, Any]:
    poses: Sequence[Any] = () if task is None else task.poses
    path: Sequence[Any] = () if task is None or task.path is None else task.path.points_mm
    return {
        "poses": [{"name": pose.name, "at": list(pose.position_mm)} for pose in poses],
        "path": [list(point) for point in path],
    }


def _encoded(values: NDArray[np.float64]) -> str:
    return b64encode(np.asarray(values, "<f4").tobytes()).decode()
