"""Plot of a group of runs: one row per run in ranking order, one panel per compared quantity."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilrig_replay.analysis.summary import RunSummary
from hilrig_replay.plots.axes_style import label_axes
from hilrig_replay.plots.palette import RUN_COLORS, TEXT_COLOR
from hilrig_runtime.escaping import plot_text

_MAX_NAMED_RUNS: Final = 60
"""With more runs the row labels would overlap, so rows are only numbered."""
_MAX_LABEL_LENGTH: Final = 40
"""Longer names are shortened to their end, because they would leave no space for the panels; characters."""
_MEDIAN_COLOR: Final = "#d62728"


def distribution_figure(runs: Sequence[RunSummary]) -> Figure:
    """Figure of ranked runs: goals or parts, time or error, drive work, loop latency; dashed lines mark medians."""
    rows = np.arange(len(runs))
    height = 1.3 + max(0.09, min(0.28, 12 / len(runs))) * len(runs)
    figure = Figure(figsize=(11, height), layout="constrained", dpi=110)
    goals, times, work, loop = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.6))
    if any(run.grade is not None for run in runs):
        _bars(goals, rows, [None if run.grade is None else 100 * run.grade.score for run in runs])
        label_axes(goals, "Goals reached, %", "", "")
        goals.set_xlim(0, 100)
        _bars(times, rows, [None if run.grade is None else run.grade.done_s for run in runs])
        label_axes(times, "Completion time, s", "", "")
    else:
        _bars(goals, rows, [None if run.placement is None else float(run.placement.placed) for run in runs])
        label_axes(goals, "Parts placed", "", "")
        _bars(times, rows, [None if run.placement is None else run.placement.largest_error_mm for run in runs])
        label_axes(times, "Placement error, mm", "", "")
    _bars(work, rows, [run.motion.work_j for run in runs])
    label_axes(work, "Drive work, J", "", "")
    _boxes(loop, runs)
    label_axes(loop, "Loop latency, ms", "box: quartiles, whiskers: p1 and p99", "")
    ranks = [str(row + 1) for row in rows]
    names = [plot_text(f"{rank}. {_shorten(run.name)}") for rank, run in zip(ranks, runs, strict=True)]
    for axes in figure.axes:
        # Every panel has row labels, because a narrow page shows the panels one below the other.
        axes.set_yticks(
            rows, names if axes is goals and len(runs) <= _MAX_NAMED_RUNS else ranks, fontsize=7, color=TEXT_COLOR
        )
        axes.set_ylim(len(runs) - 0.4, -0.6)
    return figure


def _shorten(name: str) -> str:
    return name if len(name) <= _MAX_LABEL_LENGTH else f"…{name[1 - _MAX_LABEL_LENGTH :]}"


def _bars(axes: Axes, rows: np.ndarray, values: Sequence[float | None]) -> None:
    known = [value for value in values if value is not None]
    axes.barh(rows, [0.0 if value is None else value for value in values], height=0.6, color=RUN_COLORS[0], alpha=0.75)
    if not known:
        _show_no_data(axes)
    else:
        axes.set_xlim(0, 1.05 * max(known) or 1.0)
        axes.axvline(float(np.median(known)), color=_MEDIAN_COLOR, linewidth=0.8, linestyle=(0, (4, 2)))


def _show_no_data(axes: Axes) -> None:
    axes.set_xticks([])
    axes.annotate("no data", (0.5, 0.5), xycoords="axes fraction", ha="center", color=TEXT_COLOR, fontsize=8)


def _boxes(axes: Axes, runs: Sequence[RunSummary]) -> None:
    measured = [(row, run.box_ms) for row, run in enumerate(runs) if run.box_ms]
    if not measured:
        _show_no_data(axes)
        return
    boxes = axes.bxp(
        [dict(zip(("whislo", "q1", "med", "q3", "whishi"), box_ms, strict=True)) for _, box_ms in measured],
        positions=[row for row, _ in measured],
        orientation="horizontal",
        widths=0.6,
        showfliers=False,
        patch_artist=True,
        manage_ticks=False,
    )
    for box in boxes["boxes"]:
        box.set(facecolor=RUN_COLORS[0], alpha=0.6)
    axes.set_xlim(left=0)
    axes.axvline(
        float(np.median([box_ms[2] for _, box_ms in measured])),
        color=_MEDIAN_COLOR,
        linewidth=0.8,
        linestyle=(0, (4, 2)),
    )
