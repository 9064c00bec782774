"""Plot of a comparison: several runs on one time axis."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from hilrig_replay.analysis.compare import Comparison
from hilrig_replay.analysis.distribution import complementary_cdf
from hilrig_replay.analysis.summary import RunSummary
from hilrig_replay.plots.axes_style import label_axes, set_log_scale
from hilrig_replay.plots.output import check_plot_path, save_figure
from hilrig_replay.plots.palette import JOINT_SYMBOLS, RUN_COLORS
from hilrig_runtime.escaping import plot_text
from hilrig_sim.arm.joints import JOINT_SCALE


def save_comparison_plot(comparison: Comparison, path: Path) -> None:
    """Plot aligned runs into a file, `.png`, `.svg` or `.pdf`.

    Raises:
        InputError: the path is not usable.
        OperationError: the file can't be written.
    """
    inputs = [path for run in comparison.runs for path in run.file.paths]
    check_plot_path(path, inputs)
    save_figure(comparison_figure(comparison.summaries), path, inputs)


def comparison_figure(runs: Sequence[RunSummary]) -> Figure:
    """Figure of several runs on one aligned time axis: a panel per joint, tool paths, and loop latency."""
    figure = Figure(figsize=(11, 7), layout="constrained", dpi=110)
    grid = figure.add_gridspec(4, 2, width_ratios=(1.5, 1))
    for joint in range(4):
        axes = figure.add_subplot(grid[joint, 0])
        for number, summary in enumerate(runs):
            color, trajectory = RUN_COLORS[number % len(RUN_COLORS)], summary.trajectory
            values = trajectory.position[:, joint] * JOINT_SCALE[joint]
            axes.plot(trajectory.time_s, values, color=color, linewidth=1.1, label=plot_text(summary.session))
        unit = "mm" if joint == 2 else "°"
        label_axes(axes, f"{JOINT_SYMBOLS[joint]}, {unit}", "aligned time, s" if joint == 3 else "", "")
    figure.axes[0].legend(fontsize=7, frameon=False)
    top, latency = figure.add_subplot(grid[:2, 1]), figure.add_subplot(grid[2:, 1])
    for number, summary in enumerate(runs):
        trajectory = summary.trajectory
        color = RUN_COLORS[number % len(RUN_COLORS)]
        top.plot(trajectory.tip[:, 0] * 1e3, trajectory.tip[:, 1] * 1e3, color=color, linewidth=0.9)
        if summary.latency.samples:
            loop_ns, share = complementary_cdf(summary.latency.table.column("loop"))
            latency.step(loop_ns / 1e6, share, where="post", color=color, linewidth=1.2)
    top.set_aspect("equal", adjustable="datalim")
    label_axes(top, "Tool paths, top view", "x, mm", "y, mm")
    set_log_scale(latency)
    latency.grid(color="#e5e5e5", linewidth=0.6)
    label_axes(latency, "Loop latency, tail distribution", "loop latency, ms", "share of slower samples")
    return figure
