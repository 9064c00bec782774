"""`hilrig impair`: network impairment emulation (delay, loss) in the loop of a running rig."""

import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from hilrig_cli.options import AllRigs, AsJson, Config, check_rigs

if TYPE_CHECKING:
    from hilrig_runtime.config.impairment import ImpairmentConfig
    from hilrig_runtime.errors import InputError
    from hilrig_schemas import ImpairmentStatus

DELAY_SYNTAX = (
    "constant:MS, uniform:LOW,HIGH, normal:MEAN,STD, gamma:MEAN,STD[,OFFSET], exponential:MEAN[,OFFSET], trace:FILE"
)
_OPTIONS: Final = {
    "preset": "--preset",
    "seed": "--seed",
    "state.delay": "--state",
    "command.delay": "--command",
    "state.loss": "--loss",
    "command.loss": "--loss",
}
"""Options by the keys that they set."""
LOSS_SYNTAX = "RATE (as bernoulli:RATE), none, bernoulli:RATE or gilbert:TO_BAD,TO_GOOD[,RATE_BAD[,RATE_GOOD]]"


def impair(
    rigs: Annotated[
        list[str] | None, typer.Argument(metavar="RIG", help="Names of the rigs; default: show all rigs of the lab.")
    ] = None,
    every: AllRigs = False,
    preset: Annotated[
        str,
        typer.Option(metavar="NAME", help="Preset: none, wired, busy-wifi, vpn, mobile or paper-25-100ms."),
    ] = "",
    state: Annotated[str, typer.Option(metavar="KIND:ARGS", help=f"Delay of the state link, ms: {DELAY_SYNTAX}.")] = "",
    command: Annotated[
        str,
        typer.Option(metavar="KIND:ARGS", help="Delay of the command link; kinds as for --state."),
    ] = "",
    loss: Annotated[str, typer.Option(metavar="KIND:ARGS", help=f"Loss on both links: {LOSS_SYNTAX}.")] = "",
    trace: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN.MCAP", help="Delay the command link by the delays outside the rig that this recording shows."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the delays and losses.")] = 1,
    off: Annotated[bool, typer.Option("--off", help="Remove the impairment.")] = False,
    lab: Annotated[bool, typer.Option("--lab", help="Restore the impairment of lab.toml.")] = False,
    config: Config = None,
    as_json: AsJson = False,
) -> None:
    """Add delay and loss to the loop of running rigs, or show the active impairment.

    The setting stays active until changed or until the edge restarts. The watchdog's zero torque is never delayed or
    lost. Each change is recorded as an event, and each delay with its command.
    """
    from hilrig_cli.client import query_edges
    from hilrig_cli.json_output.lab import ImpairOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError
    from hilrig_schemas import ImpairmentRequest, topics

    setting = any((preset, state, command, loss, trace))
    if setting + off + lab > 1:
        raise InputError("--off and --lab can't be combined with each other or with an impairment: use one of them")
    if setting or off or lab:
        check_rigs(rigs, every, "hilrig impair")
    if trace is not None and command:
        raise InputError("--trace and --command both set the delay of the command link: use one of them")
    request = ImpairmentRequest(restore_lab=lab)
    if setting or off:
        request.set_json = _impairment(preset, state, command, loss, trace, seed).model_dump_json()
    statuses = query_edges(load_lab(config), topics.IMPAIRMENT, rigs or [], request)
    if as_json:
        rows = [ImpairOutput.model_validate(_row(status)) for status in statuses]
        print_json(rows[0] if len(rigs or []) == 1 else rows)
    else:
        _print_table(statuses)


def _impairment(preset: str, state: str, command: str, loss: str, trace: Path | None, seed: int) -> "ImpairmentConfig":
    """Impairment from the command line options.

    Raises:
        InputError: the requested impairment is invalid.
    """
    from hilrig_runtime.config.impairment import ImpairmentConfig
    from hilrig_runtime.config.validation import validate
    from hilrig_runtime.errors import InputError

    try:
        base = validate(ImpairmentConfig, {"preset": preset or "none"}).links
    except InputError as error:
        raise _with_options(error) from error
    delays = {"state": state or base.state.delay, "command": command or base.command.delay}
    if trace is not None:
        from hilrig_replay.export.delay_trace import delay_trace
        from hilrig_replay.io.isolation import isolated
        from hilrig_replay.io.paths import find_run
        from hilrig_replay.io.run import open_run

        with isolated(trace):
            delays["command"] = delay_trace(open_run(find_run(trace)))
    if loss:
        with suppress(ValueError):
            float(loss)
            loss = f"bernoulli:{loss}"
    losses = {"state": loss or base.state.loss, "command": loss or base.command.loss}
    links = {link: {"delay": delays[link], "loss": losses[link]} for link in delays}
    try:
        return validate(ImpairmentConfig, {"preset": preset or "none", "seed": seed, **links})
    except InputError as error:
        raise _with_options(error) from error


def _with_options(error: "InputError") -> "InputError":
    """Return an error of an impairment with the names of options instead of those of keys, each sentence once."""
    from hilrig_runtime.errors import InputError

    lines = []
    for line in str(error).splitlines():
        place, _, text = line.partition(": ")
        key = next((key for key in _OPTIONS if place.startswith(key)), "")
        # The name of a parameter of the delay or loss, such as rate.
        parameter = place.removeprefix(key).rpartition(".")[2]
        lines.append(": ".join(filter(None, (_OPTIONS.get(key, ""), parameter, text))))
    return InputError("\n".join(dict.fromkeys(lines)))


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

    from hilrig_cli.terminal import TerminalConsole, TerminalTable
    from hilrig_runtime.config.impairment import LinkImpairments

    table = TerminalTable()
    for column in ("rig", "link", "impairment", "messages", "lost", "superseded"):
        numeric = column in ("messages", "lost", "superseded")
        table.add_column(column, justify="right" if numeric else "left", no_wrap=numeric, overflow="fold")
    for status in statuses:
        links = LinkImpairments.model_validate_json(status.links_json)
        states = (status.states, status.states_lost, status.states_superseded)
        commands = (status.commands, status.commands_lost, status.commands_superseded)
        table.add_row(status.rig, "state", links.state.describe(), *map(str, states))
        origin = f"({status.source}, seed {status.seed})"
        table.add_row(origin, "command", links.command.describe(), *map(str, commands), end_section=True)
    TerminalConsole().print(table)
