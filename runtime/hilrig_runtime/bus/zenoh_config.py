"""zenoh's configuration out of a lab's: who listens, who connects, with which certificate.

Scouting is off and endpoints explicit, so that who talks to whom is what the configuration says. In the mesh the first
instance of each service listens on a port of its own and connects to those before it in `MESH_ORDER`, tools to all of
them. Further instances listen where the system lets them and connect to those three, through whose gossip the others
find them: every reader is linked to every writer, with no hop between and no other program needed. With a router
everyone is its client, and there is no gossip, for it would lead past the router's access control.
"""

import json
import socket
from pathlib import Path
from typing import Any, Final

import zenoh

from hilrig_runtime.bus.acl import TOOL_ROLES, access_control, identities
from hilrig_runtime.config.bus import BusConfig, BusTlsConfig
from hilrig_runtime.errors import InputError

MESH_ORDER: Final = ("sim", "edge", "recorder")
ROUTER: Final = "router"
FIRST_INSTANCE: Final = "1"
"""The instance that has a port of its own in the mesh."""
_WHERE_MADE: Final = "hilrig certs makes certificates, on the host that has ca.key"


def mesh_endpoint(bus: BusConfig, service: str) -> str:
    """Where a service listens for the others in the mesh."""
    return f"{_protocol(bus)}/{bus.host}:{bus.first_port + MESH_ORDER.index(service)}"


def finds_others_by_gossip(bus: BusConfig, service: str, instance: str) -> bool:
    """Whether an instance of `service` is linked with some of its neighbours only when others have told of them."""
    return bus.topology == "mesh" and service in MESH_ORDER and instance != FIRST_INSTANCE


def zenoh_config(bus: BusConfig, service: str, instance: str = FIRST_INSTANCE) -> zenoh.Config:
    """The zenoh configuration of an instance of `service`: one of `MESH_ORDER`, or any other name for a tool.

    Raises:
        InputError: a certificate that the service needs is not there.
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
            listen = [mesh_endpoint(bus, service) if has_port else f"{_protocol(bus)}/{bus.host}:0"]
    settings: dict[str, Any] = _common() | {
        "mode": mode,
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "scouting/gossip/enabled": mode == "peer",
        # A client without its router fails after a while, so that whoever opens it can say so, and hear signals
        # between tries; a peer opens at once and connects whenever the others come up, also for the second time.
        "connect/timeout_ms": 500 if mode == "client" else -1,
        "connect/exit_on_failure": mode == "client",
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 400, "period_increase_factor": 1.5},
    }
    if bus.tls is not None:
        settings |= _secured(bus.tls, own_identity(bus.tls, service, instance))
        if mode == "peer":
            settings["access_control"] = access_control(bus.tls)
    return _made(settings)


def router_config(bus: BusConfig, lab: str, listen: str) -> zenoh.Config:
    """The zenoh configuration of a lab's router that listens at the endpoint `listen`.

    Raises:
        InputError: a certificate that it needs is not there.
    """
    settings = _common() | {"mode": "router", "listen/endpoints": [listen]}
    if bus.tls is not None:
        settings |= _secured(bus.tls, ROUTER)
        settings["access_control"] = access_control(bus.tls, lab)
    return _made(settings)


def own_identity(tls: BusTlsConfig, service: str, instance: str = FIRST_INSTANCE) -> str:
    """Whose certificate an instance of `service` takes.

    Of the names that its role has: the one that the instance is called, else the first whose key is on this host.

    Raises:
        InputError: there is none.
    """
    roles = (service,) if service in MESH_ORDER else TOOL_ROLES
    names = [identity.name for role in roles for identity in identities(tls) if identity.role == role]
    if service == ROUTER:
        names = [ROUTER]
    for name in sorted(names, key=lambda name: name != instance):
        if (tls.folder / f"{name}.key").exists():
            return name
    wanted = " or ".join(f"{name}.key" for name in names)
    raise InputError(f"bus.tls.folder: {tls.folder} holds no {wanted}; {_WHERE_MADE}")


def _protocol(bus: BusConfig) -> str:
    return "tcp" if bus.tls is None else "tls"


def _common() -> dict[str, Any]:
    return {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        # Implicit shared memory can lose data, and a batch is larger than its threshold.
        "transport/shared_memory/enabled": False,
    }


def _secured(tls: BusTlsConfig, name: str) -> dict[str, Any]:
    certificate, key = _file(tls, f"{name}.pem"), _file(tls, f"{name}.key")
    return {
        # Nothing else is spoken, whatever an endpoint says.
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
        raise InputError(f"bus.tls.folder: {path} can't be read: {error.strerror}; {_WHERE_MADE}") from error
    return str(path)


def _made(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def unknown_host(endpoint: str) -> str:
    """The host of an endpoint ("tcp/host:port"), if this machine can't tell its address; empty: it can."""
    host = endpoint.partition("/")[2].partition("?")[0].rpartition(":")[0].strip("[]")
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError):
        return host
    return ""


def system_reason(error: Exception) -> str:
    """Why the system refused what zenoh asked of it, in its own words.

    zenoh's text holds paths of its own sources; the system's reason stands before its error number.
    """
    return str(error).partition(" (os error")[0].rpartition(": ")[2].lstrip("[")
