"""`hilrig lease`: shows or releases the lease of a rig."""

import json
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AllRigs, AsJson, Config, check_rigs

if TYPE_CHECKING:
    from hilrig_schemas import LeaseStatus


def lease(
    rigs: Annotated[
        list[str] | None, typer.Argument(metavar="RIG...", help="Names of the rigs; default: all rigs of the lab.")
    ] = None,
    every: AllRigs = False,
    release: Annotated[bool, typer.Option("--release", help="Revoke the lease of the current lease holder.")] = False,
    config: Config = None,
    as_json: AsJson = False,
) -> None:
    """Show the lease holder of each rig, or revoke leases: the next other controller that writes acquires the rig.

    Exit code 1: with --release, a rig had no lease holder.
    """
    from hilrig_cli.client import query_edges
    from hilrig_runtime.config.lab import load_lab
    from hilrig_schemas import LeaseRequest, topics

    if release:
        check_rigs(rigs, every, "hilrig lease --release")
    statuses = query_edges(load_lab(config), topics.LEASE, rigs or [], LeaseRequest(release=release))
    if as_json:
        rows = [_row(status) for status in statuses]
        print(json.dumps(rows[0] if len(rigs or []) == 1 else rows))
    else:
        _print_table(statuses, release)
    if release and not all(status.released for status in statuses):
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
        "client_of": status.client_of,
        "controller_fault": status.controller_fault,
        "skipped_states": status.skipped_states,
    }


def _print_table(statuses: "list[LeaseStatus]", release: bool) -> None:
    from rich.table import Table

    from hilrig_cli.terminal import TerminalConsole

    table = Table()
    for column in ("rig", "lease holder", "last request", "session", "connections", "watchdog"):
        table.add_column(column, no_wrap=column == "rig", overflow="fold")
    for status in statuses:
        timeout = "off" if not status.watchdog_timeout_ns else f"{status.watchdog_timeout_ns / 1e6:g} ms"
        holder = f"client of {status.client_of}" if status.client_of else status.holder or "none"
        table.add_row(
            status.rig,
            f"{holder}: {status.controller_fault}" if status.controller_fault else holder,
            f"{status.silent_ns / 1e9:.1f} s ago" if status.holder else "",
            status.session,
            str(status.connections),
            "tripped" if status.watchdog_tripped else timeout,
        )
    console = TerminalConsole()
    console.print(table)
    if release:
        former = statuses[0].released
        text = f"lease of {former} revoked: the next other controller that writes acquires it"
        console.print(text if former else "the rig had no lease holder")
