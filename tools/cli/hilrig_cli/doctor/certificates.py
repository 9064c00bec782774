"""Are the certificates there, in time, of one authority, for whom they are meant, and their keys out of sight?"""

import stat
import sys
from collections.abc import Generator, Iterator
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from hilrig_cli.doctor import Finding, good, notice, wrong
from hilrig_runtime.bus.acl import identities
from hilrig_runtime.bus.zenoh_config import MESH_ORDER
from hilrig_runtime.config.bus import BusTlsConfig
from hilrig_runtime.config.lab import LabConfig, TlsConfig
from hilrig_runtime.security.x509 import names_in

SOON = timedelta(days=30)
_RENEW = (
    "hilrig certs makes those anew that are about to end; give them to the other hosts, and start the services again"
)
_AGAIN = "take it from where hilrig certs wrote it, or make it there anew"


def check_certificates(lab: LabConfig, now: datetime) -> Iterator[Finding]:
    """Those that this host has for the bus and for Modbus/TCP Security."""
    if lab.bus.tls is None and lab.edge.tls is None:
        yield good("certificates", "none are asked for: bus and Modbus without TLS")
    if lab.bus.tls is not None:
        yield from _check_bus(lab, lab.bus.tls, now)
    if lab.edge.tls is not None:
        yield from _check_edge(lab.edge.tls, now)


def _check_bus(lab: LabConfig, tls: BusTlsConfig, now: datetime) -> Iterator[Finding]:
    authority = _read(tls.folder / "ca.pem")
    if isinstance(authority, Finding):
        yield authority
        return
    yield from _check_dates(tls.folder / "ca.pem", authority, now)
    names = ["router", *(identity.name for identity in identities(tls))]
    present = [name for name in names if (tls.folder / f"{name}.pem").exists()]
    if not present:
        yield wrong("certificates", f"{tls.folder} holds none of {', '.join(names)}", _AGAIN)
    for name in present:
        path = tls.folder / f"{name}.pem"
        certificate = yield from _check_pair(path, tls.folder / f"{name}.key", authority, now)
        if certificate is None:
            continue
        common = _common_name(certificate)
        if common != name:
            yield wrong("certificates", f"{path} belongs to {common!r}, so the bus takes it for that", _AGAIN)
        host = _address_of(lab, name)
        if host and host not in names_in(certificate):
            named = ", ".join(sorted(names_in(certificate))) or "no host"
            yield wrong(
                "certificates",
                f"{path} is good for {named}, but others reach it as {host}",
                f"hilrig certs --host {host}",
            )


def _check_edge(tls: TlsConfig, now: datetime) -> Iterator[Finding]:
    authority = _read(tls.authority)
    if isinstance(authority, Finding):
        yield authority
        return
    yield from _check_dates(tls.authority, authority, now)
    yield from _check_pair(tls.certificate, tls.key, authority, now)


def _check_pair(
    path: Path, key_path: Path, authority: x509.Certificate, now: datetime
) -> Generator[Finding, None, x509.Certificate | None]:
    """Look at a certificate with its key; it is the result, if it can be read."""
    certificate = _read(path)
    if isinstance(certificate, Finding):
        yield certificate
        return None
    yield from _check_dates(path, certificate, now)
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        yield wrong("certificates", f"{path} is not signed by the authority beside it: nobody will believe it", _AGAIN)
    yield from _check_key(key_path, certificate)
    return certificate


def _check_dates(path: Path, certificate: x509.Certificate, now: datetime) -> Iterator[Finding]:
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now < begins:
        yield wrong("certificates", f"{path} is valid from {begins:%Y-%m-%d %H:%M} on", "set this host's clock")
    elif now >= ends:
        yield wrong("certificates", f"{path} ended on {ends:%Y-%m-%d}", _RENEW)
    elif ends - now < SOON:
        yield notice("certificates", f"{path} ends on {ends:%Y-%m-%d}, in {(ends - now).days} days", _RENEW)
    else:
        yield good("certificates", f"{path} is valid until {ends:%Y-%m-%d}")


def _check_key(path: Path, certificate: x509.Certificate) -> Iterator[Finding]:
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        yield wrong("certificates", f"{path} can't be read: {error.strerror}", _AGAIN)
        return
    except (ValueError, TypeError) as error:
        yield wrong("certificates", f"{path} is no private key (PEM): {error}", _AGAIN)
        return
    if key.public_key() != certificate.public_key():
        yield wrong("certificates", f"{path} is the key of another certificate", _AGAIN)
    if sys.platform != "win32" and mode & 0o077:
        yield notice("certificates", f"{path} can be read by others than its owner", f"chmod 600 {path}")


def _read(path: Path) -> "x509.Certificate | Finding":
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        return wrong("certificates", f"{path} can't be read: {error.strerror}", _AGAIN)
    except ValueError as error:
        return wrong("certificates", f"{path} is no certificate (PEM): {error}", _AGAIN)


def _common_name(certificate: x509.Certificate) -> str:
    names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _address_of(lab: LabConfig, name: str) -> str:
    """By which host name or address others reach who has a certificate; empty: nobody connects to it."""
    if lab.bus.topology == "mesh":
        return lab.bus.host if name in MESH_ORDER and lab.bus.host not in ("0.0.0.0", "::") else ""
    return lab.bus.router.partition("/")[2].rpartition(":")[0].strip("[]") if name == "router" else ""
