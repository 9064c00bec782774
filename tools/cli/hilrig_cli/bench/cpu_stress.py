"""Processes that keep every processor busy: what a rig has to bear when its machine does something else too."""

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from hilrig_cli.local.supervisor import own_process_group


@contextmanager
def busy_processors(count: int) -> Iterator[None]:
    """Keep `count` processors busy, each by a process of its own, until the context is left."""
    with ExitStack() as processes:
        for _ in range(count):
            # A session of its own, as somebody else's work has: the system shares out between sessions first.
            process = subprocess.Popen(
                [sys.executable, "-m", "hilrig_cli.bench.cpu_stress"], stdin=subprocess.PIPE, **own_process_group()
            )
            processes.callback(_end, process)
        yield


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.kill()
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def burn() -> None:
    """Compute, and move memory through the caches, until standard input ends: whoever started this is gone."""

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(0, 4096):
                pass
        os._exit(0)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
    data = np.ones(1 << 20)
    while True:
        data = np.sqrt(data + 1.0)


if __name__ == "__main__":
    burn()
