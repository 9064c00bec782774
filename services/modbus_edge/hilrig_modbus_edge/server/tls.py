"""Modbus/TCP Security: mutual TLS, and authorization by the role in the client's certificate.

MODBUS/TCP Security Protocol Specification: TLS 1.2 or newer, mutual authentication, role from the certificate; a write
that the role does not permit gets exception 01.
"""

import asyncio
import logging
import os
import re
import ssl
import stat
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Final, Literal, NamedTuple

from hilrig_modbus_edge.server.admission import Admission
from hilrig_runtime.config.edge_tls import TlsConfig
from hilrig_runtime.errors import InputError

Role = Literal["operator", "observer", "refuse"]
"""Permission of a client: write and read, read only, or no connection."""


class ClientCertificate(NamedTuple):
    """Properties of a client's certificate."""

    name: str
    """Common name."""
    may_write: bool
    """By its role."""
    expiry_ns: int
    """End of its validity, ns since 1970-01-01 UTC."""


Serve = Callable[[asyncio.Transport, str, int, ClientCertificate, bytes], None]
"""Serves a client: its transport, host and port, its certificate, and the data that it has already sent."""

HANDSHAKE_TIMEOUT_S: Final = 5.0
"""Timeout of the TLS handshake and of the TLS shutdown, s."""

logger = logging.getLogger(__name__)


class TlsPolicy:
    """TLS context of the edge, and the mapping of client certificates to roles.

    Raises `InputError` if a file cannot be used; the message has the file and its key in lab.toml.
    """

    def __init__(self, tls: TlsConfig) -> None:
        # Imported here: an edge without TLS does not load the certificate library.
        from hilrig_runtime.security.x509 import common_name_of, expiry_ns_of, role_of

        self._role_of = role_of
        self._name_of = common_name_of
        self._expiry_ns_of = expiry_ns_of
        self._no_role: Role = tls.no_role
        self.context = context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.verify_mode = ssl.CERT_REQUIRED
        # A renegotiation costs the edge more than the client that requests it.
        context.options |= ssl.OP_NO_RENEGOTIATION
        for name in ("certificate", "key", "authority"):
            _check_readable(name, getattr(tls, name))
        try:
            # Without a password callback, OpenSSL prompts at the terminal, and a service would wait forever.
            context.load_cert_chain(tls.certificate, tls.key, password=partial(_reject_encrypted, tls.key))
        except (ssl.SSLError, OSError) as error:
            raise InputError(
                f"edge.tls: certificate {tls.certificate} and key {tls.key} do not match or are not PEM files: {error}"
            ) from error
        _warn_if_exposed(tls.key)
        try:
            context.load_verify_locations(tls.authority)
        except (ssl.SSLError, OSError) as error:
            raise InputError(f"edge.tls.authority: {tls.authority} contains no PEM certificates: {error}") from error

    def examine(self, certificate_der: bytes) -> ClientCertificate | None:
        """Return the properties of a client's certificate; None: its role permits no connection."""
        role = self._role_of(certificate_der)
        # An unknown role counts as no role.
        permission = "operator" if role == "operator" else "observer" if role == "observer" else self._no_role
        if permission == "refuse":
            return None
        name, expiry_ns = self._name_of(certificate_der), self._expiry_ns_of(certificate_der)
        return ClientCertificate(name, permission == "operator", expiry_ns)


class TlsHandshake(asyncio.Protocol):
    """A connection during its TLS handshake; `serve` is called with the secured connection."""

    _transport: asyncio.Transport

    def __init__(self, admission: Admission, policy: TlsPolicy, serve: Serve) -> None:
        self._admission = admission
        self._policy = policy
        self._serve = serve
        self.peer = ("", 0)
        self._early = bytearray()
        self._task: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.BaseProtocol`."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        peer = self._admission.admit(transport, before_handshake=True)
        if peer is not None:
            self.peer = peer
            self._admission.begin_handshake(self)
            self._task = asyncio.get_running_loop().create_task(self._complete(*peer))

    def data_received(self, data: bytes) -> None:
        """Keep data that follows the handshake at once; see `asyncio.Protocol`."""
        self._early += data

    def close(self) -> None:
        """See `PendingHandshake.close`."""
        if self._task is not None:
            self._task.cancel()
        self._transport.abort()

    async def _complete(self, host: str, port: int) -> None:
        try:
            secured = await asyncio.get_running_loop().start_tls(
                self._transport,
                self,
                self._policy.context,
                server_side=True,
                ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S,
                ssl_shutdown_timeout=HANDSHAKE_TIMEOUT_S,
            )
            secret: ssl.SSLObject | None = None if secured is None else secured.get_extra_info("ssl_object")
            if secured is None or secret is None or secret.version() is None:
                # asyncio raises no exception if the peer disconnects during the handshake.
                raise ConnectionResetError
        except (OSError, TimeoutError) as error:
            self._admission.refuse(host, port, f"TLS handshake failed: {_reason(error)}")
            self._transport.abort()
            return
        finally:
            self._admission.pending_handshakes.discard(self)
        if secured.is_closing():
            return
        certificate = self._policy.examine(secret.getpeercert(binary_form=True) or b"")
        if certificate is None:
            self._admission.refuse(
                host,
                port,
                "its certificate has no role that may connect; use a certificate with the role operator or observer",
            )
            secured.abort()
        elif self._admission.admit(secured) is not None:
            self._serve(secured, host, port, certificate, bytes(self._early))


def _reason(error: Exception) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the client certificate was rejected: {error.verify_message}"
    if isinstance(error, ssl.SSLError):
        # Without a reason, the text of the library starts with a code and ends with a line of its source.
        return re.sub(r"^\[.*?] |\(_ssl.*$", "", error.reason or str(error)).strip().lower().replace("_", " ")
    if isinstance(error, ConnectionResetError | BrokenPipeError):
        return "the client closed the connection during the handshake"
    return str(error) or f"no completed handshake within {HANDSHAKE_TIMEOUT_S:g} s"


def _reject_encrypted(key: Path) -> str:
    raise InputError(
        f"edge.tls.key: {key} is encrypted, and a service cannot ask for the password; save it without a password: "
        f"openssl pkey -in {key} -out rig.key, then chmod 600 rig.key"
    )


@cache
def _warn_if_exposed(key: Path) -> None:
    """Log once that every user of this host can read the key."""
    if os.name == "posix" and key.stat().st_mode & stat.S_IROTH:
        logger.warning("edge.tls.key: every user of this host can read %s; run: chmod 600 %s", key, key)


def _check_readable(name: str, path: Path) -> None:
    try:
        path.read_bytes()
    except OSError as error:
        raise InputError(
            f"edge.tls.{name}: {path} can't be read: {error.strerror}; create it with hilrig certs"
        ) from error
