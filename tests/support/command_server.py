"""Runs `hilrig` commands in forked processes that have already imported the modules of most commands.

Imports take most of the run time of a short command. Each line of standard input is a job in JSON, `{arguments, cwd,
environ, out, err}`; the process id and then the exit code are printed. The server ends with its standard input.
"""

import gc
import json
import os
import sys
from importlib import import_module
from typing import Any

IMPORTED = (
    "hilrig_cli.main",
    "hilrig_cli.json_output.lab",
    "hilrig_cli.json_output.recordings",
    "hilrig_cli.local.local_lab",
    "hilrig_replay.report.report",
    "hilrig_replay.analysis.verify",
    "hilrig_runtime.process.lifecycle",
)
"""Modules that start no threads: a fork does not copy threads. rerun starts threads."""


def apply_job(job: dict[str, Any]) -> None:
    """Apply the folder, environment, arguments and files of a job to the forked process."""
    os.chdir(job["cwd"])
    os.environ.clear()
    os.environ.update(job["environ"])
    sys.argv = ["hilrig", *job["arguments"]]
    for number, path in enumerate((os.devnull, job["out"], job["err"])):
        opened = os.open(path, os.O_WRONLY if number else os.O_RDONLY)
        os.dup2(opened, number)
        os.close(opened)


def serve() -> bool:
    """Fork for each job; returns True in a forked process, False in the server after the last job."""
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            apply_job(json.loads(line))
            return True
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
    return False


if __name__ == "__main__":
    for module in IMPORTED:
        import_module(module)
    # Frozen objects are not collected, so their memory pages stay shared with the forked processes.
    gc.freeze()
    if serve():
        from hilrig_cli.__main__ import main

        main()
