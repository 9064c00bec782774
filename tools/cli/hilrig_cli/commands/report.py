"""`hilrig report`: HTML report of one run, or of a ranked group of runs."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def report(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.MCAP", help="Recordings, or folders of recordings.", show_default=False),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="HTML file to write.")] = Path("report.html"),
    verify: Annotated[
        bool, typer.Option("--verify", help="Re-simulate each run and report whether it is reproduced.")
    ] = False,
    task: Annotated[
        Path | None,
        typer.Option(
            metavar="LAB.TOML",
            help="Grade by the \\[task] of this configuration file; default: by the recorded task.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write an HTML report of one run, or of a ranked group of runs: motion, task, latency, events.

    The page works without a network. Runs with the same torques (for example a replayed run) are listed. Exit code 1:
    at least one of several recordings could not be read; the report lists it with the reason.
    """
    from rich.progress import Progress

    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.recordings import ReportedRun, ReportOutput
    from hilrig_cli.terminal import TerminalConsole
    from hilrig_replay.grading.task_loading import load_task
    from hilrig_replay.io.output_file import check_output, output_file
    from hilrig_replay.io.paths import find_runs
    from hilrig_replay.report.report import build_report
    from hilrig_runtime.escaping import printable

    found = find_runs(runs)
    inputs = [path for files in found for path in files] + ([] if task is None else [task])
    check_output(out, inputs)
    graded_by = None if task is None else load_task(task)
    console = TerminalConsole(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("reading and plotting", total=1.0)
        result = build_report(
            found,
            verified=verify,
            task=graded_by,
            on_progress=lambda share: progress.update(bar, completed=share),
            workers=None,
        )
    with output_file(out, inputs) as page:
        page.write_text(result.html, encoding="utf-8")
    if as_json:
        print_json(
            ReportOutput(
                page=str(out),
                runs=tuple(map(ReportedRun.model_validate, result.runs)),
                left_out=result.left_out,
                alike=result.same_torques,
                overlaps=result.overlaps,
            )
        )
    else:
        print(printable(str(out)))
        for reason in result.left_out:
            print(f"skipped: {printable(reason)}", file=sys.stderr)
        for pair in result.same_torques:
            print(f"same torques: {printable(pair)}", file=sys.stderr)
        for sentence in result.overlaps:
            print(printable(sentence), file=sys.stderr)
    if result.left_out:
        raise typer.Exit(1)
