"""Starts `hilrig` commands without Python's start: forks itself for each, with what most commands import.

Most of a short command's time is imports. Jobs come as lines of JSON on standard input, `{words, cwd, environ, out,
err}`; for each it prints the process id, then the exit code. It ends with its standard input.
"""

import gc
import json
import os
import sys
from importlib import import_module
from typing import Any

IMPORTED = (
    "hilrig_cli.main",
    "hilrig_cli.local.local_lab",
    "hilrig_replay.report.report",
    "hilrig_replay.analysis.verify",
    "hilrig_runtime.process.lifecycle",
)
"""What starts no threads, which a fork would leave behind; so not rerun."""


def become(job: dict[str, Any]) -> None:
    """Set up the forked process like a process started by a shell."""
    os.chdir(job["cwd"])
    os.environ.clear()
    os.environ.update(job["environ"])
    sys.argv = ["hilrig", *job["words"]]
    for number, path in enumerate((os.devnull, job["out"], job["err"])):
        opened = os.open(path, os.O_WRONLY if number else os.O_RDONLY)
        os.dup2(opened, number)
        os.close(opened)


def serve() -> bool:
    """Fork for each job until there are no more; true in a process that is to do one."""
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            become(json.loads(line))
            return True
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
    return False


if __name__ == "__main__":
    for module in IMPORTED:
        import_module(module)
    # Existing memory is shared with the forks until it is written.
    gc.freeze()
    if serve():
        from hilrig_cli.__main__ import main

        sys.exit(main())
