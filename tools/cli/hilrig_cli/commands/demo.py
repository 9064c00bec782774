"""`hilrig demo`: runs a lab with the example controller and analyzes the recording."""

from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def demo(
    duration: Annotated[
        float | None,
        typer.Option(
            min=1.0, help="Duration of the controller, s; default: 20, and up to 20 more until its work is finished."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path("demo-out"),
    as_json: AsJson = False,
) -> None:
    """Run a lab with the example controller, then measure, verify and plot the recording.

    The controller, examples/pick_and_place.py, runs as a separate process and connects over Modbus TCP. Parts that it
    had no time to place are listed. Exit code 1: the loop never closed, the recording could not be verified, or a part
    that the controller reported as placed is not in the tray.
    """
    from rich.progress import Progress, TimeElapsedColumn

    from hilrig_cli.commands.latency import print_report
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.recordings import DemoOutput
    from hilrig_cli.local.demo import review, run_demo
    from hilrig_cli.terminal import TerminalConsole

    console = TerminalConsole(stderr=True, quiet=as_json)

    def log(line: str) -> None:
        console.print(f"hilrig: {line}", highlight=False, soft_wrap=True)

    with Progress(*Progress.get_default_columns(), TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task("controller", total=1.0)
        recorded = run_demo(duration, out, log, lambda share: progress.update(task, completed=share))
    with console.status("measuring, verifying and plotting the run"):
        result = review(recorded, out)
    if as_json:
        print_json(DemoOutput.model_validate(result.as_dict()))
    else:
        print_report(result.latency)
        for line in result.summary_lines():
            print(line)
    if not result.passed:
        raise typer.Exit(1)
