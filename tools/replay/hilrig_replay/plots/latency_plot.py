"""Plot of a run's loop latency and age: histogram, stages, tail distribution, and course over time."""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hilrig_replay.analysis.distribution import complementary_cdf
from hilrig_replay.analysis.latency import LatencyReport
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.run import Run
from hilrig_replay.plots.axes_style import label_axes, set_log_scale
from hilrig_replay.plots.output import check_plot_path, save_figure
from hilrig_replay.plots.palette import AGE_COLOR, LOOP_COLOR, TEXT_COLOR
from hilrig_runtime.errors import InputError
from hilrig_runtime.escaping import plot_text

Floats = NDArray[np.float64]

_PERCENTILE_COLOR: Final = "#d62728"
MAX_HISTOGRAM_STEPS: Final = 500
"""Largest extent of the histogram, steps of the simulation: damaged timestamps would make it arbitrarily large."""
_MAX_HISTORY_POINTS: Final = 4000
"""Points of the plot over time: a few per pixel."""


def save_plot(report: LatencyReport, run: Run, path: Path) -> None:
    """Plot a run's loop latency into a file; the suffix selects the format.

    Args:
        report: latency report of the run.
        run: the run.
        path: `.png`, `.svg` or `.pdf`.

    Raises:
        InputError: the run has no latency samples, or the path is not usable.
        OperationError: the file can't be written.
    """
    check_plot_path(path, run.file.paths)
    if report.loop_ms is None:
        raise InputError(f"{run.path}: no latency samples to plot")
    save_figure(latency_figure(report, run), path, run.file.paths)


def latency_figure(report: LatencyReport, run: Run) -> Figure:
    """Figure of a latency report that has samples."""
    figure = Figure(figsize=(11, 7), layout="constrained", dpi=110)
    (histogram, stages), (above, history) = figure.subplots(2, 2, width_ratios=(1.3, 1))
    _histogram(histogram, report)
    _stages(stages, report)
    _tail(above, report)
    _history(history, run, report)
    verdict = "valid" if report.fit else "not valid"
    reason = "" if report.fit else f": {report.reasons[0].text}"
    figure.suptitle(
        plot_text(
            f"Loop latency of {report.session}\n"
            f"{report.samples} samples, step {report.step_ms:g} ms, controller {report.controller or '(none)'} · "
            f"{verdict} for latency measurements{reason}"
        ),
        fontsize=11,
        color=TEXT_COLOR,
    )
    return figure


def _histogram(axes: Axes, report: LatencyReport) -> None:
    statistics, step = report.loop_ms, report.step_ms
    assert statistics is not None
    # Outliers beyond the limit would compress the histogram: they are counted in its title and shown in the tail plot.
    limit = min(max(step * np.ceil(statistics.p999 / step + 0.25), 2 * step), MAX_HISTOGRAM_STEPS * step)
    edges = np.arange(0, limit + step / 80, step / 40)
    counts, beyond = np.zeros(len(edges) - 1, np.int64), 0
    for loop_ns in report.table.column("loop")():
        counts += np.histogram(np.minimum(loop_ns / 1e6, limit), edges)[0]
        beyond += int((loop_ns / 1e6 > limit).sum())
    axes.stairs(counts, edges, baseline=0.5, fill=True, color=LOOP_COLOR)
    set_log_scale(axes)
    steps = np.arange(step, limit + step / 2, step)
    axes.vlines(steps, 0, 1, transform=axes.get_xaxis_transform(), color="#bbbbbb", linewidth=0.8, zorder=0)
    quantiles = (
        ("p50", statistics.p50),
        ("p95", statistics.p95),
        ("p99", statistics.p99),
        ("p99.9", statistics.p999),
    )
    for row, (name, value) in enumerate(quantiles):
        axes.axvline(value, color=_PERCENTILE_COLOR, linewidth=0.9, linestyle=(0, (4, 2)))
        near_right = value > 0.75 * limit
        axes.annotate(
            f"{name} {value:.2f} ms",
            (min(value, limit), 0.97 - 0.07 * row),
            xycoords=("data", "axes fraction"),
            xytext=(-4 if near_right else 4, 0),
            textcoords="offset points",
            ha="right" if near_right else "left",
            va="top",
            fontsize=8,
            color=_PERCENTILE_COLOR,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )
    axes.set_xlim(0, limit)
    axes.set_ylim(bottom=0.7)
    more = f"; {beyond} above {limit:g} ms" if beyond else ""
    label_axes(axes, f"Loop latency histogram (grid: {step:g} ms steps{more})", "loop latency, ms", "samples")


