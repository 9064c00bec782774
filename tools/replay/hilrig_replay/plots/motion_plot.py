"""Pictures of what the arm did: joint positions and efforts over time, and the tool's way seen from above."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from hilrig_replay.analysis.distribution import complementary_cdf
from hilrig_replay.analysis.summary import RunSummary, Trajectory
from hilrig_replay.plots.palette import EFFORT_SYMBOLS, INK, JOINT_COLORS, JOINT_SYMBOLS, RUN_COLORS
from hilrig_replay.rerun_view.scene import reach_outline
from hilrig_runtime.config.task import TaskConfig
from hilrig_sim.arm.model import JOINT_SCALE, RigParameters

TASK_COLOR: Final = "#2e9e57"


def motion_figure(trajectory: Trajectory, parameters: RigParameters, task: TaskConfig | None = None) -> Figure:
    """One run: positions, efforts, and the tool's way with trays, targets and the reachable area."""
    figure = Figure(figsize=(11, 5), layout="constrained", dpi=110)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1))
    position, effort = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    for joint in range(4):
        color, values = JOINT_COLORS[joint], trajectory.position[:, joint] * JOINT_SCALE[joint]
        position.plot(trajectory.time_s, values, color=color, linewidth=1.2, label=JOINT_SYMBOLS[joint])
        effort.plot(
            trajectory.time_s, trajectory.effort[:, joint], color=color, linewidth=1.0, label=EFFORT_SYMBOLS[joint]
        )
    label(position, "Positions: θ in °, d3 in mm", "", "")
    label(effort, "Efforts: τ1 τ2 τ4 in N·m, τ3 in N", "time in the run, s", "")
    for axes in (position, effort):
        axes.legend(fontsize=7, ncols=4, loc="lower right", bbox_to_anchor=(1, 1), frameon=False, borderaxespad=0.2)
        axes.margins(x=0.01)
    top = figure.add_subplot(grid[:, 1])
    _from_above(top, parameters, task)
    top.plot(trajectory.tip[:, 0] * 1e3, trajectory.tip[:, 1] * 1e3, color=RUN_COLORS[1], linewidth=0.9)
    label(top, "The tool's way from above, mm", "x", "y")
    return figure


def comparison_figure(runs: Sequence[RunSummary]) -> Figure:
    """Several runs on one aligned time axis: each joint a panel, and the tool's ways."""
    figure = Figure(figsize=(11, 7), layout="constrained", dpi=110)
    grid = figure.add_gridspec(4, 2, width_ratios=(1.5, 1))
    for joint in range(4):
        axes = figure.add_subplot(grid[joint, 0])
        for number, summary in enumerate(runs):
            color, trajectory = RUN_COLORS[number % len(RUN_COLORS)], summary.trajectory
            values = trajectory.position[:, joint] * JOINT_SCALE[joint]
            axes.plot(trajectory.time_s, values, color=color, linewidth=1.1, label=summary.session)
        unit = "mm" if joint == 2 else "°"
        label(axes, f"{JOINT_SYMBOLS[joint]}, {unit}", "aligned time, s" if joint == 3 else "", "")
    figure.axes[0].legend(fontsize=7, frameon=False)
    top, above = figure.add_subplot(grid[:2, 1]), figure.add_subplot(grid[2:, 1])
    for number, summary in enumerate(runs):
        trajectory = summary.trajectory
        color = RUN_COLORS[number % len(RUN_COLORS)]
        top.plot(trajectory.tip[:, 0] * 1e3, trajectory.tip[:, 1] * 1e3, color=color, linewidth=0.9)
        if summary.latency.samples:
            loop_ns, share = complementary_cdf(summary.latency.table.column("loop"))
            above.step(loop_ns / 1e6, share, where="post", color=color, linewidth=1.2)
    top.set_aspect("equal", adjustable="datalim")
    label(top, "The tools' ways from above, mm", "", "")
    above.set_yscale("log")
    above.grid(color="#e5e5e5", linewidth=0.6)
    label(above, "Loop latency, ms: share of samples that took longer", "", "")
    return figure


def _from_above(axes: Axes, parameters: RigParameters, task: TaskConfig | None) -> None:
    for line in reach_outline(parameters.arm, 0.0):
        axes.plot(line[:, 0] * 1e3, line[:, 1] * 1e3, color="#c5ced8", linewidth=0.8)
    for tray in parameters.scene.trays:
        for x, y, _ in tray.places:
            axes.add_patch(Circle((x * 1e3, y * 1e3), 18.0, fill=False, edgecolor="#8a96a3", linewidth=0.8))
    if task is not None and task.path is not None:
        path = np.array(task.path.points_mm)
        axes.plot(path[:, 0], path[:, 1], color=TASK_COLOR, linewidth=3.0, alpha=0.45)
    for pose in () if task is None else task.poses:
        x, y, _ = pose.position_mm
        axes.plot([x], [y], marker="+", markersize=11, markeredgewidth=2, color=TASK_COLOR)
        axes.annotate(pose.name, (x, y), xytext=(5, 5), textcoords="offset points", fontsize=8, color=TASK_COLOR)
    axes.set_aspect("equal", adjustable="datalim")


def label(axes: Axes, title: str, x: str, y: str) -> None:
    """Title and axes of a panel, the same everywhere."""
    axes.set_title(title, fontsize=9, loc="left", color=INK)
    axes.set_xlabel(x, fontsize=8, color=INK)
    axes.set_ylabel(y, fontsize=8, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    axes.spines[["top", "right"]].set_visible(False)
