"""`hilrig figures`: reproduces figures 4, 5 and 6 of the paper and checks their numbers."""

import json
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson


def figures(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the figures.")] = Path("figures"),
    step_ms: Annotated[float, typer.Option(help="Step of the fixed-step methods, ms.")] = 20.0,
    as_json: AsJson = False,
) -> None:
    """Repeat the paper's experiment with Euler, Dormand–Prince and Runge–Kutta–Fehlberg, and plot its figures.

    Exit code 1: a number differs from the expected one at the paper's step of 20 ms.
    """
    from rich.table import Table

    from hilrig_cli.terminal import TerminalConsole
    from hilrig_replay.plots.output import check_plot_path, save_figure
    from hilrig_runtime.errors import OperationError
    from hilrig_sim.validation.paper_figures import compute, draw

    found = compute(step_ms)
    drawn = draw(found)
    files = [out / name for name in drawn]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OperationError(f"{out}: can't be written: {error.strerror}") from error
    for path in files:
        check_plot_path(path)
    for path, figure in zip(files, drawn.values(), strict=True):
        save_figure(figure, path)
    if as_json:
        print(json.dumps(found.as_dict() | {"files": [str(path) for path in files]}))
    else:
        console = TerminalConsole()
        title = "Experiment (44) of the paper"
        columns = ("quantity", "expected", "computed", "agrees")
        table = Table(*columns, title=title, title_justify="left", title_style="bold")
        for name, expected, computed, holds in found.checks():
            table.add_row(name, expected, computed, "yes" if holds else "no", style=None if holds else "red")
        console.print(table)
        for path in files:
            console.print(str(path), soft_wrap=True)
    if not all(holds for *_, holds in found.checks()):
        raise typer.Exit(1)
