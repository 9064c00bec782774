"""`hilrig top`: how the lab is, now."""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

    from hilrig_monitoring.lab_view import LabView

REFRESH_S: Final = 0.5
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
    "controller": 2,
    "loop p50": 1,
    "p99 ms": 0,
    "samples": 4,
    "recorded": 3,
    "state": 0,
}
"""Columns and their ranks: where a terminal is narrow the highest go first, and those of 0 stay."""
TEXTS: Final = frozenset({"service", "host", "rig", "controller", "recorded", "state"})
"""Columns that begin at the left."""


def top(
    config: Config = None,
    once: Annotated[bool, typer.Option("--once", help="Print it once and end.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show a running lab: who holds each rig, its loop, what is recorded, and how the services are.

    In a terminal it is kept up to date until Ctrl-C; the slowest loops come first, and what does not fit
    is left out: rigs behind, columns that matter less.
    """
    from rich.console import Console
    from rich.live import Live

    from hilrig_monitoring.lab_watch import LabWatch
    from hilrig_runtime.config.lab import load_lab

    lab = load_lab(config)
    console = Console()
    with LabWatch(lab) as watch:
        watch.wait()
        if as_json or once or not sys.stdout.isatty():
            with watch.lock:
                if as_json:
                    print(json.dumps({"lab": lab.name} | watch.view.as_dict(time.monotonic())))
                else:
                    console.print(
                        picture(watch.view, time.monotonic(), None, console.width if sys.stdout.isatty() else None)
                    )
            return
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                with watch.lock:
                    shown = picture(watch.view, time.monotonic(), console.height, console.width)
                live.update(shown, refresh=True)
                time.sleep(REFRESH_S)


def picture(view: "LabView", now_s: float, height: int | None, width: int | None = None) -> "Group":
    """The two tables and what is wrong.

    Args:
        height: lines at most, the slowest rigs first; None: all rigs, in their order.
        width: characters at most, for which columns are left out; None: all columns.
    """
    from rich.console import Group
    from rich.text import Text

    services = [
        Row(
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
                "clock ms": f"{health.clock_offset_ns / 1e6:+.1f}" if health.clock_peer else "–",
            },
            is_bad=view.is_silent(service, now_s),
        )
        for service in view.services()
        for health in (service.health,)
    ]
    troubles = [Text(f"! {trouble}", style="yellow") for trouble in view.troubles(now_s)]
    shown = view.rigs(now_s)
    room = len(shown) if height is None else max(1, height - len(services) - len(troubles) - 9)
    if room < len(shown):
        shown.sort(key=lambda rig: -(rig.loop_ms(0.99) or 0.0))
        troubles.append(Text(f"… and {len(shown) - room} rigs more", style="dim"))
    rigs = [
        Row(
            {
                "rig": rig.rig,
                "controller": rig.controller or "nobody",
                "loop p50": _or_dash(rig.loop_ms(0.5)),
                "p99 ms": _or_dash(rig.loop_ms(0.99)),
                "samples": str(len(rig.loops_us)),
                "recorded": "yes" if rig.recording else "",
                "state": rig.state,
            }
        )
        for rig in shown[:room]
    ]
    return Group(_table(services, SERVICE_COLUMNS, width), _table(rigs, RIG_COLUMNS, width), *troubles)


@dataclass(frozen=True, slots=True)
class Row:
    """What a line of a table says, by column."""

    cells: dict[str, str]
    is_bad: bool = False


def _table(rows: Sequence[Row], columns: Mapping[str, int], width: int | None) -> "Table":
    """A table of those columns for which there is room; the ones of the highest rank go first."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    needed = {name: max([len(name), *(len(row.cells[name]) for row in rows)]) + 2 for name in columns}
    kept = list(columns)
    while width is not None and sum(needed[name] for name in kept) > width - 2:
        last = max(kept, key=lambda name: columns[name])
        if not columns[last]:
            break
        kept.remove(last)
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in kept:
        table.add_column(name, justify="left" if name in TEXTS else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(row.cells[name] for name in kept), style="red" if row.is_bad else None)
    return table


def _or_dash(value_ms: float | None) -> str:
    return "–" if value_ms is None else f"{value_ms:.1f}"
