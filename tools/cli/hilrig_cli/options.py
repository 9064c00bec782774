"""Options that several commands share, said the same way everywhere."""

from pathlib import Path
from typing import Annotated

import typer
from typer.core import TyperGroup

Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        metavar="LAB.TOML",
        help="The lab's file; without one there is one rig with the defaults.",
        show_default=False,
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, and nothing else.")]


def config_for_commands(context: typer.Context, config: Config = None) -> None:
    """The callback of a group of commands: `-c` may stand before the command too; what stands behind it is nearer."""
    if config is not None and isinstance(context.command, TyperGroup):
        context.default_map = {name: {"config": str(config)} for name in context.command.commands}
