"""Checks of certificates: presence, validity period, issuer, names and file permissions of the keys."""

import stat
import sys
from collections.abc import Generator, Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from hilrig_cli.doctor import CheckResult
from hilrig_runtime.bus.acl import identities
from hilrig_runtime.bus.zenoh_config import MESH_ORDER
from hilrig_runtime.config.bus import BusTlsConfig
from hilrig_runtime.config.edge_tls import TlsConfig
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.security.x509 import names_in

EXPIRY_WARNING_PERIOD: Final = timedelta(days=30)
_CHECK: Final = "certificates"
_RENEW_FIX: Final = (
    "run hilrig certs, which renews expiring certificates; copy them to the other hosts and restart the services"
)
_REISSUE_FIX: Final = "copy it again from the host where hilrig certs wrote it, or issue it there again"


def check_certificates(lab: LabConfig, now: datetime) -> Iterator[CheckResult]:
    """Check this host's certificates for the bus and for Modbus/TCP Security."""
    if lab.bus.tls is None and lab.edge.tls is None:
        yield CheckResult.ok(_CHECK, "not required: bus and Modbus without TLS")
    if lab.bus.tls is not None:
        yield from _check_bus(lab, lab.bus.tls, now)
    if lab.edge.tls is not None:
        yield from _check_edge(lab.edge.tls, now)


def _check_bus(lab: LabConfig, tls: BusTlsConfig, now: datetime) -> Iterator[CheckResult]:
    authority = _read(tls.folder / "ca.pem")
    if isinstance(authority, CheckResult):
        yield authority
        return
    yield from _check_dates(tls.folder / "ca.pem", authority, now)
    names = ["router", *(identity.name for identity in identities(tls))]
    present = [name for name in names if (tls.folder / f"{name}.pem").exists()]
    if not present:
        yield CheckResult.error(_CHECK, f"{tls.folder}: no certificate of {', '.join(names)} found", _REISSUE_FIX)
    for name in present:
        path = tls.folder / f"{name}.pem"
        certificate = yield from _check_pair(path, tls.folder / f"{name}.key", authority, now)
        if certificate is None:
            continue
        common = _common_name(certificate)
        if common != name:
            text = f"{path}: its common name is {common!r}, expected {name!r}; the bus uses the common name"
            yield CheckResult.error(_CHECK, text, _REISSUE_FIX)
        host = _address_of(lab, name)
        if host and host not in names_in(certificate):
            named = ", ".join(sorted(names_in(certificate))) or "no host"
            yield CheckResult.error(
                _CHECK,
                f"{path}: valid for {named}, but peers connect to {host}",
                f"hilrig certs --host {host}",
            )


def _check_edge(tls: TlsConfig, now: datetime) -> Iterator[CheckResult]:
    authority = _read(tls.authority)
    if isinstance(authority, CheckResult):
        yield authority
        return
    yield from _check_dates(tls.authority, authority, now)
    yield from _check_pair(tls.certificate, tls.key, authority, now)


def _check_pair(
    path: Path, key_path: Path, authority: x509.Certificate, now: datetime
) -> Generator[CheckResult, None, x509.Certificate | None]:
    """Check a certificate and its key; return the certificate, or None if it can't be read."""
    certificate = _read(path)
    if isinstance(certificate, CheckResult):
        yield certificate
        return None
    yield from _check_dates(path, certificate, now)
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        text = f"{path}: not signed by the configured authority, so peers will reject it"
        yield CheckResult.error(_CHECK, text, _REISSUE_FIX)
    yield from _check_key(key_path, certificate)
    return certificate


def _check_dates(path: Path, certificate: x509.Certificate, now: datetime) -> Iterator[CheckResult]:
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now < begins:
        text = f"{path}: not valid before {begins:%Y-%m-%d %H:%M} UTC"
        yield CheckResult.error(_CHECK, text, "set this host's clock")
    elif now >= ends:
        yield CheckResult.error(_CHECK, f"{path}: expired on {ends:%Y-%m-%d}", _RENEW_FIX)
    elif ends - now < EXPIRY_WARNING_PERIOD:
        text = f"{path}: expires on {ends:%Y-%m-%d}, in {(ends - now).days} days"
        yield CheckResult.warning(_CHECK, text, _RENEW_FIX)
    else:
        yield CheckResult.ok(_CHECK, f"{path}: valid until {ends:%Y-%m-%d}")


def _check_key(path: Path, certificate: x509.Certificate) -> Iterator[CheckResult]:
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        yield CheckResult.error(_CHECK, f"{path}: can't be read: {error.strerror}", _REISSUE_FIX)
        return
    except (ValueError, TypeError) as error:
        yield CheckResult.error(_CHECK, f"{path}: not a valid private key (PEM): {error}", _REISSUE_FIX)
        return
    if key.public_key() != certificate.public_key():
        yield CheckResult.error(_CHECK, f"{path}: does not match its certificate", _REISSUE_FIX)
    if sys.platform != "win32" and mode & 0o077:
        yield CheckResult.warning(_CHECK, f"{path}: readable by other users than its owner", f"chmod 600 {path}")


def _read(path: Path) -> "x509.Certificate | CheckResult":
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        return CheckResult.error(_CHECK, f"{path}: can't be read: {error.strerror}", _REISSUE_FIX)
    except ValueError as error:
        return CheckResult.error(_CHECK, f"{path}: not a valid certificate (PEM): {error}", _REISSUE_FIX)


def _common_name(certificate: x509.Certificate) -> str:
    names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _address_of(lab: LabConfig, name: str) -> str:
    """Host name or address by which peers connect to the owner of a certificate; empty: no peer connects to it."""
    if lab.bus.topology == "mesh":
        return lab.bus.host if name in MESH_ORDER and lab.bus.host not in ("0.0.0.0", "::") else ""
    return lab.bus.router_host if name == "router" else ""
