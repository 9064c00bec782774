"""`hilrig live`: shows a running rig in the rerun viewer."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import Config, log


def live(
    rig: Annotated[
        str | None,
        typer.Argument(metavar="RIG", help="Name of the rig; default: the lab's first rig."),
    ] = None,
    config: Config = None,
    save: Annotated[
        Path | None,
        typer.Option(metavar="LIVE.RRD", help="Write a rerun file instead of opening a viewer."),
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve the viewer to a browser on this host.")] = False,
) -> None:
    """Show a running rig in the rerun viewer, like `replay`, until the viewer is closed or Ctrl-C."""
    from hilrig_cli.client import check_rig
    from hilrig_replay.io.output_file import check_output
    from hilrig_replay.rerun_view.layout import layout
    from hilrig_replay.rerun_view.live import FILE_PERIOD_S, VIEWER_PERIOD_S, Follower, follow
    from hilrig_replay.rerun_view.sinks import to_file, to_viewer
    from hilrig_replay.rerun_view.viewer import browser_address, free_port, running_viewer
    from hilrig_runtime.bus.zenoh_bus import ZenohBus
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.process.shutdown import stop_on_signals
    from hilrig_runtime.timing.clock import SYSTEM_CLOCK

    if save is not None and web:
        raise InputError("--save and --web can't be combined: use one of them")
    lab = load_lab(config)
    name = rig or lab.rigs[0].name
    stopping = stop_on_signals()

    client_role = any(each.name == name and each.controller is not None for each in lab.rigs)
    blueprint = layout(live=True, client_role=client_role)
    with ExitStack() as closing:
        bus = closing.enter_context(ZenohBus(lab.bus, "tool"))
        check_rig(bus, lab, name)
        viewer = None
        if save is not None:
            # Not an `output_file`, because the file can be read while it grows.
            check_output(save)
            stream = to_file(save, f"live-{name}", blueprint)
        else:
            grpc_port, web_port = free_port(), free_port() if web else None
            viewer = closing.enter_context(running_viewer(grpc_port, web_port))
            if web_port is not None:
                log(f"open {browser_address(grpc_port, web_port)} ; press Ctrl-C to stop")
            stream = to_viewer(grpc_port, f"live-{name}", blueprint)

        def is_closed() -> bool:
            return viewer is not None and viewer.poll() is not None

        closing.callback(stream.disconnect)
        period_s = VIEWER_PERIOD_S if save is None else FILE_PERIOD_S
        follow(Follower(bus, lab.name, name, stream, SYSTEM_CLOCK, log, lab.task), is_closed, stopping, period_s)
