"""`hilrig top`: current status of the lab's services and rigs."""

import sys
import time
from collections.abc import Mapping, Sequence, Set
from typing import TYPE_CHECKING, Annotated, Final

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

    from hilrig_monitoring.lab_view import LabView
    from hilrig_schemas import Health

REFRESH_S: Final = 0.5
FILE_WIDTH: Final = 160
"""Maximum number of characters per line of output that is not for a terminal."""
SERVICE_COLUMNS: Final = {
    "service": 0,
    "host": 5,
    "rigs": 0,
    "cpu %": 0,
    "MiB": 4,
    "late ms": 2,
    "overruns": 1,
    "lost": 0,
    "queue": 6,
    "clock ms": 7,
}
RIG_COLUMNS: Final = {
    "rig": 0,
    "student": 2,
    "controller": 2,
    "loop p50": 1,
    "p99 ms": 0,
    "age p99": 1,
    "samples": 4,
    "refused": 3,
    "recorded": 3,
    "state": 0,
}
"""Columns and their ranks: a narrow terminal hides the columns of the highest rank first, and never those of 0."""
LEFT_ALIGNED_COLUMNS: Final = frozenset({"service", "host", "rig", "student", "controller", "recorded", "state"})
"""Columns with text."""


def top(
    config: Config = None,
    once: Annotated[bool, typer.Option("--once", help="Print the status once and exit.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show the status of a running lab: services with their alerts; rigs with lease holder, loop latency, recording.

    In a terminal the display is updated until Ctrl-C. If it does not fit, the rigs with the lowest loop latency and
    less important columns are hidden.
    """
    from rich.live import Live

    from hilrig_cli.json_output.lab import TopOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.terminal import TerminalConsole, has_fixed_width
    from hilrig_monitoring.lab_watch import LabWatch
    from hilrig_runtime.config.lab import load_lab

    lab = load_lab(config)
    console = TerminalConsole(width=None if has_fixed_width() else FILE_WIDTH)
    with LabWatch(lab) as watch:
        watch.wait()
        if as_json or once or not sys.stdout.isatty():
            with watch.lock:
                if as_json:
                    print_json(TopOutput.model_validate({"lab": lab.name} | watch.view.as_dict(time.monotonic())))
                else:
                    console.print(
                        render(watch.view, time.monotonic(), None, console.width if has_fixed_width() else None)
                    )
            return
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                with watch.lock:
                    display = render(watch.view, time.monotonic(), console.height, console.width)
                live.update(display, refresh=True)
                time.sleep(REFRESH_S)


def render(view: "LabView", now_s: float, height: int | None, width: int | None = None) -> "Group":
    """Render the tables of services and rigs, and the alerts.

    Args:
        view: the lab.
        now_s: current time of the view's clock, s.
        height: maximum number of lines, with the rigs of the highest latency first; None: all rigs, in their order.
        width: maximum number of characters per line; None: all columns.
    """
    from rich.console import Group
    from rich.text import Text

    services = [
        {
            "service": service.name,
            "host": health.host,
            "rigs": str(health.rigs),
            "cpu %": f"{100 * service.cpu_share:.0f}",
            "MiB": f"{health.resident_bytes / 2**20:.0f}",
            "late ms": f"{health.lateness_p99_ns / 1e6:.2f}",
            "overruns": str(health.overruns),
            "lost": str(health.lost_transport + health.lost_recorder),
            "queue": str(health.queue_depth),
            "clock ms": _clock_text(health),
        }
        for service in view.services()
        for health in (service.health,)
    ]
    silent = {service.name for service in view.services() if view.is_silent(service, now_s)}
    alerts = [Text(f"! {alert}", style="yellow") for alert in view.alerts(now_s)]
    rig_views = view.rigs(now_s)
    max_rigs = len(rig_views) if height is None else max(1, height - len(services) - len(alerts) - 9)
    if max_rigs < len(rig_views):
        rig_views.sort(key=lambda rig: -(rig.loop_ms(0.99) or 0.0))
        alerts.append(Text(f"… and {len(rig_views) - max_rigs} more rigs", style="dim"))
    rigs = [
        {
            "rig": rig.rig,
            "student": rig.student,
            "controller": rig.controller or "none",
            "loop p50": _or_dash(rig.loop_ms(0.5)),
            "p99 ms": _or_dash(rig.loop_ms(0.99)),
            "age p99": _or_dash(rig.age_ms(0.99)),
            "samples": str(len(rig.loops_us)),
            "refused": str(sum(rig.exceptions.values()) or ""),
            "recorded": "yes" if rig.recording else "",
            "state": rig.state,
        }
        for rig in rig_views[:max_rigs]
    ]
    empty = {name for name in ("student", "refused") if not any(rig[name] for rig in rigs)}
    rig_columns = {name: rank for name, rank in RIG_COLUMNS.items() if name not in empty}
    return Group(_table(services, SERVICE_COLUMNS, width, silent), _table(rigs, rig_columns, width), *alerts)


def _table(
    rows: Sequence[Mapping[str, str]], columns: Mapping[str, int], width: int | None, red: Set[str] = frozenset()
) -> "Table":
    """Build a table of the columns that fit `width`; columns of the highest rank are dropped first.

    Rows whose first cell is in `red` are highlighted.
    """
    from hilrig_cli.terminal import TerminalTable

    needed = {name: max([len(name), *(len(row[name]) for row in rows)]) + 2 for name in columns}
    shown = list(columns)
    while width is not None and sum(needed[name] for name in shown) > width - 2:
        dropped = max(shown, key=lambda name: columns[name])
        if not columns[dropped]:
            break
        shown.remove(dropped)
    table = TerminalTable()
    for name in shown:
        table.add_column(name, justify="left" if name in LEFT_ALIGNED_COLUMNS else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(row[name] for name in shown), style="red" if row[shown[0]] in red else None)
    return table


def _or_dash(value_ms: float | None) -> str:
    return "–" if value_ms is None else f"{value_ms:.1f}"


def _clock_text(health: "Health") -> str:
    """Return the clock offset with its uncertainty; an offset within it is not known to differ from zero."""
    if not health.clock_peer:
        return "–"
    return f"{health.clock_offset_ns / 1e6:+.1f}±{health.clock_uncertainty_ns / 1e6:.1f}"
