"""`hilrig sim`, `hilrig edge`, `hilrig recorder`: one service in this process, as `up` and compose start it."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import Config

if TYPE_CHECKING:
    from hilrig_runtime.service import Service

StopWithParent = Annotated[
    bool, typer.Option("--stop-with-parent", help="End when standard input ends: whoever started this is gone.")
]


def sim(config: Config = None, stop_with_parent: StopWithParent = False) -> None:
    """Run the simulation: command in, plant stepped in real time, state out."""
    from hilrig_sim.loop import run

    _run("sim", run, config, stop_with_parent)


def edge(config: Config = None, stop_with_parent: StopWithParent = False) -> None:
    """Run the Modbus edge: one TCP port a rig, torques in, positions out."""
    from hilrig_modbus_edge.bridge import run

    _run("edge", run, config, stop_with_parent)


def recorder(config: Config = None, stop_with_parent: StopWithParent = False) -> None:
    """Run the recorder: each session of each rig becomes an MCAP file."""
    from hilrig_recorder.service import run

    _run("recorder", run, config, stop_with_parent)


def _run(name: str, run: "Callable[[Service], None]", config: Config, stop_with_parent: bool) -> None:
    from hilrig_runtime.config import load_lab
    from hilrig_runtime.lifecycle import run_service

    run_service(name, run, load_lab(config), stop_with_parent=stop_with_parent)
