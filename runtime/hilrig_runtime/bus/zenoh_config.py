"""Builds zenoh's configuration from the lab's: listening and connecting endpoints, and certificates.

Scouting is off and endpoints are explicit, so that only configured peers communicate. In the mesh the first instance of
each service listens on its own port and connects to those before it in `MESH_ORDER`; tools connect to all of them.
Further instances listen on any free port and connect to these three, and the others find them by gossip: every
subscriber is linked to every publisher directly, without another program. With a router every process is its client,
without gossip, which would bypass the router's access control.
"""

import json
import socket
from pathlib import Path
from typing import Any, Final

import zenoh

from hilrig_runtime.addresses import format_address
from hilrig_runtime.bus.acl import TOOL_ROLES, access_control, identities
from hilrig_runtime.config.bus import BusConfig, BusTlsConfig
from hilrig_runtime.errors import InputError

MESH_ORDER: Final = ("sim", "edge", "recorder")
ROUTER: Final = "router"
FIRST_INSTANCE: Final = "1"
"""The instance that has a fixed port in the mesh."""
_COMMON: Final[dict[str, Any]] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    # Implicit shared memory can lose data, and a batch is larger than its threshold.
    "transport/shared_memory/enabled": False,
}
_CERTS_HINT: Final = "create certificates with hilrig certs on the host that has ca.key"


def mesh_endpoint(bus: BusConfig, service: str) -> str:
    """Return the endpoint on which a service listens in the mesh."""
    return f"{_protocol(bus)}/{format_address(bus.host, bus.first_port + MESH_ORDER.index(service))}"


def finds_others_by_gossip(bus: BusConfig, service: str, instance: str) -> bool:
    """Return whether an instance of `service` discovers some of its peers by gossip only."""
    return bus.topology == "mesh" and service in MESH_ORDER and instance != FIRST_INSTANCE


def zenoh_config(bus: BusConfig, service: str, instance: str = FIRST_INSTANCE) -> zenoh.Config:
    """Return the zenoh configuration of an instance of `service`: one of `MESH_ORDER`, or another name for a tool.

    Raises:
        InputError: a certificate of the service is missing.
    """
    listen: list[str] = []
    if bus.topology == "router":
        mode, connect = "client", [bus.router]
    else:
        mode = "peer"
        has_port = service in MESH_ORDER and instance == FIRST_INSTANCE
        earlier = MESH_ORDER.index(service) if has_port else len(MESH_ORDER)
        connect = [mesh_endpoint(bus, other) for other in MESH_ORDER[:earlier]]
        if service in MESH_ORDER:
            listen = [mesh_endpoint(bus, service) if has_port else f"{_protocol(bus)}/{format_address(bus.host, 0)}"]
    settings = _COMMON | {
        "mode": mode,
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "scouting/gossip/enabled": mode == "peer",
        # Opening a client without a reachable router fails after a timeout, so that the caller can report it and handle
        # signals between attempts. A peer opens at once and connects, and reconnects, when the others appear.
        "connect/timeout_ms": 500 if mode == "client" else -1,
        "connect/exit_on_failure": mode == "client",
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 400, "period_increase_factor": 1.5},
    }
    if bus.tls is not None:
        settings |= _tls_settings(bus.tls, own_identity(bus.tls, service, instance))
        if mode == "peer":
            settings["access_control"] = access_control(bus.tls)
    return _build(settings)


def router_config(bus: BusConfig, lab: str, listen: str) -> zenoh.Config:
    """Return the zenoh configuration of a lab's router that listens on the endpoint `listen`.

    Raises:
        InputError: a certificate of the router is missing.
    """
    settings = _COMMON | {"mode": "router", "listen/endpoints": [listen]}
    if bus.tls is not None:
        settings |= _tls_settings(bus.tls, ROUTER)
        settings["access_control"] = access_control(bus.tls, lab)
    return _build(settings)


def own_identity(tls: BusTlsConfig, service: str, instance: str = FIRST_INSTANCE) -> str:
    """Return the common name of the certificate that an instance of `service` uses.

    Of the names with its role: the name of the instance if it exists, else the first name whose key is on this host.

    Raises:
        InputError: no such key is on this host.
    """
    roles = (service,) if service in MESH_ORDER else TOOL_ROLES
    names = [identity.name for role in roles for identity in identities(tls) if identity.role == role]
    if service == ROUTER:
        names = [ROUTER]
    for name in sorted(names, key=lambda name: name != instance):
        if (tls.folder / f"{name}.key").exists():
            return name
    wanted = " or ".join(f"{name}.key" for name in names)
    raise InputError(f"bus.tls.folder: {tls.folder} does not contain {wanted}; {_CERTS_HINT}")


def _protocol(bus: BusConfig) -> str:
    return "tcp" if bus.tls is None else "tls"


def _tls_settings(tls: BusTlsConfig, name: str) -> dict[str, Any]:
    certificate, key = _file(tls, f"{name}.pem"), _file(tls, f"{name}.key")
    return {
        # No other protocol is accepted, whatever an endpoint specifies.
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": _file(tls, "ca.pem"),
            "enable_mtls": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def _file(tls: BusTlsConfig, name: str) -> str:
    path: Path = tls.folder / name
    try:
        path.read_bytes()
    except OSError as error:
        raise InputError(f"bus.tls.folder: {path} can't be read: {error.strerror}; {_CERTS_HINT}") from error
    return str(path)


def _build(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def unknown_host(host: str) -> str:
    """Return a host name if it can't be resolved; empty: it can."""
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError):
        return host
    return ""


def system_reason(error: Exception) -> str:
    """Return the operating system's reason in one of zenoh's errors.

    zenoh's text contains paths of its source files; the system's reason is before the error number.
    """
    return str(error).partition(" (os error")[0].rpartition(": ")[2].lstrip("[")
