"""`hilrig replay`: recordings in the rerun viewer."""

import sys
import threading
from pathlib import Path
from typing import Annotated

import typer


def replay(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.MCAP…", help="Recordings; several are shown together.", show_default=False),
    ],
    save: Annotated[
        Path | None, typer.Option(metavar="RUN.RRD", help="Write a rerun file and open nothing.", show_default=False)
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve the viewer to a browser on this machine.")] = False,
) -> None:
    """Show what happened: the arm in 3D, its curves, the loop latency and its stages, events; until it is closed."""
    import tempfile

    from hilrig_replay.rerun_view import save_rrd
    from hilrig_replay.run import open_run
    from hilrig_replay.viewer import browser_address, free_port, running_viewer, wait_for_end
    from hilrig_runtime.ending import stop_on_signals
    from hilrig_runtime.errors import InputError

    if save is not None and web:
        raise InputError("--save writes a file and --web serves a browser: choose one")
    opened = [open_run(path) for path in runs]
    if save is not None:
        save_rrd(opened, save)
        return
    stopping = threading.Event()
    stop_on_signals(stopping)
    with tempfile.TemporaryDirectory(prefix="hilrig-") as folder:
        file = Path(folder) / "run.rrd"
        save_rrd(opened, file)
        grpc_port, web_port = free_port(), free_port() if web else None
        with running_viewer(str(file), grpc_port=grpc_port, web_port=web_port) as viewer:
            if web_port is not None:
                print(f"open {browser_address(grpc_port, web_port)} ; Ctrl-C ends it", file=sys.stderr, flush=True)
            wait_for_end(viewer, stopping)
