"""`hilrig compare`: how one run differs from another."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson

if TYPE_CHECKING:
    from hilrig_replay.analysis.compare import Comparison


OTHERWISE = {
    "command": "nothing moved under command, so it is aligned by its first command",
    "start": "no controller commanded, so it is aligned by its start",
}
"""What a run without motion is aligned by, for people."""


def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="A.MCAP B.MCAP…", help="Recordings; the first is the reference.")
    ],
    align: Annotated[
        str, typer.Option(help="What is time zero: motion, start, or an event's kind, such as part_picked.")
    ] = "motion",
    plot: Annotated[Path | None, typer.Option(help="Draw them (.png, .svg, .pdf).", show_default=False)] = None,
    save: Annotated[
        Path | None, typer.Option(metavar="BOTH.RRD", help="Write a rerun file with all arms.", show_default=False)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Align runs in time and show how they differ from the first: positions, the tool, torques, loop latency.

    Exit code 1: one of several could not be compared; it is said which, and why.
    """
    from hilrig_replay.analysis.compare import compare as compare_runs
    from hilrig_replay.io.run import open_run
    from hilrig_replay.plots.comparison_plot import save_comparison_plot
    from hilrig_replay.rerun_view.view import save_rrd
    from hilrig_runtime.errors import InputError

    opened, unreadable = [], []
    for path in runs:
        try:
            opened.append(open_run(path))
        except InputError as error:
            # Among several a bad one does not hide the others; without the reference there is nothing to compare with.
            if not opened or len(runs) == 2:
                raise
            unreadable.append(str(error))
    if unreadable and len(opened) == 1:
        raise InputError("\n".join(unreadable))
    comparison = compare_runs(opened, align)
    comparison = replace(comparison, left_out=(*unreadable, *comparison.left_out))
    if plot is not None:
        save_comparison_plot(comparison, plot)
    if save is not None:
        save_rrd(comparison.runs, save)
    if as_json:
        print(json.dumps(comparison.as_dict()))
    else:
        _print(comparison)
        for reason in comparison.left_out:
            print(f"left out: {reason}", file=sys.stderr)
    if comparison.left_out:
        raise typer.Exit(1)


def _print(comparison: "Comparison") -> None:
    from math import degrees

    from rich.console import Console
    from rich.table import Table

    reference = comparison.summaries[0]
    title = f"Against {reference.session}, aligned by {comparison.aligned_by}"
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("")
    for difference in comparison.differences:
        table.add_column(difference.session, justify="right", overflow="fold")
    each = comparison.differences
    table.add_row("common time, s", *(f"{one.overlap_s:.2f}" for one in each), end_section=True)
    table.add_row("tools apart, rms, mm", *(f"{one.tool_rms_mm:.3f}" for one in each))
    table.add_row("tools apart, largest, mm", *(f"{one.tool_max_mm:.3f}" for one in each), end_section=True)
    for joint, (name, unit) in enumerate((("θ1", "°"), ("θ2", "°"), ("d3", "mm"), ("θ4", "°"))):

        def shown(value: float, in_mm: bool = unit == "mm") -> str:
            return f"{value * 1000 if in_mm else degrees(value):.3f}"

        figures = (f"{shown(one.position_rms[joint])} / {shown(one.position_max[joint])}" for one in each)
        table.add_row(f"{name}, rms / largest, {unit}", *figures, end_section=joint == 3)
    efforts = (" ".join(f"{value:.3f}" for value in one.effort_rms) for one in each)
    table.add_row("τ1 τ2 τ3 τ4, rms, N·m (τ3: N)", *efforts, end_section=True)
    for name, values in (
        ("loop latency p50, ms more", [one.loop_p50_ms for one in each]),
        ("loop latency p99, ms more", [one.loop_p99_ms for one in each]),
    ):
        table.add_row(name, *("–" if value is None else f"{value:+.3f}" for value in values))
    console = Console()
    console.print(table)
    for summary, origin in zip(comparison.summaries, comparison.origins, strict=True):
        if (why := OTHERWISE.get(origin.by)) and origin.by != comparison.aligned_by:
            console.print(f"{summary.session}: {why}", highlight=False, markup=False)
