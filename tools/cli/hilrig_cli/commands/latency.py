"""`hilrig latency`: loop latency of recordings, from a state to the tick at which its torque acts."""

import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hilrig_replay.analysis.latency import LatencyReport
    from hilrig_replay.io.run import Run
    from hilrig_runtime.config.task import TaskConfig


def latency(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.MCAP", help="Recordings, or folders of recordings.", show_default=False),
    ],
    plot: Annotated[
        Path | None,
        typer.Option(
            help="Write a plot of histogram, stages, tail and history (.png, .svg, .pdf); one recording only.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure loop latency and age of recordings: stages, percentiles, jitter, losses, and a diagnosis.

    The loop latency is measured once per command that took effect, the age of the basis of the acting torque at every
    step.

    Exit code 1: a recording is not valid for latency measurements, or one of several is unreadable; the reasons are
    printed.
    """
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.recordings import LatencyOutput, LatencyRunsOutput
    from hilrig_replay.analysis.intervals import aggregate
    from hilrig_replay.analysis.latency import measure
    from hilrig_replay.io.isolation import isolated
    from hilrig_replay.io.paths import display_names, find_runs
    from hilrig_replay.io.run import open_run
    from hilrig_runtime.errors import HilrigError, InputError
    from hilrig_runtime.escaping import printable

    found = find_runs(runs)
    paths = [files[0] for files in found]
    if plot is not None:
        from hilrig_replay.plots.latency_plot import save_plot
        from hilrig_replay.plots.output import check_plot_path

        if len(paths) > 1:
            raise InputError(f"--plot: expected one recording, got {len(paths)}")
        check_plot_path(plot, found[0])
    reports, unreadable = [], []
    for path, files in zip(paths, found, strict=True):
        try:
            with isolated(path):
                run = open_run(files)
                report = measure(run, task=_task(run))
        except HilrigError as error:
            # An unreadable recording of several is reported in its own line.
            if len(paths) == 1:
                raise
            unreadable.append({"path": str(path), "reason": str(error)})
            continue
        if plot is not None:
            save_plot(report, run, plot)
        # Of each recording only the statistics are kept, not the samples.
        reports.append((path, report.without_table()))
    if as_json:
        every = [{"path": str(path), **each.as_dict()} for path, each in reports]
        if len(paths) == 1:
            print_json(LatencyOutput.model_validate(reports[0][1].as_dict()))
        else:
            overview = {"runs": every, "aggregate": aggregate(every), "unreadable": unreadable}
            print_json(LatencyRunsOutput.model_validate(overview))
    elif len(paths) == 1:
        print_report(reports[0][1])
    else:
        names = display_names(paths)
        print_overview({names[path]: each for path, each in reports})
        for bad in unreadable:
            print(printable(bad["reason"]), file=sys.stderr)
    if unreadable or not all(each.fit for _, each in reports):
        raise typer.Exit(1)


def _task(run: "Run") -> "TaskConfig | None":
    """The recorded task; None: not recorded, or of another version, which only a grade reports."""
    from hilrig_replay.grading.task_loading import recorded_task
    from hilrig_runtime.errors import InputError

    with suppress(InputError):
        return recorded_task(run)
    return None


def print_report(report: "LatencyReport") -> None:
    """Print the latency report of one run: a table, losses, findings and the verdict."""
    from rich.text import Text

    from hilrig_cli.terminal import TerminalConsole, TerminalTable
    from hilrig_replay.analysis.diagnosis.evidence import sections
    from hilrig_replay.analysis.distribution import STATISTICS_TITLES
    from hilrig_replay.analysis.intervals import cells

    console = TerminalConsole()
    title = f"Loop latency of {report.session}: {report.samples} samples, step {report.step_ms:g} ms"
    table = TerminalTable(title=title)
    table.add_column("ms", no_wrap=True)
    for title in STATISTICS_TITLES:
        table.add_column(title, justify="right", no_wrap=True)
    if report.loop_ms is not None:
        values = cells(report.loop_ms, report.intervals_ms["loop"])
        table.add_row(f"loop{report.qualifier}", *values, style="bold", end_section=True)
        for stage in report.stages:
            table.add_row(f"  {stage.title}", *cells(report.stages_ms[stage.key], report.intervals_ms[stage.key]))
        table.add_section()
    if report.age_ms is not None:
        values = cells(report.age_ms, report.intervals_ms["age"])
        table.add_row(f"age{report.qualifier}", *values, style="bold", end_section=True)
    table.add_row("tick lateness", *cells(report.jitter_ms.tick_lateness, report.intervals_ms["tick_lateness"]))
    console.print(table)
    jitter = f"jitter: std {report.jitter_ms.loop_std:.2f} ms, p99 − p1 {report.jitter_ms.loop_p99_p1:.2f} ms; "
    lost = f"lost: {report.lost.transport} in transport, {report.lost.recorder} in the recorder"
    if report.lost.file:
        lost += f", {report.lost.file} in the file"
    console.print(lost if report.loop_ms is None else jitter + lost)
    for note in report.notes():
        console.print(Text(note))
    for title, sentences in sections(report.findings):
        console.print(f"{title}:")
        for sentence in sentences:
            console.print(Text(f"• {sentence}"))
    if report.fit:
        console.print(Text("valid for latency measurements", style="green"))
    else:
        console.print(Text(f"not valid for latency measurements: {report.reason_text()}", style="yellow"))


def print_overview(reports: "Mapping[str, LatencyReport]") -> None:
    """Print a table of runs by name, one line each, their medians, and below it their findings or reasons."""
    from rich.text import Text

    from hilrig_cli.terminal import TerminalConsole, TerminalTable
    from hilrig_replay.analysis.intervals import aggregate, rounded

    console = TerminalConsole()
    title = f"Loop latency of {len(reports)} runs, ms"
    table = TerminalTable(title=title, padding=0, show_edge=False)
    # The figures leave 18 of 80 characters: the time of a session, and its rig in a second line.
    table.add_column("run", overflow="fold", min_width=18)
    for column in ("samples", "p50", "p99", "p99.9", "max", "age p50", "age p99"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("valid")
    columns = [("loop", name) for name in ("p50", "p99", "p999", "max")] + [("age", name) for name in ("p50", "p99")]
    for name, report in reports.items():
        found = {"loop": report.loop_ms, "age": report.age_ms}
        figures = [
            "–"
            if (statistics := found[quantity]) is None
            else rounded(getattr(statistics, key), report.intervals_ms[quantity].get("p999" if key == "max" else key))
            for quantity, key in columns
        ]
        label = name if console.width > 90 else name.replace("Z-", "Z-\n", 1)
        table.add_row(label, str(report.samples), *figures, "yes" if report.fit else "no")
    over_runs = aggregate([report.as_dict() for report in reports.values()])
    if over_runs:
        table.add_section()
        medians = [over_runs.get(f"{quantity}_ms", {}).get(key) for quantity, key in columns]
        texts = ["–" if found is None else rounded(found["median"], found["interval"]) for found in medians]
        table.add_row("median over runs", "", *texts, "", style="bold")
        if any(found and found["interval"] for found in medians):
            for bound, label in enumerate(("95 % interval from", "to")):
                texts = [
                    "–" if not (found and found["interval"]) else rounded(found["interval"][bound], found["interval"])
                    for found in medians
                ]
                table.add_row(label, "", *texts, "")
    console.print(table, "")
    for name, report in reports.items():
        note = report.reason_text() or ", ".join(finding.code.replace("_", " ") for finding in report.findings)
        if note:
            console.print(Text(f"{name}: {'' if report.fit else 'not valid: '}{note}"))
