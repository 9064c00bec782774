"""A lab on this host: services supervised, ready when controllers can connect, watched while it runs."""

import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from hilrig_cli.local.supervisor import WHOLE_LAB, Part, Supervisor
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.bus.zenoh_config import MESH_ORDER
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_schemas.topics import alive_key

POLL_S: Final = 0.05
READY_TIMEOUT_S: Final = 60.0
"""Generous: a cold start on a slow disk imports for a while."""


@contextmanager
def running_lab(
    lab: LabConfig,
    config: Path | None,
    say: Callable[[str], None],
    stopping: threading.Event,
    parts: Sequence[Part] = WHOLE_LAB,
    options: Sequence[str] = (),
) -> Iterator[Supervisor]:
    """Start the services of `lab` (read from `config`) and give their supervisor once controllers can connect.

    Each service gets `options` too. Setting `stopping` cuts the waiting short. Leaving the context ends every service,
    in order.

    Raises:
        HilrigError: a service could not start; it said why on standard error.
    """
    _check_ports(lab)
    with Supervisor(config, say, parts, options) as supervisor:
        supervisor.start()
        _wait_until_ready(lab, parts, supervisor, stopping)
        supervisor.settled()
        yield supervisor


def _check_ports(lab: LabConfig) -> None:
    """Say at once, and once, what each service would say: whoever else has the ports is heard on the bus like ours."""
    wanted: list[tuple[str, str, int, str]] = []
    if lab.edge.plain:
        key = "edge.first_port or the rig's port"
        wanted += [(f"rig {rig!r}", lab.edge.host, port, key) for rig, port in lab.ports.items()]
    wanted += [(f"rig {rig!r}", lab.edge.host, port, "edge.tls.first_port") for rig, port in lab.tls_ports.items()]
    if lab.bus.topology == "mesh":
        ports = range(lab.bus.first_port, lab.bus.first_port + len(MESH_ORDER))
        wanted += [("the bus", lab.bus.host, port, "bus.first_port") for port in ports]
    for what, host, port, key in wanted:
        if (reason := why_not_free(host, port)) is not None:
            raise OperationError(
                f"{what}: can't listen on {host}:{port} ({reason}): is another hilrig running here? "
                f"End what has the port, or choose another {key} in lab.toml"
            )


def why_not_free(host: str, port: int) -> str | None:
    """Why nobody can listen on a TCP port of this machine now; None: somebody can."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            if sys.platform != "win32":
                # As the services do: a port that only waits for its last connection to fade counts as free.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        return error.strerror or str(error)
    return None


def _wait_until_ready(lab: LabConfig, parts: Sequence[Part], supervisor: Supervisor, stopping: threading.Event) -> None:
    missing = {alive_key(lab.name, part.service, part.instance) for part in parts}
    deadline_s = time.monotonic() + READY_TIMEOUT_S
    with ZenohBus(lab.bus, "tool") as bus:
        bus.subscribe_liveliness(
            alive_key(lab.name, "*", "*"), lambda key, alive: missing.discard(key) if alive else None
        )
        while missing and not stopping.is_set():
            supervisor.poll()
            if time.monotonic() > deadline_s:
                raise OperationError(
                    f"not up after {READY_TIMEOUT_S:.0f} s: nothing heard of {', '.join(sorted(missing))}"
                )
            time.sleep(POLL_S)
