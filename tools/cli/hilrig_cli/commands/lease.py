"""`hilrig lease`: who holds a rig, and taking it back."""

import json
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from hilrig_schemas import LeaseStatus


def lease(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="The rig; without: all of the lab.")] = "",
    release: Annotated[bool, typer.Option("--release", help="Take the rig from the controller that holds it.")] = False,
    config: Config = None,
    as_json: AsJson = False,
) -> None:
    """Say which controller holds a rig, or take the rig from it: the next other one to write gets it.

    Exit code 1 with --release when nobody held it.
    """
    from hilrig_cli.client import ask_edges
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError
    from hilrig_schemas import LeaseRequest, topics

    if release and not rig:
        raise InputError("--release takes a rig: hilrig lease RIG --release")
    statuses = ask_edges(load_lab(config), topics.LEASE, rig, LeaseRequest(release=release))
    if as_json:
        rows = [_row(status) for status in statuses]
        print(json.dumps(rows[0] if rig else rows))
    else:
        _print_table(statuses, release)
    if release and not statuses[0].released:
        raise typer.Exit(1)


def _row(status: "LeaseStatus") -> dict[str, object]:
    return {
        "rig": status.rig,
        "holder": status.holder,
        "released": status.released,
        "silent_s": status.silent_ns / 1e9,
        "session": status.session,
        "connections": status.connections,
        "watchdog_tripped": status.watchdog_tripped,
        "watchdog_timeout_ms": status.watchdog_timeout_ns / 1e6,
    }


def _print_table(statuses: "list[LeaseStatus]", release: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for column in ("rig", "held by", "last request", "session", "connections", "watchdog"):
        table.add_column(column, no_wrap=column in ("rig", "held by"), overflow="fold")
    for status in statuses:
        off = "off" if not status.watchdog_timeout_ns else f"{status.watchdog_timeout_ns / 1e6:g} ms"
        table.add_row(
            status.rig,
            status.holder or "nobody",
            f"{status.silent_ns / 1e9:.1f} s ago" if status.holder else "",
            status.session,
            str(status.connections),
            "tripped" if status.watchdog_tripped else off,
        )
    console = Console()
    console.print(table)
    if release:
        taken = statuses[0].released
        console.print(f"taken from {taken}: the next other controller to write gets it" if taken else "nobody held it")
