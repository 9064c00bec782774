"""Server that forks `hilrig` processes which have the modules of most commands already imported.

Imports take most of the run time of a short command and of the start of a service. A forked process is an own process
in all respects: memory, threads, files, signals, command line. `HilrigProcess` of `hilrig_process` is its client.
"""

import ctypes
import gc
import json
import os
import socket
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

IMPORTED = (
    "hilrig_cli.main",
    "hilrig_cli.json_output.lab",
    "hilrig_cli.json_output.recordings",
    "hilrig_cli.local.local_lab",
    "hilrig_modbus_edge.service",
    "hilrig_recorder.service",
    "hilrig_replay.report.report",
    "hilrig_replay.analysis.verify",
    "hilrig_runtime.process.lifecycle",
    "hilrig_sim.service",
)
"""Modules that start no threads: a fork does not copy threads. rerun starts threads."""

ARGUMENT_BYTES = 4096
"""Size of the server's last argument: space for the command line of a forked process."""


def serve(requests: socket.socket) -> dict[str, Any]:
    """Fork a process for each request until the client closes the socket; returns the request in a forked process.

    A request is JSON, with the file descriptors of standard input, output and error. The reply is the process id. The
    parent process of the forked process ends at once, so the client, a subreaper meanwhile, becomes its parent.
    """
    while True:
        data, descriptors, _, _ = socket.recv_fds(requests, 1 << 20, 3)
        if not data:
            os._exit(0)
        read_end, write_end = os.pipe()
        parent = os.fork()
        if parent == 0:
            pid = os.fork()
            if pid != 0:
                os.write(write_end, str(pid).encode())
                os._exit(0)
            for number, descriptor in enumerate(descriptors):
                os.dup2(descriptor, number)
            for descriptor in (*descriptors, read_end, write_end):
                os.close(descriptor)
            requests.close()
            return dict(json.loads(data))
        os.waitpid(parent, 0)
        requests.send(os.read(read_end, 20))
        for descriptor in (*descriptors, read_end, write_end):
            os.close(descriptor)


def apply(request: dict[str, Any]) -> None:
    """Apply folder, environment, arguments and standard files of a request to this process."""
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environ"])
    if request["new_session"]:
        os.setsid()
    set_command_line([sys.executable, "-m", "hilrig_cli", *request["arguments"]])
    sys.argv = ["hilrig", *request["arguments"]]
    # As the interpreter opens them.
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 (a descriptor, which stays open)
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115


def set_command_line(arguments: list[str]) -> None:
    """Overwrite the command line of this process, which /proc shows."""
    start, end = map(int, Path("/proc/self/stat").read_text().rpartition(")")[2].split()[45:47])
    size = end - start
    line = "\0".join(arguments).encode()[: size - 1].ljust(size, b"\0")
    ctypes.memmove(start, line, size)


def fork_own_server() -> socket.socket:
    """Fork a server whose forked processes become children of this process; returns its requests."""
    requests, replies = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if os.fork() == 0:
        requests.close()
        set_command_line(["fork server"])
        run(serve(replies))
    replies.close()
    return requests


def run(request: dict[str, Any]) -> NoReturn:
    """Run the command of a request in this process, and end the process."""
    from hilrig_cli.__main__ import main

    apply(request)
    if request["arguments"][:1] == ["up"]:
        # Its services are forked too.
        from support import hilrig_process

        hilrig_process.SERVERS.append(fork_own_server())
        subprocess.Popen = hilrig_process.ForkedPopen  # type: ignore[misc]
    main()


if __name__ == "__main__":
    for module in IMPORTED:
        import_module(module)
    # Frozen objects are not collected, so their memory pages stay shared with the forked processes.
    gc.freeze()
    run(serve(socket.socket(fileno=int(sys.argv[1]))))
