"""Certificates for tests of a secured bus: valid ones, and invalid ones that must be refused."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

from hilrig_runtime.security.x509 import Credential, issue_client, issue_peer, make_authority

NOW = datetime.now(UTC)
HOSTS = ["127.0.0.1", "localhost"]


def write(folder: Path, name: str, identity: Credential) -> None:
    """Write `<name>.pem` and `<name>.key`."""
    (folder / f"{name}.pem").write_bytes(identity.certificate_pem)
    (folder / f"{name}.key").write_bytes(identity.key_pem)


def make_bus_folder(folder: Path, names: list[str], hosts: list[str] = HOSTS) -> Credential:
    """Create a folder for `[bus.tls]` with a certificate for each name; returns the authority."""
    folder.mkdir(parents=True)
    authority = make_authority("bus", NOW, 30)
    write(folder, "ca", authority)
    for name in names:
        write(folder, name, issue_peer(authority, name, hosts, NOW, 30))
    return authority


def make_client_folder(folder: Path, authority: Credential, name: str, identity: Credential) -> Path:
    """Create a folder with the certificate of `authority`, and one credential stored under the name `name`."""
    folder.mkdir(parents=True)
    (folder / "ca.pem").write_bytes(authority.certificate_pem)
    write(folder, name, identity)
    return folder


def invalid_credentials(authority: Credential) -> dict[str, Credential]:
    """Invalid credentials with the name `operator`, by defect."""
    other_authority = make_authority("other", NOW, 30)
    return {
        "another authority": issue_peer(other_authority, "operator", HOSTS, NOW, 30),
        "expired": issue_peer(authority, "operator", HOSTS, NOW - timedelta(days=10), 9),
        "not valid yet": issue_peer(authority, "operator", HOSTS, NOW + timedelta(days=2), 9),
        "a controller's": issue_client(make_authority("controllers", NOW, 30), "operator", "operator", NOW, 30),
    }
