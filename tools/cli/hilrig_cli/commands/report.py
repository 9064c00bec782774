"""`hilrig report`: runs as one page to read, print or hand in, and their grades."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def report(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.MCAP…", help="Recordings, or folders of recordings.", show_default=False),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The page to write.")] = Path("report.html"),
    verify: Annotated[
        bool, typer.Option("--verify", help="Re-simulate each run, and say whether it is the same.")
    ] = False,
    task: Annotated[
        Path | None,
        typer.Option(
            metavar="LAB.TOML",
            help="Grade by the \\[task] of this lab's file; without: by the one that was recorded.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write one HTML page of a run, or of a class of runs, ranked: motion, task, latency, events; no network needed.

    Runs of a class that were driven by the same torques, as when one was replayed, are named. Exit code 1: a recording
    of several could not be read; the page says which, and why.
    """
    from rich.console import Console
    from rich.progress import Progress

    from hilrig_replay.grading.task_loading import load_task
    from hilrig_replay.io.paths import find_recordings
    from hilrig_replay.io.recording_file import refuse_recording
    from hilrig_replay.report.report import build_report
    from hilrig_runtime.errors import InputError, OperationError

    if not out.parent.is_dir():
        raise InputError(f"{out}: folder {out.parent} does not exist")
    refuse_recording(out)
    graded_by = None if task is None else load_task(task)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        doing = bar.add_task("reading and drawing", total=1.0)
        found = build_report(
            find_recordings(runs),
            verified=verify,
            task=graded_by,
            on_progress=lambda share: bar.update(doing, completed=share),
            workers=None,
        )
    try:
        out.write_text(found.html, encoding="utf-8")
    except OSError as error:
        raise OperationError(f"{out}: can't be written: {error.strerror or error}") from error
    if as_json:
        print(
            json.dumps({"page": str(out), "runs": found.runs, "left_out": found.left_out, "alike": found.same_torques})
        )
    else:
        print(out)
        for reason in found.left_out:
            print(f"left out: {reason}", file=sys.stderr)
        for pair in found.same_torques:
            print(f"same torques: {pair}", file=sys.stderr)
    if found.left_out:
        raise typer.Exit(1)
