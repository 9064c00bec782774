"""`hilrig sim`, `hilrig edge`, `hilrig recorder`: one service in this process, as `up` and compose start it."""

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import Config

if TYPE_CHECKING:
    from hilrig_runtime.process.service import Service

StopWithParent = Annotated[
    bool, typer.Option("--stop-with-parent", help="End when standard input ends: whoever started this is gone.")
]


Rigs = Annotated[
    str,
    typer.Option(
        metavar="RIG,RIG…",
        help="Those that this process serves; the others have one of their own. Without: all of the lab.",
        show_default=False,
    ),
]
Instance = Annotated[
    str, typer.Option(metavar="NAME", help="What this process is called, where there are several of its kind.")
]
LogFormat = Annotated[
    str, typer.Option("--log-format", metavar="text|json", help="Lines for people, or one JSON object a line.")
]


def sim(
    config: Config = None,
    rigs: Rigs = "",
    instance: Instance = "1",
    log_format: LogFormat = "text",
    stop_with_parent: StopWithParent = False,
) -> None:
    """Run the simulation: command in, plant stepped in real time, state out."""
    from hilrig_sim.service import run

    _run("sim", run, config, rigs, instance, log_format, stop_with_parent)


def edge(
    config: Config = None,
    rigs: Rigs = "",
    instance: Instance = "1",
    log_format: LogFormat = "text",
    stop_with_parent: StopWithParent = False,
) -> None:
    """Run the Modbus edge: one TCP port a rig, torques in, positions out."""
    from hilrig_modbus_edge.service import run

    _run("edge", run, config, rigs, instance, log_format, stop_with_parent)


def recorder(
    config: Config = None,
    rigs: Rigs = "",
    instance: Instance = "1",
    log_format: LogFormat = "text",
    stop_with_parent: StopWithParent = False,
) -> None:
    """Run the recorder: each session of each rig becomes an MCAP file."""
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
        raise InputError(f"--instance {instance!r}: expected letters, digits, - and _, beginning with no sign")
    lab = load_lab(config)
    names = [rig.strip() for rig in rigs.split(",")] if rigs else None
    for rig, times in Counter(names).items():
        if times > 1:
            raise InputError(f"--rigs {rigs}: {rig!r} stands there {times} times, expected once")
        lab.rig(rig)
    start_logging(name, instance, log_format)
    run_service(name, run, lab, instance=instance, rigs=names, stop_with_parent=stop_with_parent)
