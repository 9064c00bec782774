"""`hilrig jitter`: timing benchmark of this host."""

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, log

if TYPE_CHECKING:
    from hilrig_cli.bench.timing_benchmark import TimingResult

COLUMNS = ("p50", "p95", "p99", "p999", "max")


def jitter(
    load: Annotated[bool, typer.Option("--load", help="Measure a second time under CPU load on every core.")] = False,
    step_ms: Annotated[float, typer.Option(metavar="MS", help="Step of the simulation.", min=0.5, max=1000)] = 20.0,
    seconds: Annotated[float, typer.Option(metavar="S", help="Duration of each measurement.", min=1, max=3600)] = 20.0,
    as_json: AsJson = False,
) -> None:
    """Measure the timing of this host: tick lateness, bus, Modbus and loop latency of a lab with a fast controller.

    The lab runs on free ports. The result is a verdict: suitable or not suitable for a study at the given step.
    Exit code 1: not suitable; the reasons are printed.
    """
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.study import JitterCondition, JitterOutput
    from hilrig_sim.platform_fingerprint import machine_name

    measured = [_measure(step_ms, seconds, loaded) for loaded in ((False, True) if load else (False,))]
    is_suitable = not any(result.reasons for result in measured)
    if as_json:
        conditions = [JitterCondition.model_validate(result.as_dict()) for result in measured]
        machine = machine_name()
        print_json(JitterOutput(machine=machine, step_ms=step_ms, conditions=conditions, fit=is_suitable))
    else:
        for result in measured:
            _print_table(result)
    if not is_suitable:
        raise typer.Exit(1)


def _measure(step_ms: float, seconds: float, loaded: bool) -> "TimingResult":
    from rich.progress import Progress

    from hilrig_cli.bench.jitter import measure_timing
    from hilrig_cli.terminal import TerminalConsole

    with Progress(console=TerminalConsole(stderr=True), disable=not sys.stderr.isatty(), transient=True) as progress:
        task = progress.add_task("with load" if loaded else "measuring", total=1.0)
        return measure_timing(step_ms, seconds, loaded, log, lambda share: progress.update(task, completed=share))


def _print_table(result: "TimingResult") -> None:
    from rich.text import Text

    from hilrig_cli.terminal import TerminalConsole, TerminalTable

    console = TerminalConsole()
    condition = "with CPU load" if result.loaded else "without load"
    title = f"Step {result.step_ms:g} ms for {result.seconds:g} s, {condition}: {result.ticks} ticks"
    table = TerminalTable(title=title)
    table.add_column("ms", no_wrap=True)
    for column in COLUMNS:
        table.add_column(column.replace("p999", "p99.9"), justify="right", no_wrap=True)
    rows = {
        "tick lateness": result.tick_lateness_ms,
        "bus, both directions": result.bus_ms,
        "Modbus round trip": result.modbus_ms,
        "loop latency": result.loop_ms,
    }
    for name, statistics in rows.items():
        table.add_row(name, *(f"{getattr(statistics, column):.3f}" for column in COLUMNS))
    console.print(table)
    steal = "not reported by this system" if result.stolen is None else f"{100 * result.stolen:.1f} %"
    console.print(f"missed steps: {result.missed_steps}; CPU steal: {steal}")
    if result.reasons:
        text = f"not suitable for a study at a step of {result.step_ms:g} ms: {'; '.join(result.reasons)}"
        if result.fit_from_ms > result.step_ms:
            text += f" (suitable from a step of {result.fit_from_ms} ms)"
        console.print(Text(text, style="yellow"))
    else:
        console.print(Text(f"suitable for a study at a step of {result.step_ms:g} ms", style="green"))
