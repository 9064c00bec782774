"""Checks of this host: installed versions, ports, open files, timer accuracy, disk."""

import os
import shutil
import socket
import struct
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from hilrig_cli.doctor import CheckResult, Level
from hilrig_cli.local.local_lab import bind_error
from hilrig_cli.options import format_size
from hilrig_runtime.addresses import format_address, listen_hint, listen_reason
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import list_names
from hilrig_runtime.timing.realtime import set_short_slice

RESERVED_HANDLES: Final = 200
"""File handles that a service needs besides its connections."""
SLEEP_COUNT: Final = 100
BYTES_PER_RIG_HOUR: Final = 30 * 2**20
"""Size of a recording of one rig at a step of 20 ms, per hour, rounded up."""
_PROBE_TIMEOUT_S: Final = 1.0
_IDENTIFY: Final = bytes.fromhex("0001 0000 0005 01 2B 0E 01 00")


def check_software() -> Iterator[CheckResult]:
    """Report the versions that are installed here."""
    found = []
    for name in ("hilrig", "eclipse-zenoh", "pymodbus", "mcap"):
        with suppress(PackageNotFoundError):
            found.append(f"{name} {version(name)}")
    yield CheckResult.ok("software", f"Python {sys.version.split()[0]}, {', '.join(found)}")


def check_ports(lab: LabConfig, running: Collection[str], *, is_edge_stopped: bool = False) -> Iterator[CheckResult]:
    """Check that each Modbus port of the lab is free or served by a hilrig edge.

    Args:
        lab: the lab.
        running: kinds of service that are alive on the bus.
        is_edge_stopped: whether an edge of the lab is stopped on this host: it has its ports, but does not answer.
    """
    ports = [(rig, *address) for rig, kinds in lab.addresses().items() for address in kinds.values()]
    served, free = 0, 0
    for rig, host, port in ports:
        error = bind_error(host, port)
        if error is None:
            free += 1
        elif is_edge_stopped or _is_hilrig_edge(host, port) or (port in lab.tls_ports.values() and "edge" in running):
            served += 1
        else:
            yield CheckResult.error(
                "ports",
                f"rig {rig!r}: {format_address(host, port)} is unavailable ({listen_reason(error)}) and not served by "
                "a hilrig edge",
                listen_hint(error, port, "edge.host, or `host` of the rig,", "edge.first_port, or `port` of the rig"),
            )
    if served + free == len(ports):
        yield CheckResult.ok("ports", f"{served} of {len(ports)} Modbus ports served by hilrig, {free} free")
    exposed = {lab.host_of(rig) for rig in lab.rigs if not rig.allow} - {"127.0.0.1", "::1", "localhost"}
    if lab.edge.plain and exposed:
        yield CheckResult.warning(
            "ports",
            f"edge.host is {list_names(sorted(exposed))}: any host that reaches the edge can control a rig without a "
            "certificate",
            "list the networks that may connect to each rig (allow), or use [edge.tls] with plain = false",
        )


def check_open_files(lab: LabConfig) -> Iterator[CheckResult]:
    """Check that the limit of open files covers the lab's connections; a service raises its soft limit to it."""
    if sys.platform == "win32":
        return
    import resource

    _, limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = RESERVED_HANDLES + len(lab.rigs) * lab.edge.max_connections
    if limit == resource.RLIM_INFINITY or limit >= needed:
        yield CheckResult.ok("open files", f"limit {limit}, required {needed}")
        return
    likely = RESERVED_HANDLES + 4 * len(lab.rigs)
    yield CheckResult(
        "open files",
        Level.WARNING if limit >= likely else Level.ERROR,
        f"limit {limit}, but {needed} are required if every rig has edge.max_connections ({lab.edge.max_connections})",
        f"raise the user's limit (ulimit -Hn {needed} as root, or LimitNOFILE of the service), reduce "
        "edge.max_connections, or use several edges (hilrig up --edges)",
    )


def check_timer_accuracy(lab: LabConfig) -> Iterator[CheckResult]:
    """Check that short sleeps end on time; a quick test only, `hilrig jitter` measures in detail."""
    set_short_slice()
    lateness_ns = []
    for _ in range(SLEEP_COUNT):
        deadline_ns = time.monotonic_ns() + 1_000_000
        time.sleep(0.001)
        lateness_ns.append(time.monotonic_ns() - deadline_ns)
    late_ms = sorted(lateness_ns)[round(0.95 * (SLEEP_COUNT - 1))] / 1e6
    cores = os.cpu_count() or 1
    text = f"{cores} cores; lateness of {SLEEP_COUNT} sleeps: p95 {late_ms:.2f} ms; step {lab.sim.step_ms:g} ms"
    if late_ms < lab.sim.step_ms / 10:
        yield CheckResult.ok("punctuality", text)
    else:
        fix = "stop other programs on this host, or set a longer sim.step_ms; measure with hilrig jitter"
        yield CheckResult.warning("punctuality", text, fix)


def check_disk(lab: LabConfig) -> Iterator[CheckResult]:
    """Check that recordings can be written and that the free space lasts for some hours."""
    folder = lab.recorder.folder
    existing = next((path for path in (folder, *folder.absolute().parents) if path.exists()), folder)
    if not os.access(existing, os.W_OK):
        text = f"{folder}: recordings can't be written: no write permission"
        yield CheckResult.error("disk", text, "set another recorder.folder, or change the folder's permissions")
        return
    free = shutil.disk_usage(existing).free
    reserve = lab.recorder.min_free_mib * 2**20
    hours = max(0.0, free - reserve) / (BYTES_PER_RIG_HOUR * len(lab.rigs))
    text = f"{format_size(free)} free for recordings in {folder}"
    if free <= reserve:
        text += f": recording stops below recorder.min_free_mib ({lab.recorder.min_free_mib} MiB)"
        yield CheckResult.error("disk", text, "delete old recordings")
    elif hours < 8:
        fix = "delete old recordings, or set recorder.keep_gib"
        yield CheckResult.warning("disk", f"{text}, enough for about {hours:.1f} h of this lab", fix)
    else:
        yield CheckResult.ok("disk", text)


def _is_hilrig_edge(host: str, port: int) -> bool:
    """Whether the server on a port identifies itself as a hilrig edge (function 43/14)."""
    reachable = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    with suppress(OSError, struct.error), socket.create_connection((reachable, port), _PROBE_TIMEOUT_S) as probe:
        probe.settimeout(_PROBE_TIMEOUT_S)
        probe.sendall(_IDENTIFY)
        return b"hilrig-edge" in probe.recv(300)
    return False
