"""`hilrig certs`: a lab's certificates, for Modbus/TCP Security and for the bus."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilrig_cli.options import AsJson, Config

if TYPE_CHECKING:
    from hilrig_runtime.config.lab import LabConfig


def certs(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where they are written.")] = Path("certs"),
    config: Config = None,
    host: Annotated[
        list[str] | None,
        typer.Option(help="Name or address by which others reach the edge or the router; may be given again."),
    ] = None,
    client: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=ROLE]",
            help="A controller and its role, operator (writes) or observer (reads); may be given again. "
            "Default: operator=operator and observer=observer.",
        ),
    ] = None,
    days: Annotated[
        int, typer.Option(min=1, max=36_500, help="How long they are valid; an authority ten times as long.")
    ] = 365,
    renew: Annotated[bool, typer.Option("--renew", help="Make those anew too that are still good.")] = False,
    as_json: AsJson = False,
) -> None:
    """Make what a lab needs to let in nobody else: authorities, and a certificate for everyone.

    The edge's and the controllers' are for Modbus/TCP Security; those in FOLDER/bus, signed by an authority of their
    own, are for the services, the router and the commands. What is there already and good for long enough is kept, an
    authority always, so controllers can be added. Keep the keys of the authorities, ca.key, to yourself.
    """
    from datetime import UTC, datetime

    from hilrig_cli.cert_store import CertificateFolder
    from hilrig_runtime.bus.acl import identities
    from hilrig_runtime.config.bus import BusTlsConfig
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.security.x509 import issue_client, issue_peer, issue_server

    lab = load_lab(config)
    now = datetime.now(UTC)
    clients = dict(_name_and_role(text) for text in client or ["operator=operator", "observer=observer"])
    here = ["localhost", "127.0.0.1"]

    controllers = CertificateFolder(folder, now, days, renew=renew)
    bus = CertificateFolder(folder / "bus", now, days, renew=renew)
    authority = controllers.authority(f"hilrig {lab.name}: controllers")
    edge_names = _distinct([*(host or []), *_reachable(lab.edge.host), *here])
    if controllers.is_due("edge", edge_names):
        controllers.write("edge", issue_server(authority, controllers.names_for("edge", edge_names), now, days))
    for name, role in clients.items():
        if client or controllers.is_due(name):
            controllers.write(name, issue_client(authority, name, role, now, days))

    authority = bus.authority(f"hilrig {lab.name}: bus")
    router_names = _distinct([*_router_host(lab), *(host or []), *here])
    service_names = _distinct([*_reachable(lab.bus.host), *here])
    wanted = {identity.name: service_names for identity in identities(lab.bus.tls or BusTlsConfig())}
    for name, names in ({"router": router_names} | wanted).items():
        if bus.is_due(name, names):
            bus.write(name, issue_peer(authority, name, bus.names_for(name, names), now, days))

    tables = {
        "edge.tls": {
            "certificate": str(folder / "edge.pem"),
            "key": str(folder / "edge.key"),
            "authority": str(folder / "ca.pem"),
        },
        "bus.tls": {"folder": str(folder / "bus")},
    }
    written = [str(path) for path in (*controllers.written, *bus.written)]
    if as_json:
        print(json.dumps({"written": written, **tables}))
        return
    for path in written:
        print(f"wrote {path}")
    if not written:
        print("all there, and good for long enough; --renew makes them anew")
    print("\nin lab.toml:")
    for table, values in tables.items():
        print(f"[{table}]")
        for key, value in values.items():
            print(f'{key} = "{value}"')


def _router_host(lab: "LabConfig") -> list[str]:
    address = lab.bus.router.partition("/")[2].partition("?")[0]
    return _reachable(address.rpartition(":")[0].strip("[]"))


def _reachable(host: str) -> list[str]:
    """The host as a name that others can use; none where it stands for every address."""
    return [] if host in ("", "0.0.0.0", "::") else [host]


def _distinct(names: list[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _name_and_role(text: str) -> tuple[str, str]:
    from hilrig_runtime.errors import InputError
    from hilrig_schemas.topics import is_name

    name, _, role = text.partition("=")
    if not is_name(name) or name in ("ca", "edge"):
        raise InputError(f"--client {text}: expected NAME or NAME=ROLE, the name of letters, digits, - and _")
    if role not in ("", "operator", "observer"):
        raise InputError(f"--client {text}: a role is operator or observer, found {role!r}")
    return name, role
