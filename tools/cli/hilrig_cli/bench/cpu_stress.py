"""CPU stress: processes that keep every processor busy while a lab runs."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from hilrig_cli.local.supervisor import own_process_group
from hilrig_runtime.process.shutdown import stop_with_stdin


@contextmanager
def cpu_stress(count: int) -> Iterator[None]:
    """Keep `count` processors busy, each with one process, until the context is left."""
    with ExitStack() as processes:
        for _ in range(count):
            # In a session of its own, like an independent program: Linux groups processes by session for scheduling.
            command = [sys.executable, "-m", "hilrig_cli.bench.cpu_stress"]
            process = subprocess.Popen(command, stdin=subprocess.PIPE, **own_process_group())
            # Killed first, then closed and waited for.
            processes.enter_context(process)
            processes.callback(process.kill)
        yield


def stress_until_parent_ends() -> None:
    """Compute and move memory through the caches until standard input is closed, that is, the parent has ended."""
    stopping = threading.Event()
    stop_with_stdin(stopping)
    data = np.ones(1 << 20)
    while not stopping.is_set():
        data = np.sqrt(data + 1.0)


if __name__ == "__main__":
    stress_until_parent_ends()
