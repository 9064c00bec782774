"""Options and texts that several commands share."""

import logging
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        metavar="LAB.TOML",
        help="Configuration file of the lab; default: one rig with default settings.",
    ),
]
Rigs = Annotated[list[str] | None, typer.Argument(metavar="RIG", help="Names of the rigs.")]
AllRigs = Annotated[bool, typer.Option("--all", help="All rigs of the running lab.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, and nothing else.")]


class Command(TyperCommand):
    """A command whose help shows no type for a flag, which takes no value."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Parameters of the command, with those of its help."""
        return _without_flag_types(super().get_params(ctx))


class Group(TyperGroup):
    """The same for a group of commands."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Parameters of the group, with those of its help."""
        return _without_flag_types(super().get_params(ctx))


def _without_flag_types(params: list[Any]) -> list[Any]:
    for param in params:
        if getattr(param, "is_flag", False):
            param.metavar = ""
    return params


def config_for_commands(context: typer.Context, config: Config = None) -> None:
    """Callback of a command group: accepts `-c` before the command too; `-c` after the command takes precedence."""
    if config is not None and isinstance(context.command, TyperGroup):
        context.default_map = {name: {"config": str(config)} for name in context.command.commands}


def check_rigs(rigs: list[str] | None, every: bool, command: str) -> None:
    """Check that a command that changes rigs names them.

    Raises:
        InputError: neither rigs nor `--all`, or both.
    """
    from hilrig_runtime.errors import InputError

    if bool(rigs) == every:
        found = "both rigs and --all" if rigs else "no rig"
        raise InputError(f"{command}: {found} given; expected names of rigs, or --all")


def log(line: str) -> None:
    """Print a message of a running command on standard error."""
    print(f"hilrig: {line}", file=sys.stderr, flush=True)


def announcer(log_format: str) -> Callable[[str], None]:
    """Return the function with which a command announces its address: it prints text, or logs one JSON object."""
    return partial(print, flush=True) if log_format == "text" else logging.getLogger(__name__).info


def format_size(size: float) -> str:
    """Return a size in bytes as a readable text."""
    for unit in ("B", "KiB", "MiB"):
        if size < 1024:
            return f"{size:.0f} {unit}"
        size /= 1024
    return f"{size:.1f} GiB"
