"""`hilrig sim`, `hilrig edge`, `hilrig recorder`: run one service in this process."""

from collections import Counter
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import Config

if TYPE_CHECKING:
    from hilrig_runtime.config.lab import LabConfig

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


def _command(name: str, package: str, summary: str) -> Callable[..., None]:
    """Return the command that runs a service; all services have the same options."""

    def run(
        config: Config = None,
        rigs: Rigs = "",
        instance: Instance = "1",
        log_format: LogFormat = "text",
        stop_with_parent: StopWithParent = False,
    ) -> None:
        from hilrig_runtime.config.lab import load_lab
        from hilrig_runtime.errors import InputError
        from hilrig_runtime.process.lifecycle import run_service
        from hilrig_runtime.process.logging_setup import start_logging
        from hilrig_schemas.topics import is_name

        start_logging(name, instance, log_format)
        service = import_module(f"{package}.service")
        if not is_name(instance):
            raise InputError(
                f"--instance: expected letters, digits, - and _, starting with a letter or digit, got {instance!r}"
            )
        lab = load_lab(config)
        _validate(lab, config)
        names = [rig.strip() for rig in rigs.split(",")] if rigs else None
        for rig, count in Counter(names).items():
            if count > 1:
                raise InputError(f"--rigs: duplicate rig {rig!r}")
            lab.rig(rig)
        run_service(name, service.run, lab, instance=instance, rigs=names, stop_with_parent=stop_with_parent)

    run.__name__, run.__doc__ = name, summary
    return run


def _validate(lab: "LabConfig", config: Path | None) -> None:
    """Check what `hilrig check` checks, on hosts with the packages of the simulation."""
    try:
        from hilrig_sim.parameters import lab_parameters
    except ModuleNotFoundError:
        return
    lab_parameters(lab, str(config or "defaults"))


sim = _command(
    "sim", "hilrig_sim", "Run the simulation: steps the plant in real time, receives commands, publishes states."
)
edge = _command(
    "edge", "hilrig_modbus_edge", "Run the Modbus edge: one Modbus TCP port per rig, torques in, positions out."
)
recorder = _command("recorder", "hilrig_recorder", "Run the recorder: writes each session of each rig to an MCAP file.")
