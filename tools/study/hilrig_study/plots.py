"""Plots of a study: cost over the parameter plane with theoretical stability limits, and traces at chosen points."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from hilrig_replay.plots.output import save_figure
from hilrig_replay.plots.palette import RUN_COLORS, TEXT_COLOR
from hilrig_runtime.escaping import plot_text
from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_study.study_config import AxisConfig, PointConfig, StudyConfig
from hilrig_study.sweep import SweepResult, cell_at, run_cells
from hilrig_study.theory.gain_theory import GainTheory

Floats = NDArray[np.float64]

FAILED_COLOR: Final = "#5b5b5b"
STABILITY_LIMIT_COLOR: Final = "#d62728"
DELAY_MARGIN_COLOR: Final = "#ffffff"
JITTER_MARGIN_COLOR: Final = "#f5a623"
MEAN_SQUARE_COLOR: Final = "#ff5fc8"
_TRACE_LETTERS: Final = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


@dataclass(frozen=True, slots=True)
class Trace:
    """Simulated run at a chosen point of the plane."""

    letter: str
    point: PointConfig
    controller: int
    time_s: Floats
    """(T,)."""
    error: Floats
    """Position minus set point; degrees, degrees, mm, degrees, (T, 4)."""
    effort: Floats
    """N·m, N·m, N, N·m, (T, 4)."""
    outcome: str
    """Human-readable outcome."""


@dataclass(frozen=True, slots=True)
class Marker:
    """Plot marker of a point that was measured on the live loop."""

    x: float
    y: float
    as_predicted: bool


def traces(study: StudyConfig, folder: Path) -> list[Trace]:
    """Simulate the points in the study's `traces`.

    Raises:
        InputError: as `run_cells`.
    """
    names = [controller.name for controller in study.controllers]
    found = []
    for letter, point in zip(_TRACE_LETTERS, study.traces, strict=False):
        number = names.index(point.controller) if point.controller else 0
        cells = cell_at(study, point.x, point.y, number)
        results, outcome = run_cells(study, cells, folder, keep=True)
        step_s = float(cells["step_ms"][0]) * 1e-3
        time_s: Floats = np.asarray(np.arange(len(outcome.positions)) * step_s, dtype=np.float64)
        goal = study.task.scenario().goal(time_s).T
        outcome_text = "settles" if results["settled"][0] else "does not settle"
        if not math.isnan(results["failed_s"][0]):
            outcome_text = f"fails at {results['failed_s'][0]:.2f} s"
        # After a failure the simulated arm is parked: show no data.
        failed_s = results["failed_s"]
        active = np.where(np.isnan(failed_s) | (time_s <= failed_s), 1.0, np.nan)[:, np.newaxis]
        error = active * (outcome.positions[:, :, 0] - goal) * JOINT_SCALE
        found.append(Trace(letter, point, number, time_s, error, active * outcome.efforts[:, :, 0], outcome_text))
    return found


def plane_figure(
    study: StudyConfig, swept: SweepResult, number: int, points: Sequence[Trace] = (), markers: Sequence[Marker] = ()
) -> Figure:
    """Plot the plane of one controller: mean cost as color (gray: failed runs), theory as lines, points and markers."""
    shown = [trace for trace in points if trace.controller == number]
    figure = Figure(figsize=(11, 5.2) if shown else (7, 5.2), layout="constrained", dpi=100)
    if shown:
        grid = figure.add_gridspec(len(shown), 2, width_ratios=(1.25, 1))
        axes = figure.add_subplot(grid[:, 0])
        _draw_traces([figure.add_subplot(grid[row, 1]) for row in range(len(shown))], shown, study)
    else:
        axes = figure.subplots()
    cost = swept.plane(study, number, swept.results["cost"])
    finite = cost[np.isfinite(cost)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.1, 10.0)
    norm = LogNorm(max(low, 1e-9), max(high, low * 1.01, 1.1e-9))
    axes.set_facecolor(FAILED_COLOR)
    mesh = axes.pcolormesh(
        study.x.points,
        study.y.points,
        np.ma.masked_invalid(cost),
        norm=norm,
        cmap="viridis",
        shading="nearest",
        rasterized=True,
    )
    bar = figure.colorbar(mesh, ax=axes, pad=0.01, ticks=LogLocator(subs=(1.0, 2.0, 5.0)), format="%g")
    bar.ax.yaxis.set_minor_formatter(NullFormatter())
    bar.set_label("mean of Σ (error / 1° or 1 mm)² + 0.01 Σ effort²", fontsize=8)
    axes.set(xscale=study.x.spacing, yscale=study.y.spacing)
    theory = [entry for entry in swept.theory if entry.controller == number]
    predicts = study.controllers[number].kind == "lqr" and study.controllers[number].compensate
    _draw_theory(axes, study, theory, predicts)
    _draw_radius(axes, study, swept, number)
    for trace in shown:
        axes.annotate(
            trace.letter,
            (trace.point.x, trace.point.y),
            ha="center",
            va="center",
            fontsize=9,
            color="white",
            bbox={"boxstyle": "circle,pad=0.2", "facecolor": "black", "edgecolor": "white"},
        )
    for as_predicted, color, label in (
        (True, "#7CFC00", "live: as predicted"),
        (False, "#ff4d4d", "live: not as predicted"),
    ):
        rows = [marker for marker in markers if marker.as_predicted is as_predicted]
        if rows:
            axes.scatter(
                [marker.x for marker in rows],
                [marker.y for marker in rows],
                c=color,
                edgecolors="black",
                s=46,
                zorder=5,
                label=label,
            )
    axes.set(xlim=_ends(study.x), ylim=_ends(study.y))
    axes.set_xlabel(plot_text(study.x.label), color=TEXT_COLOR)
    axes.set_ylabel(plot_text(study.y.label), color=TEXT_COLOR)
    title = plot_text(f"{study.title}: {study.controllers[number].name}")
    axes.set_title(title, fontsize=10, loc="left", color=TEXT_COLOR)
    axes.scatter([], [], marker="s", c=FAILED_COLOR, label="a run failed")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=4 if shown else 2, fontsize=8, facecolor="#cfcfcf")
    return figure


def _ends(axis: AxisConfig) -> tuple[float, float]:
    points = axis.points
    low, high = float(points.min()), float(points.max())
    if len(points) < 2:
        return 0.9 * low, 1.1 * high
    half = 0.0 if axis.spacing == "log" else (high - low) / (len(points) - 1) / 2
    return low - half, high + half


def _draw_theory(axes: Axes, study: StudyConfig, theory: Sequence[GainTheory], predicts: bool) -> None:
    """Draw stability limits over the gain, if one axis is the gain and the other an added delay or jitter."""
    what = (study.x.what, study.y.what)
    if "gain" not in what or not theory:
        return
    other = what[0] if what[1] == "gain" else what[1]
    gain = np.array([entry.gain for entry in theory])
    order = np.argsort(gain)
    lines: list[tuple[str, str, str, list[float]]] = []
    # The margins of a predictor are for a latency that it does not measure.
    unknown = ", unmeasured" if predicts else ""
    random = not all(math.isnan(entry.mean_square_until) for entry in theory)
    if other == "delay_ms":
        label = "spectral radius 1, constant delay only" if random else "exact: spectral radius 1"
        lines.append((label, STABILITY_LIMIT_COLOR, "-", [entry.stable_until_ms for entry in theory]))
        lines.append(
            (f"delay margin{unknown}", DELAY_MARGIN_COLOR, "--", [_margin_ms(entry, "delay") for entry in theory])
        )
    if other in ("delay_ms", "jitter_ms"):
        lines.append(
            (f"jitter margin{unknown}", JITTER_MARGIN_COLOR, ":", [_margin_ms(entry, "jitter") for entry in theory])
        )
    if random:
        lines.append(
            ("mean-square stability limit", MEAN_SQUARE_COLOR, "-.", [entry.mean_square_until for entry in theory])
        )
    largest = float(max(study.x.points.max() if other == what[0] else study.y.points.max(), 1e-9))
    for label, color, style, values_ms in lines:
        values = np.array(values_ms)[order]
        # Values beyond the plane are clipped outside its edge, so that the lines extend to the edge.
        values = np.where(values < 0, np.nan, np.minimum(values, 2 * largest))
        if not (values <= largest).any():
            continue
        across, up = (values, gain[order]) if other == what[0] else (gain[order], values)
        axes.plot(across, up, color=color, linestyle=style, linewidth=1.8, label=label)


def _margin_ms(theory: GainTheory, kind: str) -> float:
    """Return a margin as additional delay, ms; NaN if the loop is unstable at its nominal latency."""
    if theory.nominal is None or not theory.nominal.stable:
        return math.nan
    return 1e3 * (theory.nominal.delay_margin_s if kind == "delay" else theory.nominal.jitter_margin_s)


def _draw_radius(axes: Axes, study: StudyConfig, swept: SweepResult, number: int) -> None:
    """Draw the contour of spectral radius 1 on planes without a gain axis."""
    if "gain" in (study.x.what, study.y.what):
        return
    radius = swept.plane(study, number, swept.radius)
    if np.isfinite(radius).all() and radius.min() < 1 < radius.max():
        axes.contour(
            study.x.points, study.y.points, radius, levels=[1.0], colors=[STABILITY_LIMIT_COLOR], linewidths=1.8
        )


def _draw_traces(panels: Sequence[Axes], shown: Sequence[Trace], study: StudyConfig) -> None:
    for axes, trace in zip(panels, shown, strict=True):
        for joint, (name, unit) in enumerate((("θ1", "°"), ("θ2", "°"))):
            axes.plot(
                trace.time_s, trace.error[:, joint], color=RUN_COLORS[joint], linewidth=1.0, label=f"{name}, {unit}"
            )
        where = f"{study.x.label} {trace.point.x:g}; {study.y.label} {trace.point.y:g}"
        axes.set_title(f"{trace.letter}: {trace.outcome} ({where})", fontsize=8, loc="left", color=TEXT_COLOR)
        axes.tick_params(labelsize=7)
        axes.grid(color="#e5e5e5", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        largest = float(np.nanmax(np.abs(trace.error[:, :2]), initial=1e-3))
        axes.set_ylim(-1.1 * largest, 1.1 * largest)
    panels[0].legend(fontsize=7, loc="upper right", title="error", title_fontsize=7)
    panels[-1].set_xlabel("time, s", fontsize=8, color=TEXT_COLOR)


def save_plots(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as PNG and SVG and return the paths.

    Raises:
        OperationError: a file can't be written.
    """
    paths = [stem.with_suffix(".png"), stem.with_suffix(".svg")]
    for path in paths:
        save_figure(figure, path)
    return paths
