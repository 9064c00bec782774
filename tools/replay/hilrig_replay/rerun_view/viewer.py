"""Runs the rerun viewer as a child process: loopback only, with a memory limit, without usage statistics."""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Final

import rerun_cli

from hilrig_replay.rerun_view.csp_proxy import LOOPBACK, serve_with_csp
from hilrig_runtime.errors import OperationError

MEMORY_LIMIT: Final = "1GB"
"""Memory limit of the viewer, above which it drops the oldest data."""
START_TIMEOUT_S: Final = 30.0
WINDOW_TIMEOUT_S: Final = 0.5
"""Time in which a viewer that can't open its window exits; it accepts connections before that."""
NO_DISPLAY: Final = "the rerun viewer could not open its window: it needs a display; without one use --save or --web"
_DISPLAY_VARIABLES: Final = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_POLL_S: Final = 0.05


def environment() -> dict[str, str]:
    """Environment variables of the viewer: `CI` disables usage statistics, and only errors are logged."""
    return {"RUST_LOG": "error", **os.environ, "CI": "true"}


def executable() -> Path:
    """Path of the viewer's executable; the Python wrapper of the same name would not forward signals.

    Raises:
        OperationError: it is not installed.
    """
    folder = Path(rerun_cli.__file__).parent
    names = {"win32": ["rerun.exe"], "darwin": ["Rerun.app/Contents/MacOS/Rerun", "rerun"]}.get(sys.platform, ["rerun"])
    for name in names:
        if (folder / name).exists():
            return folder / name
    raise OperationError(f"the rerun viewer is not installed in {folder}")


def open_viewer(grpc_port: int, web_port: int | None = None) -> "subprocess.Popen[bytes]":
    """Start the viewer: a window, or with `web_port` a server for a browser on this host.

    Args:
        grpc_port: port on which the viewer receives data.
        web_port: port of the web page.

    Raises:
        OperationError: it can't be started.
    """
    command = [str(executable()), "--bind", LOOPBACK, "--port", str(grpc_port)]
    if web_port is None:
        command += ["--memory-limit", MEMORY_LIMIT, "--hide-welcome-screen"]
    else:
        command += ["--serve-web", "--web-viewer-port", str(web_port), "--server-memory-limit", MEMORY_LIMIT]
    try:
        return subprocess.Popen(command, env=environment(), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    except OSError as error:
        raise OperationError(f"the rerun viewer can't be started: {error}") from error


def check_display() -> None:
    """Check that this host has a display on which the viewer can open its window.

    Raises:
        OperationError: it has none.
    """
    if sys.platform not in ("win32", "darwin") and not any(map(os.environ.get, _DISPLAY_VARIABLES)):
        raise OperationError(NO_DISPLAY)


@contextmanager
def running_viewer(grpc_port: int, web_port: int | None = None) -> Iterator["subprocess.Popen[bytes]"]:
    """Run the viewer, ready to receive data, and terminate it on exit; the web page is served through `csp_proxy`.

    Raises:
        OperationError: the viewer does not start; the display may be missing.
    """
    if web_port is None:
        check_display()
    page_port = None if web_port is None else free_port()
    process = open_viewer(grpc_port, page_port)
    try:
        wait_until_ready(process, [grpc_port, *([] if page_port is None else [page_port])])
        if web_port is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(WINDOW_TIMEOUT_S)
                raise OperationError(NO_DISPLAY)
        with ExitStack() as proxy:
            if page_port is not None and web_port is not None:
                proxy.enter_context(serve_with_csp(page_port, grpc_port, web_port))
            yield process
    finally:
        if process.poll() is None:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=3.0)
        if process.poll() is None:
            process.kill()
            process.wait()


def wait_until_ready(process: "subprocess.Popen[bytes]", ports: Sequence[int]) -> None:
    """Wait until the viewer accepts connections on all ports.

    Raises:
        OperationError: the viewer exited, or the timeout expired.
    """
    deadline_s = time.monotonic() + START_TIMEOUT_S
    for port in ports:
        while True:
            if process.poll() is not None:
                raise OperationError(NO_DISPLAY)
            with closing(socket.socket()) as probe:
                probe.settimeout(1.0)
                if probe.connect_ex((LOOPBACK, port)) == 0:
                    break
            if time.monotonic() > deadline_s:
                raise OperationError(
                    f"the rerun viewer does not accept connections at {LOOPBACK}:{port} within {START_TIMEOUT_S:.0f} s"
                )
            time.sleep(_POLL_S)


def wait_for_end(process: "subprocess.Popen[bytes]", stopping: threading.Event) -> None:
    """Wait until the viewer exits or `stopping` is set."""
    while process.poll() is None and not stopping.wait(_POLL_S):
        pass


def free_port() -> int:
    """Find a free TCP port on the loopback interface."""
    with closing(socket.socket()) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def browser_address(grpc_port: int, web_port: int) -> str:
    """URL of the web viewer, with the data source as a parameter."""
    return f"http://{LOOPBACK}:{web_port}?url=rerun%2Bhttp://{LOOPBACK}:{grpc_port}/proxy"
