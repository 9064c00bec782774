"""What `hilrig demo` does: lab up, controller on, lab down; then the recording's latency, picture and plot."""

import importlib.util
import socket
from contextlib import closing
from pathlib import Path
from typing import Final

from hilrig_runtime.errors import OperationError

CONTROLLER: Final = "pick_and_place.py"
CONTROLLER_GRACE_S: Final = 15.0
"""What the controller may take beyond its duration, to start and to end, s."""


def controller_path() -> Path:
    """The example controller: of this checkout, or as it was installed with the package."""
    beside = Path(__file__).parents[3] / "examples" / CONTROLLER
    if beside.exists():
        return beside
    spec = importlib.util.find_spec("hilrig_examples")
    if spec is None or not spec.submodule_search_locations:
        raise OperationError(f"the example controller {CONTROLLER} is not part of this installation")
    return Path(next(iter(spec.submodule_search_locations))) / CONTROLLER


def free_port(wanted: int, count: int = 1) -> int:
    """`wanted` where it and the next ones are free on loopback, else the first of `count` that are."""
    candidate = wanted
    while True:
        try:
            for port in range(candidate, candidate + count):
                with closing(socket.socket()) as probe:
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    probe.bind(("127.0.0.1", port))
        except OSError:
            candidate += count
            continue
        return candidate
