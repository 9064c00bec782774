"""`hilrig top`: how the lab is, now."""

import json
import sys
import time
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from rich.console import Group

    from hilrig_console.lab_view import LabView

REFRESH_S = 0.5


def top(
    config: Config = None,
    once: Annotated[bool, typer.Option("--once", help="Print it once and end.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show a running lab: who holds each rig, its loop, what is recorded, and how the services are.

    In a terminal it is kept up to date until Ctrl-C; the slowest loops come first, and what does not fit is left out.
    """
    from rich.console import Console
    from rich.live import Live

    from hilrig_console.lab_watch import LabWatch
    from hilrig_runtime.config import load_lab

    lab = load_lab(config)
    console = Console()
    with LabWatch(lab) as watch:
        watch.wait()
        if as_json or once or not sys.stdout.isatty():
            with watch.lock:
                if as_json:
                    print(json.dumps({"lab": lab.name} | watch.view.as_dict(time.monotonic())))
                else:
                    console.print(picture(watch.view, time.monotonic(), None))
            return
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                with watch.lock:
                    shown = picture(watch.view, time.monotonic(), console.height)
                live.update(shown, refresh=True)
                time.sleep(REFRESH_S)


def picture(view: "LabView", now_s: float, height: int | None) -> "Group":
    """The two tables and what is wrong; at most `height` lines, None: all rigs, in their order."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    services = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("service", "host", "rigs", "cpu %", "MiB", "late ms", "overruns", "lost", "queue", "clock ms"):
        services.add_column(column, justify="left" if column in ("service", "host") else "right", no_wrap=True)
    for service in view.services():
        health = service.health
        services.add_row(
            service.name,
            health.host,
            str(health.rigs),
            f"{100 * service.cpu_share:.0f}",
            f"{health.resident_bytes / 2**20:.0f}",
            f"{health.lateness_p99_ns / 1e6:.2f}",
            str(health.overruns),
            str(health.lost_transport + health.lost_recorder),
            str(health.queue_depth),
            f"{health.clock_offset_ns / 1e6:+.1f}" if health.clock_peer else "–",
            style="red" if view.is_silent(service, now_s) else None,
        )
    troubles = [Text(f"! {trouble}", style="yellow") for trouble in view.troubles(now_s)]
    rigs = view.rigs(now_s)
    room = len(rigs) if height is None else max(1, height - len(view.services()) - len(troubles) - 9)
    if room < len(rigs):
        rigs.sort(key=lambda rig: -(rig.loop_ms(0.99) or 0.0))
        troubles.append(Text(f"… and {len(rigs) - room} rigs more", style="dim"))
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("rig", "controller", "loop p50", "p99 ms", "samples", "recorded", "state"):
        table.add_column(
            column, justify="right" if column in ("loop p50", "p99 ms", "samples") else "left", no_wrap=True
        )
    for rig in rigs[:room]:
        figures = [f"{value:.1f}" if (value := rig.loop_ms(share)) is not None else "–" for share in (0.5, 0.99)]
        recorded = "yes" if rig.recording else ""
        table.add_row(rig.rig, rig.controller or "nobody", *figures, str(len(rig.loops_us)), recorded, rig.state)
    return Group(services, table, *troubles)
