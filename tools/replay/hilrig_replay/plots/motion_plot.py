"""Plot of a run's motion: joint positions and efforts over time, and the tool path in top view."""

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from hilrig_replay.analysis.summary import Trajectory
from hilrig_replay.geometry.scene import workspace_outline
from hilrig_replay.plots.axes_style import label_axes
from hilrig_replay.plots.palette import EFFORT_SYMBOLS, JOINT_COLORS, JOINT_SYMBOLS, RUN_COLORS
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.escaping import plot_text
from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_sim.arm.model import RigParameters

TASK_COLOR: Final = "#2e9e57"


def motion_figure(trajectory: Trajectory, parameters: RigParameters, task: TaskConfig | None = None) -> Figure:
    """Figure of one run: positions, efforts, and the tool path with trays, task targets and the workspace outline."""
    figure = Figure(figsize=(11, 5), layout="constrained", dpi=110)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1))
    position, effort = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    for joint in range(4):
        color, values = JOINT_COLORS[joint], trajectory.position[:, joint] * JOINT_SCALE[joint]
        position.plot(trajectory.time_s, values, color=color, linewidth=1.2, label=JOINT_SYMBOLS[joint])
        effort.plot(
            trajectory.time_s, trajectory.effort[:, joint], color=color, linewidth=1.0, label=EFFORT_SYMBOLS[joint]
        )
    label_axes(position, "Joint positions (θ in °, d3 in mm)", "", "")
    label_axes(effort, "Joint efforts (τ1, τ2, τ4 in N·m; τ3 in N)", "time since start, s", "")
    for axes in (position, effort):
        axes.legend(fontsize=7, ncols=4, loc="lower right", bbox_to_anchor=(1, 1), frameon=False, borderaxespad=0.2)
        axes.margins(x=0.01)
    top = figure.add_subplot(grid[:, 1])
    _draw_workspace(top, parameters, task)
    top.plot(trajectory.tip[:, 0] * 1e3, trajectory.tip[:, 1] * 1e3, color=RUN_COLORS[1], linewidth=0.9)
    label_axes(top, "Tool path, top view", "x, mm", "y, mm")
    return figure


def _draw_workspace(axes: Axes, parameters: RigParameters, task: TaskConfig | None) -> None:
    """Draw workspace outline, trays and task targets in top view."""
    for line in workspace_outline(parameters.arm, 0.0):
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
        axes.annotate(
            plot_text(pose.name), (x, y), xytext=(5, 5), textcoords="offset points", fontsize=8, color=TASK_COLOR
        )
    axes.set_aspect("equal", adjustable="datalim")
