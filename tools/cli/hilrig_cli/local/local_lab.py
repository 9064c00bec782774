"""A lab on this host: checks its ports, starts its services, and waits until controllers can connect."""

import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from hilrig_cli.local.supervisor import DEFAULT_PROCESSES, ProcessSpec, Supervisor
from hilrig_runtime.addresses import format_address, listen_hint, listen_reason
from hilrig_runtime.bus.api import Bus
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.bus.zenoh_config import MESH_ORDER
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.discovery import list_services
from hilrig_schemas.topics import alive_key

POLL_S: Final = 0.05
READY_TIMEOUT_S: Final = 60.0
"""Long, because a first start imports many files from a possibly slow disk."""


@contextmanager
def running_lab(
    lab: LabConfig,
    config: Path | None,
    log: Callable[[str], None],
    stopping: threading.Event,
    processes: Sequence[ProcessSpec] = DEFAULT_PROCESSES,
    options: Sequence[str] = (),
) -> Iterator[Supervisor]:
    """Start the services of `lab` (read from `config`) and yield their supervisor once controllers can connect.

    Each service gets `options` too. Setting `stopping` ends the waiting. Leaving the context stops every service, in
    order.

    Raises:
        HilrigError: a service could not start; its reason is on standard error.
    """
    _check_ports(lab)
    with Supervisor(config, log, processes, options) as supervisor:
        supervisor.start()
        _wait_until_ready(lab, processes, supervisor, stopping)
        supervisor.mark_ready()
        yield supervisor


@contextmanager
def lab_file_of_controller(controller: str, config: Path | None) -> Iterator[Path]:
    """Write a temporary file of a lab with one rig that is a client of `controller`, and yield its path.

    Raises:
        InputError: there is a file already.
    """
    if config is not None:
        raise InputError(f"--controller: {config} defines the rigs; set controller there, in [[rigs]]")
    with TemporaryDirectory(prefix="hilrig-") as folder:
        path = Path(folder) / "lab.toml"
        path.write_text(f'[[rigs]]\nname = "rig1"\ncontroller = {json.dumps(controller)}\n')
        yield path


def _check_ports(lab: LabConfig) -> None:
    """Check all ports before the start, so that an error is reported once and not by each service.

    It also prevents that services of another lab on the same bus ports are mistaken for this lab's.
    """
    keys = {"Modbus TCP": "edge.first_port, or `port` of the rig", "Modbus TCP with TLS": "edge.tls.first_port"}
    required = [
        (f"rig {rig!r}", host, port, "edge.host, or `host` of the rig,", keys[kind])
        for rig, kinds in lab.addresses().items()
        for kind, (host, port) in kinds.items()
    ]
    if lab.bus.topology == "mesh":
        ports = range(lab.bus.first_port, lab.bus.first_port + len(MESH_ORDER))
        required += [("the bus", lab.bus.host, port, "bus.host", "bus.first_port") for port in ports]
    for owner, host, port, host_key, port_key in required:
        if (error := bind_error(host, port)) is not None:
            hint = listen_hint(error, port, host_key, port_key)
            raise OperationError(
                f"{owner}: can't listen on {format_address(host, port)}: {listen_reason(error)}; {hint}"
            )


def bind_error(host: str, port: int) -> OSError | None:
    """Return the error of binding a TCP port of this host; None: it is free."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            if sys.platform != "win32":
                # As in the services: a port with connections in TIME_WAIT only is free.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        return error
    return None


def _wait_until_ready(
    lab: LabConfig, processes: Sequence[ProcessSpec], supervisor: Supervisor, stopping: threading.Event
) -> None:
    missing = {alive_key(lab.name, spec.service, spec.instance) for spec in processes}
    deadline_s = time.monotonic() + READY_TIMEOUT_S
    with ZenohBus(lab.bus, "tool") as bus:
        bus.subscribe_liveliness(
            alive_key(lab.name, "*", "*"), lambda key, alive: missing.discard(key) if alive else None
        )
        while not stopping.is_set():
            supervisor.poll()
            reason = f"not on the bus: {', '.join(sorted(missing))}" if missing else unrecorded(bus, lab, processes)
            if not reason:
                return
            if time.monotonic() > deadline_s:
                raise OperationError(f"the lab is not ready after {READY_TIMEOUT_S:.0f} s; {reason}")
            time.sleep(POLL_S)


def unrecorded(bus: Bus, lab: LabConfig, processes: Sequence[ProcessSpec]) -> str:
    """Describe the services whose messages do not arrive at a recorder yet; empty: a session would be recorded now.

    A service that stops before the recorder has connected to it would take its messages along.
    """
    expected = {f"{spec.service}/{spec.instance}" for spec in processes if spec.service != "recorder"}
    recorders = {spec.instance for spec in processes if spec.service == "recorder"}
    infos = [info for info in list_services(bus, lab, "recorder") if info.instance in recorders]
    if len(infos) < len(recorders):
        return "a recorder does not reply"
    waiting = [(info.instance, sorted(expected.difference(info.received))) for info in infos]
    return "; ".join(f"recorder/{name} receives nothing from {', '.join(silent)}" for name, silent in waiting if silent)


def free_ports(first: int, count: int = 1) -> int:
    """Find `count` consecutive free ports on loopback, starting at `first`; return the lowest."""
    while any(bind_error("127.0.0.1", port) for port in range(first, first + count)):
        first += count
    return first
