"""`hilrig` processes that are forked from a server with the modules already imported."""

import ctypes
import inspect
import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from support.fork_server import ARGUMENT_BYTES

HILRIG = [sys.executable, "-m", "hilrig_cli"]

_LOCK = threading.Lock()
"""Held during a request: a subreaper is a property of the whole process."""

_PR_SET_CHILD_SUBREAPER = 36

_EXECUTE_CHILD = inspect.signature(subprocess.Popen._execute_child)  # type: ignore[attr-defined]

SERVERS: list[socket.socket] = []
"""Requests of the server of this process, which is started at the first use. It ends when the socket is closed."""

_STARTED: list["subprocess.Popen[bytes]"] = []
"""The started server: without a reference, its running process would be reported as a leak."""


def _start_server() -> None:
    requests, replies = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    program = Path(__file__).with_name("fork_server.py")
    path = os.pathsep.join([str(program.parent.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    process = subprocess.Popen(
        [sys.executable, str(program), str(replies.fileno()), " " * ARGUMENT_BYTES],
        stdin=subprocess.DEVNULL,
        pass_fds=[replies.fileno()],
        env={**os.environ, "PYTHONPATH": path},
    )
    replies.close()
    SERVERS.append(requests)
    _STARTED.append(process)


class ForkedPopen(subprocess.Popen[Any]):
    """A `Popen` that forks the process from the server if its command is `HILRIG` with the present environment."""

    def _execute_child(self, *arguments: Any) -> None:
        call = _EXECUTE_CHILD.bind(self, *arguments).arguments
        command = [] if isinstance(call["args"], str) else list(map(os.fspath, call["args"]))
        if command[: len(HILRIG)] != HILRIG or call["env"] is not None or call["pass_fds"]:
            super()._execute_child(*arguments)  # type: ignore[misc]
            return
        request = {
            "arguments": command[len(HILRIG) :],
            "cwd": os.path.abspath(call["cwd"] or "."),  # noqa: PTH100 (no link is resolved)
            "environ": dict(os.environ),
            "new_session": call["start_new_session"],
        }
        ends = (call["p2cread"], call["c2pwrite"], call["errwrite"])
        files = [number if end == -1 else end for number, end in enumerate(ends)]
        with _LOCK:
            self.pid = _fork(json.dumps(request).encode(), files)
        self._child_created = True
        names = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
        self._close_pipe_fds(*(call[name] for name in names))  # type: ignore[attr-defined]


def _fork(request: bytes, files: list[int]) -> int:
    """Send a request to the server; returns the id of the forked process, now a child of this one."""
    if not SERVERS:
        _start_server()
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        socket.send_fds(SERVERS[0], [request], files)
        reply = SERVERS[0].recv(20)
    finally:
        prctl(_PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)
    if not reply:
        raise ChildProcessError("the fork server has ended")
    return int(reply)
