"""`hilrig jitter`: how well this machine keeps time."""

import json
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson

if TYPE_CHECKING:
    from hilrig_cli.bench.timing_benchmark import Timekeeping

COLUMNS = ("p50", "p95", "p99", "p999", "max")


def jitter(
    load: Annotated[bool, typer.Option("--load", help="Measure again with every processor kept busy.")] = False,
    step_ms: Annotated[float, typer.Option(metavar="MS", help="Step of the simulation.", min=0.5, max=1000)] = 20.0,
    seconds: Annotated[
        float, typer.Option(metavar="S", help="How long to measure, each time.", min=1, max=3600)
    ] = 20.0,
    as_json: AsJson = False,
) -> None:
    """Measure how well this machine keeps time, and say whether it is fit for a study at a step.

    A lab of its own runs on free ports with a quick controller: ticks, bus, Modbus and loop are those of the rig.
    Exit code 1: it is not fit; the reasons are printed.
    """
    from hilrig_cli.bench.jitter import measure_timekeeping
    from hilrig_sim.platform_fingerprint import machine_name

    measured = []
    for loaded in (False, True) if load else (False,):
        with ExitStack() as showing:
            tick = _progress(showing, "with load" if loaded else "measuring")
            measured.append(measure_timekeeping(step_ms, seconds, loaded, _say, tick))
    fit = not any(one.reasons for one in measured)
    if as_json:
        conditions = [one.as_dict() for one in measured]
        print(json.dumps({"machine": machine_name(), "step_ms": step_ms, "conditions": conditions, "fit": fit}))
    else:
        for one in measured:
            _print_table(one)
    if not fit:
        raise typer.Exit(1)


def _say(line: str) -> None:
    print(line, file=sys.stderr)


def _progress(showing: ExitStack, what: str) -> Callable[[float], None]:
    from rich.console import Console
    from rich.progress import Progress

    bar = showing.enter_context(Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True))
    task = bar.add_task(what, total=1.0)
    return lambda share: bar.update(task, completed=share)


def _print_table(one: "Timekeeping") -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    condition = "every processor kept busy" if one.loaded else "as it is"
    title = f"Step {one.step_ms:g} ms for {one.seconds:g} s, {condition}: {one.ticks} ticks"
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("ms", no_wrap=True)
    for column in COLUMNS:
        table.add_column(column.replace("p999", "p99.9"), justify="right", no_wrap=True)
    rows = {
        "tick lateness": one.tick_lateness_ms,
        "bus, both ways": one.bus_ms,
        "Modbus round trip": one.modbus_ms,
        "loop of a quick controller": one.loop_ms,
    }
    for name, statistics in rows.items():
        table.add_row(name, *(f"{getattr(statistics, column):.3f}" for column in COLUMNS))
    console.print(table)
    stolen = "not told by this system" if one.stolen is None else f"{100 * one.stolen:.2f} % of the processors"
    console.print(f"missed steps: {one.missed_steps}; taken away by the host: {stolen}")
    if one.reasons:
        text = f"not fit for a study at {one.step_ms:g} ms: {'; '.join(one.reasons)}"
        if one.fit_from_ms > one.step_ms:
            text += f" (these figures would do from a step of {one.fit_from_ms} ms on)"
        console.print(Text(text, style="yellow"))
    else:
        console.print(Text(f"fit for a study at {one.step_ms:g} ms", style="green"))
