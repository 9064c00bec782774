"""`hilrig demo`: the whole rig with a controller over real Modbus TCP, then everything that a recording tells."""

import json
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def demo(
    duration: Annotated[
        float | None,
        typer.Option(
            min=1.0, help="How long the controller runs, seconds; where it is not said, 20, or more to finish its work."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path("demo-out"),
    as_json: AsJson = False,
) -> None:
    """Run the whole rig with the example controller, then measure, verify and draw what was recorded.

    The controller, examples/pick_and_place.py, is a process of its own that speaks Modbus TCP. Parts that it had no
    time to place are named. Exit code 1: the loop never closed, the recording could not be verified, or a part does not
    stand where the controller believes it to.
    """
    from rich.console import Console
    from rich.progress import Progress, TimeElapsedColumn

    from hilrig_cli.commands.latency import print_report
    from hilrig_cli.local.demo import review, run_demo

    console = Console(stderr=True, quiet=as_json)

    def say(line: str) -> None:
        console.print(f"hilrig: {line}", highlight=False, soft_wrap=True)

    with Progress(*Progress.get_default_columns(), TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task("controller", total=1.0)
        recorded = run_demo(duration, out, say, lambda share: progress.update(task, completed=share))
    with console.status("measuring, verifying and drawing the run"):
        found = review(recorded, out)
    if as_json:
        print(json.dumps(found.as_dict()))
    else:
        print_report(found.latency)
        for line in found.sentences():
            print(line)
    if not found.good:
        raise typer.Exit(1)
