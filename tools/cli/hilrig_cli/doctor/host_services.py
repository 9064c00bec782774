"""The services that this host need not run; it is not checked for their needs."""

import platform
import socket
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing
from typing import Final

from hilrig_cli.doctor import CheckResult
from hilrig_cli.doctor.processes import LocalProcess, can_list_processes
from hilrig_cli.doctor.services import BusSnapshot
from hilrig_runtime.addresses import WILDCARDS
from hilrig_runtime.bus.acl import identities
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError
from hilrig_schemas.topics import SERVICES

KINDS: Final = (*SERVICES, "router")


def parse_kinds(text: str) -> frozenset[str]:
    """Return the kinds of service in a text such as "sim,edge"; empty: none.

    Raises:
        InputError: it names another one.
    """
    kinds = [kind.strip() for kind in text.split(",") if kind.strip()]
    for kind in kinds:
        if kind not in KINDS:
            raise InputError(f"--here: expected services of {', '.join(KINDS)}, separated by commas, got {kind!r}")
    return frozenset(kinds)


def services_elsewhere(
    lab: LabConfig, snapshot: BusSnapshot, processes: Sequence[LocalProcess], chosen: Collection[str] = ()
) -> dict[str, str]:
    """Return each kind of service that this host need not run, with the reason.

    Args:
        lab: the lab; with a bus without a router, all services run on this host.
        snapshot: services on the bus.
        processes: those of the lab on this host.
        chosen: kinds that the user says run here; empty: judged by processes, addresses, certificates and the bus.
    """
    if chosen:
        return {kind: "not named with --here" for kind in KINDS if kind not in chosen}
    if lab.bus.topology != "router":
        return {}
    here = {process.service for process in processes}
    found = {kind: _reason(lab, snapshot, kind) for kind in KINDS if kind not in here}
    return {kind: reason for kind, reason in found.items() if reason}


def check_here(
    elsewhere: dict[str, str], processes: Sequence[LocalProcess], chosen: Collection[str]
) -> Iterator[CheckResult]:
    """Report what this host is judged by, and each chosen service that has no process here."""
    if elsewhere:
        judged = ", ".join(kind for kind in KINDS if kind not in elsewhere) or "none"
        others = "; ".join(f"{kind}: {reason}" for kind, reason in elsewhere.items())
        yield CheckResult.ok("host", f"services that it is checked for: {judged}; not checked for {others}")
    running = {process.service for process in processes}
    for kind in KINDS:
        if kind in chosen and kind not in running and can_list_processes():
            text = f"{kind} is named with --here, but has no process on this host"
            yield CheckResult.error("host", text, f"start it: hilrig {kind}")


def _reason(lab: LabConfig, snapshot: BusSnapshot, kind: str) -> str:
    """Return the reason why a service without a process here need not run here; empty: it may."""
    if kind == "router":
        return "" if _is_local(lab.bus.router_host) else f"bus.router is on {lab.bus.router_host}"
    if kind == "edge":
        hosts = {lab.host_of(rig) for rig in lab.rigs}
        if not any(map(_is_local, hosts)):
            return f"edge.host is {', '.join(sorted(hosts))}"
    if lab.bus.tls is not None:
        names = [identity.name for identity in identities(lab.bus.tls) if identity.role == kind]
        if not any((lab.bus.tls.folder / f"{name}.pem").exists() for name in names):
            return f"{lab.bus.tls.folder} has no certificate for it"
    hosts = {health.host for health in snapshot.healths.values() if health.service == kind}
    return f"runs on {', '.join(sorted(hosts))}" if hosts - {platform.node(), ""} else ""


def _is_local(host: str) -> bool:
    """Whether a host is this one: a socket can be bound to its address."""
    if host in WILDCARDS:
        return True
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM)[0]
        with closing(socket.socket(family, kind, protocol)) as probe:
            probe.bind(address)
    except OSError:
        return False
    return True
