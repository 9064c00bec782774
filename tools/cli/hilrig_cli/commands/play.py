"""`hilrig play`: publishes a recording on the bus with its original timing."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import Config

if TYPE_CHECKING:
    from hilrig_runtime.bus.api import Bus
    from hilrig_runtime.config.lab import LabConfig


def play(
    run: Annotated[Path, typer.Argument(metavar="RUN.MCAP", help="The recording.")],
    config: Config = None,
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="Speed factor.")] = 1.0,
    start: Annotated[float, typer.Option(min=0.0, help="Start position in the recording, s.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat until Ctrl-C.")] = False,
    rig: Annotated[str, typer.Option(help="Name of the rig to publish as; default: the recorded rig.")] = "",
) -> None:
    """Publish a recording on the bus with its original timing, for tools that subscribe to a running rig."""
    from hilrig_replay.export.player import Player, publish_recording, rig_config
    from hilrig_replay.io.isolation import isolated
    from hilrig_replay.io.paths import find_run
    from hilrig_replay.io.run import open_run
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.escaping import printable
    from hilrig_runtime.process.shutdown import stop_on_signals
    from hilrig_runtime.timing.clock import SYSTEM_CLOCK
    from hilrig_schemas.topics import CONFIG, RESERVED_RIG_NAMES, is_name

    lab = load_lab(config)
    with isolated(run):
        opened = open_run(find_run(run))
    name = rig or opened.rig
    if not is_name(name) or name in RESERVED_RIG_NAMES:
        raise InputError(f"--rig: expected letters, digits, - and _, and no reserved name, got {name!r}")
    player = Player(opened, speed=speed, start_s=start, loop=loop)
    stopping = stop_on_signals()
    with _bus(lab, name) as bus:
        bus.declare_queryable(CONFIG.key(lab.name, name), lambda _: rig_config(opened, name).SerializeToString())
        played = publish_recording(
            bus, lab.name, player, SYSTEM_CLOCK, stopping, rename=None if name == opened.rig else name
        )
    session = printable(opened.session)
    print(f"played {played} messages of {session} as {name} in lab {lab.name}", file=sys.stderr)


def _bus(lab: "LabConfig", rig: str) -> "Bus":
    """Join the bus with the identity (in a mesh also the port) of the simulation, which tools connect to."""
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.errors import OperationError
    from hilrig_schemas.topics import CONFIG

    if lab.bus.topology == "mesh":
        try:
            return ZenohBus(lab.bus, "sim")
        except OperationError as error:
            raise OperationError(
                f"a lab is already running on this host (bus.first_port {lab.bus.first_port}): stop it, or use a "
                "--config with another bus.first_port"
            ) from error
    with ZenohBus(lab.bus, "tool") as probe:
        if probe.query(CONFIG.key(lab.name, rig), timeout_s=0.5):
            raise OperationError(f"rig {rig!r} is running in lab {lab.name!r}: choose another name with --rig")
    # On a secured bus only the simulation's certificate may publish states.
    return ZenohBus(lab.bus, "sim")
