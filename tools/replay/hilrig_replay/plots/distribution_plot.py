"""How a class of runs is distributed: a row a run, the best above, and a panel for each thing that is compared."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilrig_replay.analysis.summary import RunSummary
from hilrig_replay.plots.motion_plot import label
from hilrig_replay.plots.palette import INK, RUN_COLORS

_NAMED: Final = 60
"""With more runs than this their names would run into each other."""
_MEDIAN: Final = "#d62728"


def distribution_figure(runs: Sequence[RunSummary]) -> Figure:
    """Runs in their order: goals or parts, time, work of the drives, loop latency; a dashed line at each median."""
    rows = np.arange(len(runs))
    height = 1.3 + max(0.09, min(0.28, 12 / len(runs))) * len(runs)
    figure = Figure(figsize=(11, height), layout="constrained", dpi=110)
    goals, times, work, loop = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.6))
    if any(run.grade is not None for run in runs):
        _bars(goals, rows, [None if run.grade is None else 100 * run.grade.score for run in runs])
        label(goals, "Goals reached, %", "", "")
        goals.set_xlim(0, 100)
        _bars(times, rows, [None if run.grade is None else run.grade.done_s for run in runs])
        label(times, "Done after, s", "", "")
    else:
        _bars(goals, rows, [None if run.placement is None else float(run.placement.placed) for run in runs])
        label(goals, "Parts placed", "", "")
        _bars(times, rows, [None if run.placement is None else run.placement.largest_error_mm for run in runs])
        label(times, "Placing error, mm", "", "")
    _bars(work, rows, [run.motion.work_j for run in runs])
    label(work, "Work of the drives, J", "", "")
    _boxes(loop, runs)
    label(loop, "Loop latency, ms", "box: quartiles, whiskers: p1 and p99", "")
    places = [str(row + 1) for row in rows]
    names = [f"{place}. {run.name}" for place, run in zip(places, runs, strict=True)]
    for axes in figure.axes:
        # Each panel tells its rows: on a narrow page they stand one below the other.
        axes.set_yticks(rows, names if axes is goals and len(runs) <= _NAMED else places, fontsize=7, color=INK)
        axes.set_ylim(len(runs) - 0.4, -0.6)
    return figure


def _bars(axes: Axes, rows: np.ndarray, values: Sequence[float | None]) -> None:
    known = [value for value in values if value is not None]
    axes.barh(rows, [0.0 if value is None else value for value in values], height=0.6, color=RUN_COLORS[0], alpha=0.75)
    if not known:
        _nothing(axes)
    else:
        axes.set_xlim(0, 1.05 * max(known) or 1.0)
        axes.axvline(float(np.median(known)), color=_MEDIAN, linewidth=0.8, linestyle=(0, (4, 2)))


def _nothing(axes: Axes) -> None:
    axes.set_xticks([])
    axes.annotate("none", (0.5, 0.5), xycoords="axes fraction", ha="center", color=INK, fontsize=8)


def _boxes(axes: Axes, runs: Sequence[RunSummary]) -> None:
    measured = [(row, run.box_ms) for row, run in enumerate(runs) if run.box_ms]
    if not measured:
        _nothing(axes)
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
        color=_MEDIAN,
        linewidth=0.8,
        linestyle=(0, (4, 2)),
    )
