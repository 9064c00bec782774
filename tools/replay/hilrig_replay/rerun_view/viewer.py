"""The rerun viewer as a process of its own: on this machine only, with a limit on its memory, and telling nobody."""

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

from hilrig_replay.rerun_view.csp_proxy import LOOPBACK, fenced
from hilrig_runtime.errors import OperationError

MEMORY_LIMIT: Final = "1GB"
"""When the viewer holds more than this it drops what is oldest."""
START_TIMEOUT_S: Final = 30.0
_POLL_S: Final = 0.05


def environment() -> dict[str, str]:
    """The environment of a viewer: its usage statistics stay off, as they are on build machines, and its log quiet."""
    return {"RUST_LOG": "error", **os.environ, "CI": "true"}


def executable() -> Path:
    """The viewer's own program: the Python module of that name would stand between us and it, and not pass signals on.

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
    """Start the viewer, which waits for data: a window, or with `web_port` a server for a browser on this machine.

    Args:
        grpc_port: where it listens for data.
        web_port: where it serves the browser.

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


@contextmanager
def running_viewer(grpc_port: int, web_port: int | None = None) -> Iterator["subprocess.Popen[bytes]"]:
    """`open_viewer`, ready to take data, and ended on leaving; a browser gets its page from behind a fence.

    Raises:
        OperationError: it does not start; the display may be missing.
    """
    page_port = None if web_port is None else free_port()
    process = open_viewer(grpc_port, page_port)
    try:
        wait_until_served(process, [grpc_port, *([] if page_port is None else [page_port])])
        with ExitStack() as fence:
            if page_port is not None and web_port is not None:
                fence.enter_context(fenced(page_port, grpc_port, web_port))
            yield process
    finally:
        if process.poll() is None:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=3.0)
        if process.poll() is None:
            process.kill()
            process.wait()


def wait_until_served(process: "subprocess.Popen[bytes]", ports: Sequence[int]) -> None:
    """Wait until a viewer takes connections.

    Raises:
        OperationError: it ended, or takes too long.
    """
    deadline_s = time.monotonic() + START_TIMEOUT_S
    for port in ports:
        while True:
            if process.poll() is not None:
                raise OperationError(
                    "the rerun viewer ended at once (it needs a display; without one use --save or --web)"
                )
            with closing(socket.socket()) as probe:
                probe.settimeout(1.0)
                if probe.connect_ex((LOOPBACK, port)) == 0:
                    break
            if time.monotonic() > deadline_s:
                raise OperationError(
                    f"the rerun viewer does not answer at {LOOPBACK}:{port} after {START_TIMEOUT_S:.0f} s"
                )
            time.sleep(_POLL_S)


def wait_for_end(process: "subprocess.Popen[bytes]", stopping: threading.Event) -> None:
    """Wait until the viewer is closed, or `stopping` is set."""
    while process.poll() is None and not stopping.wait(_POLL_S):
        pass


def free_port() -> int:
    """A TCP port that nobody uses on loopback now."""
    with closing(socket.socket()) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def browser_address(grpc_port: int, web_port: int) -> str:
    """What to open in a browser."""
    return f"http://{LOOPBACK}:{web_port}?url=rerun%2Bhttp://{LOOPBACK}:{grpc_port}/proxy"
