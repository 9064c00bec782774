"""`hilrig replay`: shows recordings in the rerun viewer."""

import sys
from pathlib import Path
from typing import Annotated

import typer


def replay(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.MCAP", help="Recordings; several are shown in one view."),
    ],
    save: Annotated[
        Path | None,
        typer.Option(metavar="RUN.RRD", help="Write a rerun file instead of opening a viewer."),
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve the viewer to a browser on this host.")] = False,
) -> None:
    """Show recordings in the rerun viewer: the arm in 3D, its curves, the loop latency and its stages, events."""
    from hilrig_replay.io.isolation import isolated
    from hilrig_replay.io.paths import find_each_run
    from hilrig_replay.io.run import open_run
    from hilrig_replay.rerun_view.view import save_rrd, send_runs
    from hilrig_replay.rerun_view.viewer import browser_address, free_port, running_viewer, wait_for_end
    from hilrig_runtime.errors import InputError
    from hilrig_runtime.process.shutdown import stop_on_signals

    if save is not None and web:
        raise InputError("--save and --web can't be combined: use one of them")
    opened = []
    for files in find_each_run(runs):
        with isolated(files[0]):
            opened.append(open_run(files))
    if save is not None:
        with isolated(save if len(runs) > 1 else runs[0]):
            save_rrd(opened, save)
        return
    stopping = stop_on_signals()
    grpc_port, web_port = free_port(), free_port() if web else None
    with running_viewer(grpc_port, web_port) as viewer:
        if web_port is not None:
            print(f"open {browser_address(grpc_port, web_port)} ; press Ctrl-C to stop", file=sys.stderr, flush=True)

        def is_closed() -> bool:
            return stopping.is_set() or viewer.poll() is not None

        send_runs(opened, grpc_port, is_closed)
        wait_for_end(viewer, stopping)
