"""Can this host carry the lab: ports, open files, punctuality, disk, software?"""

import os
import shutil
import socket
import struct
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version

from hilrig_cli.doctor import Finding, good, notice, wrong
from hilrig_cli.local.local_lab import why_not_free
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.timing.realtime import set_short_slice

OWN_FILES = 200
"""Handles that a service needs beside its connections."""
SLEEPS = 100
BYTES_A_RIG_AND_HOUR = 30 * 2**20
"""What a recording of a rig at a 20 ms step takes, rounded up."""
_PROBE_TIMEOUT_S = 1.0
_IDENTIFY = bytes.fromhex("0001 0000 0005 01 2B 0E 01 00")


def check_software() -> Iterator[Finding]:
    """Which versions are installed here."""
    found = []
    for name in ("hilrig", "eclipse-zenoh", "pymodbus", "mcap"):
        with suppress(PackageNotFoundError):
            found.append(f"{name} {version(name)}")
    yield good("software", f"Python {sys.version.split()[0]}, {', '.join(found)}")


def check_ports(lab: LabConfig, running: Collection[str]) -> Iterator[Finding]:
    """Each Modbus port of the lab is free, or an edge of ours serves it; `running`: services heard on the bus."""
    ports = [*(lab.ports.items() if lab.edge.plain else ()), *lab.tls_ports.items()]
    served, free = 0, 0
    for rig, port in ports:
        reason = why_not_free(lab.edge.host, port)
        if reason is None:
            free += 1
        elif _is_ours(lab.edge.host, port) or (port in lab.tls_ports.values() and "edge" in running):
            served += 1
        else:
            yield wrong(
                "ports",
                f"rig {rig!r}: {lab.edge.host}:{port} can't be had ({reason}), and what has it is no edge of ours",
                "end the program that listens there, or set another edge.first_port or the rig's own port in lab.toml",
            )
    if served + free == len(ports):
        yield good("ports", f"{served} of {len(ports)} Modbus ports served by hilrig, {free} free")
    if lab.edge.host not in ("127.0.0.1", "::1", "localhost") and lab.edge.plain and not _all_restricted(lab):
        yield notice(
            "ports",
            f"edge.host is {lab.edge.host}: whoever reaches the edge's host may take a rig without a certificate",
            "name the networks of each rig (allow), or take [edge.tls] with plain = false",
        )


def check_open_files(lab: LabConfig) -> Iterator[Finding]:
    """A process may open as many connections as the lab allows; a service takes all that its user may have."""
    if sys.platform == "win32":
        return
    import resource

    _, limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = OWN_FILES + len(lab.rigs) * lab.edge.max_connections
    if limit == resource.RLIM_INFINITY or limit >= needed:
        yield good("open files", f"{limit} may be open, {needed} are enough")
        return
    likely = OWN_FILES + 4 * len(lab.rigs)
    say = notice if limit >= likely else wrong
    yield say(
        "open files",
        f"{limit} may be open, {needed} are needed if every rig has edge.max_connections ({lab.edge.max_connections})",
        f"a higher limit for its user (ulimit -Hn {needed} as root, or LimitNOFILE of the service), a smaller "
        "edge.max_connections, or hilrig up --edges",
    )


def check_punctuality(lab: LabConfig) -> Iterator[Finding]:
    """A sleep ends in time, as far as that shows in a moment; `hilrig jitter` looks longer."""
    set_short_slice()
    lates = []
    for _ in range(SLEEPS):
        deadline_ns = time.monotonic_ns() + 1_000_000
        time.sleep(0.001)
        lates.append(time.monotonic_ns() - deadline_ns)
    late_ms = sorted(lates)[round(0.95 * (SLEEPS - 1))] / 1e6
    cores = os.cpu_count() or 1
    text = f"{cores} cores; of {SLEEPS} sleeps 95 % ended within {late_ms:.2f} ms, the step is {lab.sim.step_ms:g} ms"
    if late_ms < lab.sim.step_ms / 10:
        yield good("punctuality", text)
    else:
        yield notice(
            "punctuality", text, "end what else runs here, or take a longer sim.step_ms; hilrig jitter says more"
        )


def check_disk(lab: LabConfig) -> Iterator[Finding]:
    """Recordings can be written, and there is room for a while."""
    folder = lab.recorder.folder
    there = next((path for path in (folder, *folder.absolute().parents) if path.exists()), folder)
    if not os.access(there, os.W_OK):
        yield wrong(
            "disk", f"{folder}: recordings can't be written there", "set another recorder.folder, or its rights"
        )
        return
    free = shutil.disk_usage(there).free
    least = lab.recorder.min_free_mib * 2**20
    hours = max(0.0, free - least) / (BYTES_A_RIG_AND_HOUR * len(lab.rigs))
    text = f"{_size(free)} free for recordings in {folder}"
    if free <= least:
        yield wrong("disk", f"{text}: recordings end below {lab.recorder.min_free_mib} MiB", "delete old recordings")
    elif hours < 8:
        yield notice("disk", f"{text}, about {hours:.1f} h of this lab", "delete old ones, or set recorder.keep_gib")
    else:
        yield good("disk", text)


def _size(bytes_: int) -> str:
    return f"{bytes_ / 2**30:.1f} GiB" if bytes_ >= 2**30 else f"{bytes_ >> 20} MiB"


def _all_restricted(lab: LabConfig) -> bool:
    return all(rig.allow for rig in lab.rigs)


def _is_ours(host: str, port: int) -> bool:
    """Whether who listens there identifies itself as this project's edge (function 43/14)."""
    reachable = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    with suppress(OSError, struct.error), socket.create_connection((reachable, port), _PROBE_TIMEOUT_S) as probe:
        probe.settimeout(_PROBE_TIMEOUT_S)
        probe.sendall(_IDENTIFY)
        return b"hilrig-edge" in probe.recv(300)
    return False
