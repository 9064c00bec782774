"""The picture of a run's latency: histogram, stages, tail, and how it went over time."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from hilrig_replay.analysis.distribution import complementary_cdf
from hilrig_replay.analysis.latency import LatencyReport
from hilrig_replay.analysis.samples import STAGES
from hilrig_replay.io.recording_file import refuse_recording
from hilrig_replay.io.run import Run
from hilrig_replay.plots.motion_plot import label
from hilrig_replay.plots.palette import INK, STAGE_COLORS, STAGE_NAMES
from hilrig_runtime.errors import InputError, OperationError

FORMATS: Final = (".png", ".svg", ".pdf")

_MARK: Final = "#d62728"
_STRETCHES: Final = 4000
"""The course over time has so many points, some to a pixel."""


def check_plot_path(path: Path) -> None:
    """Refuse a picture that can't be written, before the work is done.

    Raises:
        InputError: its ending names no format, its folder is not there, or it is a recording.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: a picture ends in {', '.join(FORMATS)}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    refuse_recording(path)


def save_plot(report: LatencyReport, run: Run, path: Path) -> None:
    """Draw a run's latency into a file; its ending tells the format.

    Args:
        report: what was measured.
        run: of which run.
        path: `.png`, `.svg` or `.pdf`.

    Raises:
        InputError: there is nothing to draw, or the ending names no format.
        OperationError: the file can't be written.
    """
    check_plot_path(path)
    if report.loop_ms is None:
        raise InputError(f"{run.path}: no latency samples, so there is nothing to draw")
    save_figure(latency_figure(report, run), path)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a picture; its ending tells the format.

    Raises:
        OperationError: it can't be written.
    """
    try:
        figure.savefig(path)
    except OSError as error:
        raise OperationError(f"{path}: can't be written: {error.strerror or error}") from error


def latency_figure(report: LatencyReport, run: Run) -> Figure:
    """The picture itself, of a report with samples."""
    figure = Figure(figsize=(11, 7), layout="constrained", dpi=110)
    (histogram, stages), (above, history) = figure.subplots(2, 2, width_ratios=(1.3, 1))
    _histogram(histogram, report)
    _stages(stages, report)
    _tail(above, report)
    _history(history, run, report)
    fitness = "fit for latency claims" if report.fit else f"not fit for latency claims: {report.reasons[0]}"
    figure.suptitle(
        f"Loop latency of {report.session}\n"
        f"{report.samples} samples, step {report.step_ms:g} ms, controller {report.controller or '(none)'} · {fitness}",
        fontsize=11,
        color=INK,
    )
    return figure


def _histogram(axes: Axes, report: LatencyReport) -> None:
    statistics, step = report.loop_ms, report.step_ms
    assert statistics is not None
    # Far outliers would squeeze everything else: they are counted at the edge, and the tail shows them.
    limit = max(step * np.ceil(statistics.p999 / step + 0.25), 2 * step)
    edges = np.arange(0, limit + step / 80, step / 40)
    counts, beyond = np.zeros(len(edges) - 1, np.int64), 0
    for loop_ns in report.table.column("loop")():
        counts += np.histogram(np.minimum(loop_ns / 1e6, limit), edges)[0]
        beyond += int((loop_ns / 1e6 > limit).sum())
    axes.stairs(counts, edges, baseline=0.5, fill=True, color=STAGE_COLORS["register_wait"])
    _log_scale(axes)
    steps = np.arange(step, limit + step / 2, step)
    axes.vlines(steps, 0, 1, transform=axes.get_xaxis_transform(), color="#bbbbbb", linewidth=0.8, zorder=0)
    marks = (("p50", statistics.p50), ("p95", statistics.p95), ("p99", statistics.p99), ("p99.9", statistics.p999))
    for row, (name, value) in enumerate(marks):
        axes.axvline(value, color=_MARK, linewidth=0.9, linestyle=(0, (4, 2)))
        near_right = value > 0.75 * limit
        axes.annotate(
            f"{name} {value:.2f} ms",
            (value, 0.97 - 0.07 * row),
            xycoords=("data", "axes fraction"),
            xytext=(-4 if near_right else 4, 0),
            textcoords="offset points",
            ha="right" if near_right else "left",
            va="top",
            fontsize=8,
            color=_MARK,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )
    axes.set_xlim(0, limit)
    axes.set_ylim(bottom=0.7)
    more = f"; {beyond} beyond {limit:g} ms" if beyond else ""
    label(axes, f"Histogram (grid: steps of {step:g} ms{more})", "loop latency, ms", "samples")


def _stages(axes: Axes, report: LatencyReport) -> None:
    for row, stage in enumerate(STAGES):
        statistics = report.stages_ms[stage]
        axes.barh(row, statistics.p50, color=STAGE_COLORS[stage], height=0.6)
        axes.plot([statistics.p50, statistics.p99], [row, row], color=INK, linewidth=1.2)
        axes.plot([statistics.p99], [row], marker="|", color=INK, markersize=9)
        axes.annotate(
            f"{statistics.p50:.2f}",
            (statistics.p99, row),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=INK,
        )
    axes.set_yticks(range(len(STAGES)), [STAGE_NAMES[stage] for stage in STAGES])
    axes.invert_yaxis()
    axes.set_xlim(0, 1.15 * max(1e-3, *(report.stages_ms[stage].p99 for stage in STAGES)))
    label(axes, "Stages: bar to p50 (figure), line to p99", "ms", "")


def _tail(axes: Axes, report: LatencyReport) -> None:
    loop_ns, share_above = complementary_cdf(report.table.column("loop"))
    axes.step(loop_ns / 1e6, share_above, where="post", color=STAGE_COLORS["register_wait"], linewidth=1.4)
    _log_scale(axes)
    axes.grid(color="#e5e5e5", linewidth=0.6)
    for share, name in ((0.5, "p50"), (0.05, "p95"), (0.01, "p99"), (0.001, "p99.9")):
        if share >= share_above[-1]:
            axes.axhline(share, color=_MARK, linewidth=0.6, linestyle=(0, (4, 2)))
            axes.annotate(
                name,
                (0.995, share),
                xycoords=("axes fraction", "data"),
                ha="right",
                va="bottom",
                fontsize=8,
                color=_MARK,
            )
    axes.set_xlim(left=max(0.0, float(loop_ns[0]) / 1e6 - 0.1 * report.step_ms))
    label(axes, "Tail (share of samples that took longer)", "loop latency, ms", "share")


def _history(axes: Axes, run: Run, report: LatencyReport) -> None:
    # The slowest sample of each stretch, so that thinning hides none.
    stretch = -(-report.samples // _STRETCHES)
    count = -(-report.samples // stretch)
    time_s, slowest = np.zeros(count), np.zeros(count)
    at = 0
    for samples in report.table.blocks("loop", "sampled_ns", "incarnation"):
        stretches = np.arange(at, at + len(samples)) // stretch
        np.maximum.at(slowest, stretches, samples["loop"] / 1e6)
        # Of times that are given to the same stretch the last one is kept.
        time_s[stretches[::-1]] = run.time_s(samples)[::-1]
        at += len(samples)
    axes.plot(
        time_s,
        slowest,
        linestyle="none",
        marker=".",
        markersize=2.5,
        color=STAGE_COLORS["register_wait"],
        rasterized=True,
    )
    axes.set_ylim(0, 1.1 * float(slowest.max()))
    axes.axhline(report.step_ms, color="#bbbbbb", linewidth=0.8, zorder=0)
    label(axes, "Over time", "time in the run, s", "loop latency, ms")


def _log_scale(axes: Axes) -> None:
    # Ticks between the decades, and their powers set as formulas, would take as long to draw as all else.
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
