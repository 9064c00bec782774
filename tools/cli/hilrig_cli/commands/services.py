"""`hilrig sim`, `hilrig edge`, `hilrig recorder`: run one service in this process."""

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import Config

if TYPE_CHECKING:
    from hilrig_runtime.process.service import Service

StopWithParent = Annotated[
    bool, typer.Option("--stop-with-parent", help="Stop when standard input is closed, that is, the parent has ended.")
]

Rigs = Annotated[
    str,
    typer.Option(
        metavar="RIG,RIG…",
        help="Rigs that this process serves; default: all rigs of the lab.",
    ),
]
Instance = Annotated[
    str, typer.Option(metavar="NAME", help="Instance name; required if several services of this kind run.")
]
LogFormat = Annotated[
    str,
    typer.Option("--log-format", metavar="text|json", help="Log format: readable text, or one JSON object per line."),
]


def sim(
    config: Config = None,
    rigs: Rigs = "",
    instance: Instance = "1",
    log_format: LogFormat = "text",
    stop_with_parent: StopWithParent = False,
) -> None:
    """Run the simulation: steps the plant in real time, receives commands, publishes states."""
    from hilrig_sim.service import run

    _run("sim", run, config, rigs, instance, log_format, stop_with_parent)


def edge(
    config: Config = None,
    rigs: Rigs = "",
    instance: Instance = "1",
    log_format: LogFormat = "text",
    stop_with_parent: StopWithParent = False,
) -> None:
    """Run the Modbus edge: one Modbus TCP port per rig, torques in, positions out."""
    from hilrig_modbus_edge.service import run

    _run("edge", run, config, rigs, instance, log_format, stop_with_parent)


def recorder(
    config: Config = None,
    rigs: Rigs = "",
    instance: Instance = "1",
    log_format: LogFormat = "text",
    stop_with_parent: StopWithParent = False,
) -> None:
    """Run the recorder: writes each session of each rig to an MCAP file."""
    from hilrig_recorder.service import run

    _run("recorder", run, config, rigs, instance, log_format, stop_with_parent)


def _run(
    name: str,
    run: "Callable[[Service], None]",
    config: Config,
    rigs: str,
    instance: str,
    log_format: str,
    stop_with_parent: bool,
) -> None:
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.process.lifecycle import run_service
    from hilrig_runtime.process.logging_setup import start_logging
    from hilrig_schemas.topics import is_name

    if not is_name(instance):
        raise InputError(
            f"--instance: expected letters, digits, - and _, starting with a letter or digit, got {instance!r}"
        )
    lab = load_lab(config)
    names = [rig.strip() for rig in rigs.split(",")] if rigs else None
    for rig, count in Counter(names).items():
        if count > 1:
            raise InputError(f"--rigs: duplicate rig {rig!r}")
        lab.rig(rig)
    start_logging(name, instance, log_format)
    run_service(name, run, lab, instance=instance, rigs=names, stop_with_parent=stop_with_parent)
