"""`hilrig certs`: creates a lab's certificates for Modbus/TCP Security and for the bus."""

from pathlib import Path
from typing import Annotated

import typer

from hilrig_cli.options import AsJson, Config


def certs(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to write them to.")] = Path("certs"),
    config: Config = None,
    host: Annotated[
        list[str] | None,
        typer.Option(help="Host name or address of the edge or the router; may be repeated."),
    ] = None,
    client: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=ROLE]",
            help="A controller and its role: operator (reads and writes) or observer (reads only); may be repeated. "
            "Default: operator=operator and observer=observer.",
        ),
    ] = None,
    days: Annotated[
        int, typer.Option(min=1, max=36_500, help="Validity, days; the authorities are valid ten times as long.")
    ] = 365,
    revoke: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Instead of creating certificates: make all edges read lab.toml again, which must no longer list NAME "
            "in \\[edge.tls.clients], and close the connections of NAME.",
        ),
    ] = None,
    renew: Annotated[bool, typer.Option("--renew", help="Renew all certificates except the authorities.")] = False,
    as_json: AsJson = False,
) -> None:
    """Create the certificate authorities and certificates that secure a lab.

    The certificates of the edge and the controllers are for Modbus/TCP Security. Those in FOLDER/bus, signed by a
    separate authority, are for the services, the router and the commands. Existing certificates are kept until they
    are about to expire, except those named with --client. Authorities are always kept, so controllers can be added
    later. Keep the private keys of the authorities (ca.key) secret.

    To withdraw a controller's certificate, remove it from \\[edge.tls.clients] of lab.toml on all hosts of edges, then
    use --revoke.
    """
    from datetime import UTC, datetime

    from hilrig_cli.cert_store import CertificateStore
    from hilrig_cli.json_output.lab import CertsOutput, RevokeOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.revocation import revoke_client
    from hilrig_runtime.bus.acl import identities
    from hilrig_runtime.config.bus import BusTlsConfig
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.security.x509 import issue_client, issue_peer, issue_server

    lab = load_lab(config)
    if revoke is not None:
        results = revoke_client(lab, revoke)
        if as_json:
            print_json(RevokeOutput(revoked=revoke, edges=results))
        else:
            print("\n".join(results.values()))
        return
    now = datetime.now(UTC)
    clients = dict(_parse_client(text) for text in client or ["operator=operator", "observer=observer"])
    loopback = ["localhost", "127.0.0.1", "::1"]

    controllers = CertificateStore(folder, now, days, renew=renew)
    bus = CertificateStore(folder / "bus", now, days, renew=renew)
    authority = controllers.authority(f"hilrig {lab.name}: controllers")
    rig_hosts = [name for rig in lab.rigs for name in _reachable(lab.host_of(rig))]
    edge_names = list(dict.fromkeys([*(host or []), *rig_hosts, *loopback]))
    if controllers.is_due("edge", edge_names):
        controllers.write("edge", issue_server(authority, controllers.host_names("edge", edge_names), now, days))
    for name, role in clients.items():
        if client or controllers.is_due(name):
            controllers.write(name, issue_client(authority, name, role, now, days))

    authority = bus.authority(f"hilrig {lab.name}: bus")
    router_names = list(dict.fromkeys([*_reachable(lab.bus.router_host), *(host or []), *loopback]))
    service_names = list(dict.fromkeys([*_reachable(lab.bus.host), *loopback]))
    required = {identity.name: service_names for identity in identities(lab.bus.tls or BusTlsConfig())}
    for name, names in ({"router": router_names} | required).items():
        if bus.is_due(name, names):
            bus.write(name, issue_peer(authority, name, bus.host_names(name, names), now, days))

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
        print_json(CertsOutput.model_validate({"written": written, **tables}))
        return
    for path in written:
        print(f"wrote {path}")
    if not written:
        print("nothing to do: all certificates exist and are valid; --renew renews them")
    print("\nlab.toml:")
    for table, values in tables.items():
        print(f"[{table}]")
        for key, value in values.items():
            print(f'{key} = "{value}"')


def _reachable(host: str) -> list[str]:
    """The host in a list; empty for a wildcard address, which no peer can connect to."""
    from hilrig_runtime.addresses import WILDCARDS

    return [] if host in WILDCARDS else [host]


def _parse_client(text: str) -> tuple[str, str]:
    from hilrig_runtime.errors import InputError
    from hilrig_schemas.topics import is_name

    name, _, role = text.partition("=")
    if not is_name(name) or name in ("ca", "edge"):
        raise InputError(
            f"--client {text}: expected NAME or NAME=ROLE; NAME consists of letters, digits, - and _ and is not "
            "ca or edge"
        )
    if role not in ("", "operator", "observer"):
        raise InputError(f"--client {text}: expected the role operator or observer, got {role!r}")
    return name, role