def _stages(axes: Axes, report: LatencyReport) -> None:
    for row, stage in enumerate(report.stages):
        statistics = report.stages_ms[stage.key]
        axes.barh(row, statistics.p50, color=stage.color, height=0.6)
        axes.plot([statistics.p50, statistics.p99], [row, row], color=TEXT_COLOR, linewidth=1.2)
        axes.plot([statistics.p99], [row], marker="|", color=TEXT_COLOR, markersize=9)
        axes.annotate(
            f"{statistics.p50:.2f}",
            (statistics.p99, row),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=TEXT_COLOR,
        )
    axes.set_yticks(range(len(report.stages)), [stage.title for stage in report.stages])
    axes.invert_yaxis()
    axes.set_xlim(0, 1.15 * max(1e-3, *(statistics.p99 for statistics in report.stages_ms.values())))
    label_axes(axes, "Stage latencies (bar and number: p50, line: p99)", "latency, ms", "")


def _tail(axes: Axes, report: LatencyReport) -> None:
    loop_ns, share_above = complementary_cdf(report.table.column("loop"))
    axes.step(loop_ns / 1e6, share_above, where="post", color=LOOP_COLOR, linewidth=1.4, label="loop latency")
    if report.ages is not None:
        age_ns, share_older = complementary_cdf(report.ages.ages_ns)
        axes.step(age_ns / 1e6, share_older, where="post", color=AGE_COLOR, linewidth=1.4, label="age at each step")
        share_above = np.append(share_above, min(share_above[-1], share_older[-1]))
    set_log_scale(axes)
    axes.grid(color="#e5e5e5", linewidth=0.6)
    for share, name in ((0.5, "p50"), (0.05, "p95"), (0.01, "p99"), (0.001, "p99.9")):
        if share >= share_above[-1]:
            axes.axhline(share, color=_PERCENTILE_COLOR, linewidth=0.6, linestyle=(0, (4, 2)))
            axes.annotate(
                name,
                (0.995, share),
                xycoords=("axes fraction", "data"),
                ha="right",
                va="bottom",
                fontsize=8,
                color=_PERCENTILE_COLOR,
            )
    axes.set_xlim(left=max(0.0, float(loop_ns[0]) / 1e6 - 0.1 * report.step_ms))
    axes.legend(fontsize=8, loc="upper right", bbox_to_anchor=(0.94, 1.0))
    label_axes(axes, "Tail distributions", "loop latency, age, ms", "share of slower samples, older steps")


def _history(axes: Axes, run: Run, report: LatencyReport) -> None:
    top_ms = 0.0
    if report.ages is not None:
        rows = report.ages.rows("age_ns", "sampled_ns", "incarnation")
        count = sum(len(ages) for ages in report.ages.ages_ns())
        time_s, oldest = _downsampled(run, (block[block["age_ns"] > 0] for block in rows), "age_ns", count)
        axes.plot(time_s, oldest, color=AGE_COLOR, linewidth=0.7, rasterized=True, zorder=1)
        top_ms = float(oldest.max())
    samples = report.table.blocks("loop", "sampled_ns", "incarnation")
    time_s, slowest = _downsampled(run, samples, "loop", report.samples)
    axes.plot(
        time_s,
        slowest,
        linestyle="none",
        marker=".",
        markersize=2.5,
        color=LOOP_COLOR,
        rasterized=True,
    )
    axes.set_ylim(0, 1.1 * max(top_ms, float(slowest.max())))
    axes.axhline(report.step_ms, color="#bbbbbb", linewidth=0.8, zorder=0)
    label_axes(axes, "Loop latency (dots) and age (line) over time", "time since start, s", "loop latency, age, ms")


def _downsampled(run: Run, blocks: Iterable[Rows], name: str, count: int) -> tuple[Floats, Floats]:
    """Times, s, and values, ms, of a column in ns of `count` rows; of each bin of rows the largest value."""
    bin_size = -(-count // _MAX_HISTORY_POINTS)
    bins = -(-count // bin_size)
    time_s, largest = np.zeros(bins), np.zeros(bins)
    start = 0
    for rows in blocks:
        at = np.arange(start, start + len(rows)) // bin_size
        np.maximum.at(largest, at, rows[name] / 1e6)
        # In reverse order, so that each bin gets the time of its first row in the block.
        time_s[at[::-1]] = run.time_s(rows)[::-1]
        start += len(rows)
    return time_s, largest
