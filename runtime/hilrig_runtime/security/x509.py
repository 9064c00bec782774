"""X.509 certificates: the lab's authorities, and the certificates they issue for Modbus/TCP Security and the bus.

The Modbus specification puts a client's role into its certificate, as a UTF-8 string in the extension `ROLE_OID`.
Keys are on the elliptic curve P-256: they are small, and every TLS library supports them.
"""

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

ROLE_OID: Final = x509.ObjectIdentifier("1.3.6.1.4.1.50316.802.1")
_UTF8_STRING: Final = 0x0C
_CLIENT_AND_SERVER: Final = (ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH)
_CLOCK_SKEW: Final = timedelta(minutes=5)


@dataclass(frozen=True, slots=True)
class Credential:
    """A certificate with its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @property
    def certificate_pem(self) -> bytes:
        """The certificate, PEM."""
        return self.certificate.public_bytes(serialization.Encoding.PEM)

    @property
    def key_pem(self) -> bytes:
        """The private key, PEM, not encrypted."""
        return self.key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )


def load(certificate_pem: bytes, key_pem: bytes) -> Credential:
    """Load a certificate and its key.

    Raises:
        ValueError: not a certificate, or not an elliptic-curve key.
    """
    key = serialization.load_pem_private_key(key_pem, password=None)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ValueError("not an elliptic-curve key")
    return Credential(x509.load_pem_x509_certificate(certificate_pem), key)


def make_authority(name: str, now: datetime, days: int) -> Credential:
    """Create a self-signed authority that signs only end-entity certificates."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _name(name)
    builder = (
        _builder(subject, subject, key.public_key(), now, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(sign_certificates=True), critical=True)
    )
    return Credential(builder.sign(key, hashes.SHA256()), key)


def issue_server(authority: Credential, hosts: Sequence[str], now: datetime, days: int) -> Credential:
    """Issue a certificate for the edge; `hosts` are the names and addresses under which clients connect."""
    return _issue(authority, hosts[0], [ExtendedKeyUsageOID.SERVER_AUTH], _alternative_names(hosts), now, days)


def issue_peer(authority: Credential, name: str, hosts: Sequence[str], now: datetime, days: int) -> Credential:
    """Issue a certificate for both client and server use, as on the bus; access control uses its `name`."""
    return _issue(authority, name, _CLIENT_AND_SERVER, _alternative_names(hosts), now, days)


def issue_client(authority: Credential, name: str, role: str, now: datetime, days: int) -> Credential:
    """Issue a certificate for a controller; an empty role is omitted."""
    extension = x509.UnrecognizedExtension(ROLE_OID, _utf8_string(role)) if role else None
    return _issue(authority, name, [ExtendedKeyUsageOID.CLIENT_AUTH], extension, now, days)


def names_in(certificate: x509.Certificate) -> set[str]:
    """Return the names and addresses in a certificate; empty: not a server certificate."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    return {str(name.value) for name in names}


def common_name_of(certificate_der: bytes) -> str:
    """Return the common name of a certificate's subject; empty: it has none, or the certificate is not readable."""
    try:
        names = x509.load_der_x509_certificate(certificate_der).subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    except ValueError:
        return ""
    return str(names[0].value) if names else ""


def expiry_ns_of(certificate_der: bytes) -> int:
    """Return the end of a certificate's validity, ns since 1970-01-01 UTC; 0: the certificate is not readable."""
    try:
        end = x509.load_der_x509_certificate(certificate_der).not_valid_after_utc
    except ValueError:
        return 0
    return int(end.timestamp()) * 1_000_000_000


def role_of(certificate_der: bytes) -> str:
    """Return the role in a client's certificate; empty: no readable role, or more than one."""
    try:
        extensions = x509.load_der_x509_certificate(certificate_der).extensions
        value = extensions.get_extension_for_oid(ROLE_OID).value
    except (x509.ExtensionNotFound, x509.DuplicateExtension, ValueError):
        # The TLS library accepts certificates with unknown extensions without parsing them.
        return ""
    return _text_of(value.value) if isinstance(value, x509.UnrecognizedExtension) else ""


def _issue(
    authority: Credential,
    name: str,
    purposes: Sequence[x509.ObjectIdentifier],
    extension: x509.ExtensionType | None,
    now: datetime,
    days: int,
) -> Credential:
    key = ec.generate_private_key(ec.SECP256R1())
    issuer = authority.certificate
    builder = (
        _builder(_name(name), issuer.subject, key.public_key(), now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(sign_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()), critical=False)
    )
    if extension is not None:
        builder = builder.add_extension(extension, critical=False)
    return Credential(builder.sign(authority.key, hashes.SHA256()), key)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCK_SKEW)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _usage(*, sign_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not sign_certificates,
        key_cert_sign=sign_certificates,
        crl_sign=sign_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative_names(hosts: Sequence[str]) -> x509.SubjectAlternativeName:
    return x509.SubjectAlternativeName([_general_name(host) for host in hosts])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _utf8_string(text: str) -> bytes:
    data = text.encode()
    if len(data) > 127:
        raise ValueError(f"a role must have at most 127 bytes, got {len(data)}")
    return bytes((_UTF8_STRING, len(data))) + data


def _text_of(der: bytes) -> str:
    if len(der) < 2 or der[0] != _UTF8_STRING or der[1] != len(der) - 2 or der[1] > 127:
        return ""
    return der[2:].decode(errors="replace")
