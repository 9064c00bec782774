"""Modbus/TCP Security: TLS with certificates on both sides, and what a client's role lets it do.

MODBUS/TCP Security Protocol Specification: TLS 1.2 or newer, mutual authentication, the role from the certificate;
a write that the role does not allow gets exception 01.
"""

import asyncio
import ssl
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from hilrig_runtime.config import TlsConfig
from hilrig_runtime.errors import InputError

if TYPE_CHECKING:
    from hilrig_modbus_edge.server import RigServer

Right = Literal["operator", "observer", "refuse"]

HANDSHAKE_TIMEOUT_S: Final = 5.0


class TlsPolicy:
    """The edge's side of every handshake of a lab.

    Raises `InputError` where a file can't be used; it names the file and its key in lab.toml.
    """

    def __init__(self, tls: TlsConfig) -> None:
        # An edge without TLS does not load what reads certificates.
        from hilrig_modbus_edge.certificates import role_of

        self._role_of = role_of
        self._no_role: Right = tls.no_role
        self.context = context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.verify_mode = ssl.CERT_REQUIRED
        _check_readable("certificate", tls.certificate)
        _check_readable("key", tls.key)
        _check_readable("authority", tls.authority)
        try:
            context.load_cert_chain(tls.certificate, tls.key)
        except (ssl.SSLError, OSError) as error:
            raise InputError(
                f"edge.tls: {tls.certificate} and {tls.key} are no certificate with its key (PEM): {error}"
            ) from error
        try:
            context.load_verify_locations(tls.authority)
        except (ssl.SSLError, OSError) as error:
            raise InputError(f"edge.tls.authority: {tls.authority} holds no certificates (PEM): {error}") from error

    def right_of(self, certificate_der: bytes) -> Right:
        """What a client with this certificate may do: write, read only, or nothing."""
        role = self._role_of(certificate_der)
        # A role that this lab does not know is none.
        return "operator" if role == "operator" else "observer" if role == "observer" else self._no_role


class TlsGate(asyncio.Protocol):
    """A connection before its handshake is done; then `RigServer` gets it."""

    _transport: asyncio.Transport

    def __init__(self, server: "RigServer", policy: TlsPolicy) -> None:
        self._server = server
        self._policy = policy
        self.host = ""
        self._early = bytearray()
        self._task: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.BaseProtocol`."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        peer = self._server.admit(transport)
        if peer is not None:
            self.host = peer[0]
            self._server.gates.add(self)
            self._task = asyncio.get_running_loop().create_task(self._shake_hands(*peer))

    def data_received(self, data: bytes) -> None:
        """Keep what comes right behind the handshake; see `asyncio.Protocol`."""
        self._early += data

    def close(self) -> None:
        """Give up."""
        if self._task is not None:
            self._task.cancel()
        self._transport.abort()

    async def _shake_hands(self, host: str, port: int) -> None:
        server, loop = self._server, asyncio.get_running_loop()
        try:
            secured = await loop.start_tls(
                self._transport,
                self,
                self._policy.context,
                server_side=True,
                ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S,
            )
        except (OSError, TimeoutError) as error:
            server.refuse(host, port, f"no TLS: {_reason(error)}")
            self._transport.abort()
            return
        finally:
            server.gates.discard(self)
        if secured is None or secured.is_closing():
            return
        certificate = secured.get_extra_info("ssl_object").getpeercert(binary_form=True)
        right = self._policy.right_of(certificate)
        if right == "refuse":
            server.refuse(host, port, "its certificate names no role")
            secured.abort()
            return
        server.take(secured, host, port, may_write=right == "operator", early=bytes(self._early))


def _reason(error: Exception) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not accepted: {error.verify_message}"
    if isinstance(error, ssl.SSLError):
        return (error.reason or str(error)).lower().replace("_", " ")
    return str(error) or "the handshake took too long"


def _check_readable(name: str, path: Path) -> None:
    try:
        path.read_bytes()
    except OSError as error:
        raise InputError(f"edge.tls.{name}: {path} can't be read: {error.strerror}; hilrig certs makes one") from error
