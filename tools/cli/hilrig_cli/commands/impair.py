"""`hilrig impair`: delay and loss added to a rig's loop on purpose, while it runs."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from hilrig_runtime.config.impairment import ImpairmentConfig
    from hilrig_schemas import ImpairmentStatus

DELAYS = (
    "constant:MS, uniform:LOW,HIGH, normal:MEAN,STD, gamma:MEAN,STD[,OFFSET], exponential:MEAN[,OFFSET], trace:FILE"
)
LOSSES = "none, bernoulli:RATE or gilbert:TO_BAD,TO_GOOD[,RATE_BAD[,RATE_GOOD]]"


def impair(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="The rig; without: all of the lab are shown.")] = "",
    preset: Annotated[
        str,
        typer.Option(metavar="NAME", help="none, wired, busy-wifi, vpn, mobile or paper-25-100ms.", show_default=False),
    ] = "",
    state: Annotated[
        str, typer.Option(metavar="KIND:ARGS", help=f"Delay of the state's way, ms: {DELAYS}.", show_default=False)
    ] = "",
    command: Annotated[
        str, typer.Option(metavar="KIND:ARGS", help="Delay of the command's way, as --state.", show_default=False)
    ] = "",
    loss: Annotated[
        str, typer.Option(metavar="KIND:ARGS", help=f"Loss on both ways: {LOSSES}.", show_default=False)
    ] = "",
    trace: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN.MCAP", help="Delay commands as that recording's loop was delayed.", show_default=False
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same delays and losses.")] = 1,
    off: Annotated[bool, typer.Option("--off", help="No impairment, until something else is set.")] = False,
    lab: Annotated[bool, typer.Option("--lab", help="As lab.toml says it.")] = False,
    config: Config = None,
    as_json: AsJson = False,
) -> None:
    """Add delay and loss to a rig's loop while it runs, or show what is in force.

    What is set holds until it is set otherwise or the edge is started anew. The watchdog's zero torque is never delayed
    or lost. Every change is an event of the recording, and every delay stands with its command.
    """
    from hilrig_cli.client import ask_edges
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError
    from hilrig_schemas import ImpairmentRequest, topics

    setting = any((preset, state, command, loss, trace))
    if setting + off + lab > 1:
        raise InputError("--off and --lab stand alone: leave out either them or what is to be set")
    if (setting or off or lab) and not rig:
        raise InputError("setting an impairment takes a rig: hilrig impair RIG …")
    if trace is not None and command:
        raise InputError("--trace is a delay of the command's way: leave out --command")
    request = ImpairmentRequest(restore_lab=lab)
    if setting or off:
        request.set_json = _impairment(preset, state, command, loss, trace, seed).model_dump_json()
    statuses = ask_edges(load_lab(config), topics.IMPAIRMENT, rig, request)
    if as_json:
        rows = [_row(status) for status in statuses]
        print(json.dumps(rows[0] if rig else rows))
    else:
        _print_table(statuses)


def _impairment(preset: str, state: str, command: str, loss: str, trace: Path | None, seed: int) -> "ImpairmentConfig":
    """What was asked for on the command line.

    Raises:
        InputError: there is no such thing; what would be right is said.
    """
    from pydantic import ValidationError

    from hilrig_runtime.config.impairment import ImpairmentConfig
    from hilrig_runtime.config.validation import format_validation_error
    from hilrig_runtime.errors import InputError

    try:
        links = ImpairmentConfig(preset=preset or "none").links
        delays = {
            "state": state or links.state.delay,
            "command": command or links.command.delay,
        }
        if trace is not None:
            from hilrig_replay.export.delay_trace import delay_trace
            from hilrig_replay.io.run import open_run

            delays["command"] = delay_trace(open_run(trace))
        losses = {"state": loss or links.state.loss, "command": loss or links.command.loss}
        told = {way: {"delay": delays[way], "loss": losses[way]} for way in delays}
        return ImpairmentConfig.model_validate({"preset": preset or "none", "seed": seed, **told})
    except ValidationError as error:
        raise InputError("\n".join(format_validation_error(error))) from error


def _row(status: "ImpairmentStatus") -> dict[str, object]:
    return {
        "rig": status.rig,
        "impairment": status.text,
        "ways": json.loads(status.links_json),
        "seed": status.seed,
        "set_by": status.source,
        "states": {"count": status.states, "lost": status.states_lost, "overtaken": status.states_superseded},
        "commands": {"count": status.commands, "lost": status.commands_lost, "overtaken": status.commands_superseded},
    }


def _print_table(statuses: "list[ImpairmentStatus]") -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from hilrig_runtime.config.impairment import LinkImpairments

    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("rig", "way", "impairment", "messages", "lost", "overtaken"):
        numeric = column in ("messages", "lost", "overtaken")
        table.add_column(column, justify="right" if numeric else "left", no_wrap=numeric, overflow="fold")
    for status in statuses:
        links = LinkImpairments.model_validate_json(status.links_json)
        states = (status.states, status.states_lost, status.states_superseded)
        commands = (status.commands, status.commands_lost, status.commands_superseded)
        table.add_row(status.rig, "state", links.state.describe(), *map(str, states))
        whose = f"({status.source}, seed {status.seed})"
        table.add_row(whose, "command", links.command.describe(), *map(str, commands), end_section=True)
    Console().print(table)
