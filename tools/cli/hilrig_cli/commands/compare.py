"""`hilrig compare`: differences between runs."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson

if TYPE_CHECKING:
    from hilrig_replay.analysis.compare import Comparison


FALLBACK_TEXTS = {
    "command": "no motion under command; aligned by its first command instead",
    "start": "no command by a controller; aligned by its start instead",
}
"""Note on a run that could not be aligned as requested, by the alignment used instead."""


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN.MCAP", help="Recordings; the first one is the reference.")],
    align: Annotated[
        str, typer.Option(help="Time zero: motion, start, or a kind of event, such as part_picked.")
    ] = "motion",
    plot: Annotated[Path | None, typer.Option(help="Write a plot (.png, .svg, .pdf).", show_default=False)] = None,
    save: Annotated[
        Path | None, typer.Option(metavar="ALL.RRD", help="Write a rerun file with all arms.", show_default=False)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Align runs in time and print their differences from the first: tool, positions, torques, loop latency.

    Exit code 1: at least one of several recordings could not be compared; it is listed with the reason.
    """
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.recordings import CompareOutput
    from hilrig_replay.analysis.compare import compare as compare_runs
    from hilrig_replay.io.isolation import isolated
    from hilrig_replay.io.paths import find_each_run
    from hilrig_replay.io.run import open_run
    from hilrig_replay.plots.comparison_plot import save_comparison_plot
    from hilrig_replay.rerun_view.view import save_rrd
    from hilrig_runtime.errors import HilrigError, InputError
    from hilrig_runtime.escaping import printable

    opened, unreadable = [], []
    found = find_each_run(runs)
    if len(found) == 1:
        raise InputError(f"a comparison requires at least two runs, got one: {found[0][0]}")
    for files in found:
        try:
            with isolated(files[0]):
                opened.append(open_run(files))
        except HilrigError as error:
            # One unreadable recording of several is skipped; the reference is required.
            if not opened or len(found) == 2:
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
        print_json(CompareOutput.model_validate(comparison.as_dict()))
    else:
        _print(comparison)
        for reason in comparison.left_out:
            print(f"skipped: {printable(reason)}", file=sys.stderr)
    if comparison.left_out:
        raise typer.Exit(1)


def _print(comparison: "Comparison") -> None:
    from math import degrees

    from hilrig_cli.terminal import TerminalConsole, TerminalTable

    reference = comparison.summaries[0]
    title = f"Against {reference.session}, aligned by {comparison.aligned_by}"
    table = TerminalTable(title=title)
    table.add_column("")
    for difference in comparison.differences:
        table.add_column(difference.session.replace("Z-", "Z-\n", 1), justify="right", overflow="fold")
    each = comparison.differences
    table.add_row("common time, s", *(f"{one.overlap_s:.2f}" for one in each), end_section=True)
    table.add_row("tool distance, rms, mm", *(f"{one.tool_rms_mm:.3f}" for one in each))
    table.add_row("tool distance, max, mm", *(f"{one.tool_max_mm:.3f}" for one in each), end_section=True)
    for joint, (name, unit) in enumerate((("θ1", "°"), ("θ2", "°"), ("d3", "mm"), ("θ4", "°"))):

        def formatted(value: float, in_mm: bool = unit == "mm") -> str:
            return f"{value * 1000 if in_mm else degrees(value):.3f}"

        figures = (f"{formatted(one.position_rms[joint])} / {formatted(one.position_max[joint])}" for one in each)
        table.add_row(f"{name}, rms / max, {unit}", *figures, end_section=joint == 3)
    efforts = (" ".join(f"{value:.3f}" for value in one.effort_rms) for one in each)
    table.add_row("τ1 τ2 τ3 τ4, rms, N·m (τ3: N)", *efforts, end_section=True)
    for name, values in (
        ("Δ loop latency p50, ms", [one.loop_p50_ms for one in each]),
        ("Δ loop latency p99, ms", [one.loop_p99_ms for one in each]),
        ("Δ age p50, ms", [one.age_p50_ms for one in each]),
        ("Δ age p99, ms", [one.age_p99_ms for one in each]),
    ):
        table.add_row(name, *("–" if value is None else f"{value:+.3f}" for value in values))
    console = TerminalConsole()
    console.print(table)
    for summary, origin in zip(comparison.summaries, comparison.origins, strict=True):
        if (note := FALLBACK_TEXTS.get(origin.by)) and origin.by != comparison.aligned_by:
            console.print(f"{summary.session}: {note}", highlight=False)
