"""`hilrig demo`: the whole rig with a controller over real Modbus TCP, then everything that a recording tells."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def demo(
    duration: Annotated[float, typer.Option(min=1.0, help="How long the controller runs, seconds.")] = 20.0,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo-out"),
    as_json: AsJson = False,
) -> None:
    """Run the whole rig with the example controller, then measure, verify and draw what was recorded.

    The controller, examples/pick_and_place.py, is a process of its own that speaks Modbus TCP. Exit code 1: the loop
    never closed, or the run could not be verified.
    """
    from rich.console import Console
    from rich.progress import Progress, TimeElapsedColumn

    from hilrig_cli.demo import run_demo
    from hilrig_replay.latency import measure
    from hilrig_replay.latency_plot import save_plot
    from hilrig_replay.rerun_view import save_rrd
    from hilrig_replay.run import open_run

    console = Console(stderr=True, quiet=as_json)
    with Progress(*Progress.get_default_columns(), TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task("controller", total=1.0)
        result = run_demo(
            duration,
            out,
            say=lambda line: console.print(f"hilrig: {line}", highlight=False),
            tick=lambda share: progress.update(task, completed=share),
        )
    run = open_run(result.recording)
    report = measure(run)
    plot, rrd = out / "latency.png", out / "run.rrd"
    save_plot(report, run, plot)
    save_rrd(run, rrd)
    if as_json:
        print(json.dumps({"recording": str(result.recording), "rrd": str(rrd), "plot": str(plot), "latency": report.as_dict()}))
    sys.exit(0)
