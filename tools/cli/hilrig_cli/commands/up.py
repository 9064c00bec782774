"""`hilrig up`: runs all services of a lab on this host."""

import logging
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.commands.services import LogFormat, StopWithParent
from hilrig_cli.options import Config, announcer


def up(
    file: Annotated[
        Path | None, typer.Argument(metavar="LAB.TOML", help="Configuration file of the lab, as with --config.")
    ] = None,
    config: Config = None,
    edges: Annotated[int, typer.Option(help="Number of Modbus edges among which the rigs are divided.")] = 1,
    recorders: Annotated[int, typer.Option(help="Number of recorders among which the rigs are divided.")] = 1,
    log_format: LogFormat = "text",
    controller: Annotated[
        str,
        typer.Option(
            metavar="HOST[:PORT]",
            help="Without a file: run one rig that is a client of this controller, a Modbus server.",
        ),
    ] = "",
    view: Annotated[bool, typer.Option("--view", help="Open the first rig in the rerun viewer.")] = False,
    stop_with_parent: StopWithParent = False,
) -> None:
    """Start simulation, Modbus edge and recorder on this host, print each rig's Modbus address, and run until Ctrl-C.

    A service that dies is restarted. Ctrl-C or SIGTERM stops all services in order: torques are zeroed and recordings
    are finished.
    """
    from hilrig_cli.local.local_lab import POLL_S, lab_file_of_controller, running_lab
    from hilrig_cli.local.supervisor import lab_processes, own_process_group
    from hilrig_runtime.addresses import format_address, reachable_hosts
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.process.logging_setup import start_logging
    from hilrig_runtime.process.shutdown import call_on_hangup, stop_on_signals
    from hilrig_sim.parameters import lab_parameters

    if file is not None and config is not None:
        raise InputError(f"two configuration files: {file} and --config {config}; expected one")
    config = file or config
    start_logging("up", "1", log_format)
    report: Callable[[str], None] = logging.getLogger(__name__).info
    say = announcer(log_format)
    written = ExitStack()
    if controller:
        config = written.enter_context(lab_file_of_controller(controller, config))
    lab = load_lab(config)
    lab_parameters(lab, str(config or "defaults"))
    stopping = stop_on_signals(stop_with_parent=stop_with_parent)

    processes = lab_processes([rig.name for rig in lab.rigs], edges=edges, recorders=recorders)
    with written, running_lab(lab, config, report, stopping, processes, ["--log-format", log_format]) as supervisor:
        if not stopping.is_set():
            for rig, kinds in zip(lab.rigs, lab.addresses().values(), strict=True):
                addresses = ", ".join(
                    f"{kind} at {' or '.join(format_address(one, port) for one in reachable_hosts(host))}"
                    for kind, (host, port) in kinds.items()
                )
                impairment = lab.impairment_of(rig).describe()
                suffix = "" if impairment == "none" else f", impairment: {impairment}"
                say(f"{rig.name}: {addresses}, step {lab.sim.step_ms:g} ms{suffix}")
                if rig.controller is not None:
                    say(f"{rig.name}: {rig.describe_controller()}")
            say(f"recordings: {(lab.recorder.folder / lab.name).resolve()}")
            say("running; press Ctrl-C to stop")
        call_on_hangup(supervisor.reload, stopping)
        viewer = None
        if view and not stopping.is_set():
            command = [sys.executable, "-m", "hilrig_cli", "live", lab.rigs[0].name]
            command += ["--config", str(config)] if config is not None else []
            viewer = subprocess.Popen(command, **own_process_group())
        while not stopping.wait(POLL_S):
            supervisor.poll()
        if viewer is not None:
            viewer.terminate()
    say("stopped")
