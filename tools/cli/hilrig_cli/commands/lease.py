"""`hilrig lease`: who holds a rig, and taking it back."""

import json
import time
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from hilrig_runtime.bus import Answer, Bus
    from hilrig_schemas import LeaseStatus

ANSWER_WITHIN_S = 3.0
"""How long an edge has to answer; a link to it may have to be made first."""


def lease(
    rig: Annotated[str, typer.Argument(help="The rig; without: all of the lab.")] = "",
    release: Annotated[bool, typer.Option("--release", help="Take the rig from the controller that holds it.")] = False,
    config: Config = None,
    as_json: AsJson = False,
) -> None:
    """Say which controller holds a rig, or take the rig from it: the next other one to write gets it.

    Exit code 1 with --release when nobody held it.
    """
    from hilrig_runtime.config import load_lab
    from hilrig_runtime.errors import InputError, OperationError
    from hilrig_runtime.zenoh_bus import ZenohBus
    from hilrig_schemas import LeaseRequest, LeaseStatus, topics

    lab = load_lab(config)
    if rig:
        lab.rig(rig)
    elif release:
        raise InputError("--release takes a rig: hilrig lease RIG --release")
    with ZenohBus(lab.bus, "lease") as bus:
        key = topics.LEASE.key(lab.name, rig or "*")
        answers = _ask(bus, key, LeaseRequest(release=release).SerializeToString())
    for answer in answers:
        if answer.error:
            raise OperationError(f"rig {rig!r}: the edge refused: {answer.error}")
    if not answers:
        raise OperationError(f"no edge answers for lab {lab.name!r}: is it running (hilrig up), with this lab.toml?")
    statuses = sorted((LeaseStatus.FromString(answer.payload) for answer in answers), key=lambda status: status.rig)
    if as_json:
        rows = [_row(status) for status in statuses]
        print(json.dumps(rows[0] if rig else rows))
    else:
        _print_table(statuses, release)
    if release and not statuses[0].released:
        raise typer.Exit(1)


def _ask(bus: "Bus", key: str, payload: bytes) -> "list[Answer]":
    deadline = time.monotonic() + ANSWER_WITHIN_S
    while True:
        answers = bus.ask(key, payload)
        if answers or time.monotonic() > deadline:
            return answers
        time.sleep(0.05)


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
