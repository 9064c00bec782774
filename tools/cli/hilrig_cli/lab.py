"""A lab on this host: services supervised, ready when controllers can connect, watched while it runs."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from hilrig_cli.supervisor import START_ORDER, Supervisor
from hilrig_runtime.config import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.zenoh_bus import ZenohBus
from hilrig_schemas.topics import alive_key

POLL_S: Final = 0.05
READY_TIMEOUT_S: Final = 60.0
"""Generous: a cold start on a slow disk imports for a while."""


@contextmanager
def running_lab(
    lab: LabConfig, config: Path | None, say: Callable[[str], None], stopping: threading.Event
) -> Iterator[Supervisor]:
    """Start the services of `lab` (read from `config`) and give their supervisor once controllers can connect.

    Setting `stopping` cuts the waiting short. Leaving the context ends every service, in order.

    Raises:
        HilrigError: a service could not start; it said why on standard error.
    """
    with Supervisor(config, say) as supervisor:
        supervisor.start()
        _wait_until_ready(lab, supervisor, stopping)
        supervisor.settled()
        yield supervisor


def _wait_until_ready(lab: LabConfig, supervisor: Supervisor, stopping: threading.Event) -> None:
    missing = {alive_key(lab.name, service, "1") for service in START_ORDER}
    deadline_s = time.monotonic() + READY_TIMEOUT_S
    with ZenohBus(lab.bus, "tool") as bus:
        bus.watch(alive_key(lab.name, "*", "*"), lambda key, alive: missing.discard(key) if alive else None)
        while missing and not stopping.is_set():
            supervisor.poll()
            if time.monotonic() > deadline_s:
                raise OperationError(
                    f"not up after {READY_TIMEOUT_S:.0f} s: nothing heard of {', '.join(sorted(missing))}"
                )
            time.sleep(POLL_S)
