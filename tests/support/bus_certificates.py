"""Certificates for a secured bus in a test: good ones, and those that must not be let in."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

from hilrig_runtime.security.x509 import Credential, issue_client, issue_peer, make_authority

NOW = datetime.now(UTC)
HOSTS = ["127.0.0.1", "localhost"]


def write(folder: Path, name: str, identity: Credential) -> None:
    """`<name>.pem` and `<name>.key`."""
    (folder / f"{name}.pem").write_bytes(identity.certificate_pem)
    (folder / f"{name}.key").write_bytes(identity.key_pem)


def make_bus_folder(folder: Path, names: list[str], hosts: list[str] = HOSTS) -> Credential:
    """A folder for `[bus.tls]` with a certificate for each name; gives the authority."""
    folder.mkdir(parents=True)
    authority = make_authority("bus", NOW, 30)
    write(folder, "ca", authority)
    for name in names:
        write(folder, name, issue_peer(authority, name, hosts, NOW, 30))
    return authority


def folder_of_one(folder: Path, authority: Credential, name: str, identity: Credential) -> Path:
    """A folder of somebody who trusts `authority` and has one certificate, under the name `name`."""
    folder.mkdir(parents=True)
    (folder / "ca.pem").write_bytes(authority.certificate_pem)
    write(folder, name, identity)
    return folder


def bad_identities(authority: Credential) -> dict[str, Credential]:
    """Certificates called `operator` that nobody may be let in with, by what is wrong with them."""
    stranger = make_authority("stranger", NOW, 30)
    return {
        "another authority": issue_peer(stranger, "operator", HOSTS, NOW, 30),
        "expired": issue_peer(authority, "operator", HOSTS, NOW - timedelta(days=10), 9),
        "not valid yet": issue_peer(authority, "operator", HOSTS, NOW + timedelta(days=2), 9),
        "a controller's": issue_client(make_authority("controllers", NOW, 30), "operator", "operator", NOW, 30),
    }
