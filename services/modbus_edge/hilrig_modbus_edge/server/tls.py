"""Modbus/TCP Security: TLS with certificates on both sides, and what a client's role lets it do.

MODBUS/TCP Security Protocol Specification: TLS 1.2 or newer, mutual authentication, the role from the certificate;
a write that the role does not allow gets exception 01.
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
from typing import Final, Literal

from hilrig_modbus_edge.server.admission import Admission
from hilrig_runtime.config.lab import TlsConfig
from hilrig_runtime.errors import InputError

Right = Literal["operator", "observer", "refuse"]

Serve = Callable[[asyncio.Transport, str, int, bool, bytes], None]
"""Serve a controller: its transport, host and port, whether it may write, and what it has sent already."""

HANDSHAKE_TIMEOUT_S: Final = 5.0
"""How long a client may take to begin TLS, and to end it."""

_HUNG_UP: Final = "it closed the connection before it was secured"

logger = logging.getLogger(__name__)


class TlsPolicy:
    """The edge's side of every handshake of a lab.

    Raises `InputError` where a file can't be used; it names the file and its key in lab.toml.
    """

    def __init__(self, tls: TlsConfig) -> None:
        # An edge without TLS does not load what reads certificates.
        from hilrig_runtime.security.x509 import role_of

        self._role_of = role_of
        self._no_role: Right = tls.no_role
        self.context = context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.verify_mode = ssl.CERT_REQUIRED
        # A new handshake costs the edge more than who asks for it.
        context.options |= ssl.OP_NO_RENEGOTIATION
        _check_readable("certificate", tls.certificate)
        _check_readable("key", tls.key)
        _check_readable("authority", tls.authority)
        try:
            # Not told what to do, the library asks for a password at the terminal, and a service waits for ever.
            context.load_cert_chain(tls.certificate, tls.key, password=partial(_has_no_password, tls.key))
        except (ssl.SSLError, OSError) as error:
            raise InputError(
                f"edge.tls: {tls.certificate} and {tls.key} are no certificate with its key (PEM): {error}"
            ) from error
        _warn_if_exposed(tls.key)
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
    """A connection before its handshake is done; `serve` gets it afterwards, with what it may do and sent already."""

    _transport: asyncio.Transport

    def __init__(self, admission: Admission, policy: TlsPolicy, serve: Serve) -> None:
        self._admission = admission
        self._policy = policy
        self._serve = serve
        self.host = ""
        self._early = bytearray()
        self._task: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.BaseProtocol`."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        peer = self._admission.admit(transport)
        if peer is not None:
            self.host = peer[0]
            self._admission.gates.add(self)
            self._task = asyncio.get_running_loop().create_task(self._pass(*peer))

    def data_received(self, data: bytes) -> None:
        """Keep what comes right behind the handshake; see `asyncio.Protocol`."""
        self._early += data

    def close(self) -> None:
        """See `Gate.close`."""
        if self._task is not None:
            self._task.cancel()
        self._transport.abort()

    async def _pass(self, host: str, port: int) -> None:
        try:
            secured = await self._shake_hands()
        except (OSError, TimeoutError) as error:
            self._admission.refuse(host, port, f"no TLS: {_reason(error)}")
            self._transport.abort()
            return
        finally:
            self._admission.gates.discard(self)
        secret: ssl.SSLObject | None = None if secured is None else secured.get_extra_info("ssl_object")
        if secured is None or secret is None or secret.version() is None:
            # asyncio raises nothing where a peer hangs up in the middle.
            self._admission.refuse(host, port, f"no TLS: {_HUNG_UP}")
            self._transport.abort()
            return
        if secured.is_closing():
            return
        right = self._policy.right_of(secret.getpeercert(binary_form=True) or b"")
        if right == "refuse":
            self._admission.refuse(host, port, "its certificate names no role that this lab knows")
            secured.abort()
            return
        self._serve(secured, host, port, right == "operator", bytes(self._early))

    async def _shake_hands(self) -> asyncio.Transport | None:
        loop, context = asyncio.get_running_loop(), self._policy.context
        return await loop.start_tls(
            self._transport,
            self,
            context,
            server_side=True,
            ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S,
            ssl_shutdown_timeout=HANDSHAKE_TIMEOUT_S,
        )


def _reason(error: Exception) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not accepted: {error.verify_message}"
    if isinstance(error, ssl.SSLError):
        # Where the library has no reason, its text has a code in front and a line of its own source behind.
        return re.sub(r"^\[.*?] |\(_ssl.*$", "", error.reason or str(error)).strip().lower().replace("_", " ")
    if isinstance(error, ConnectionResetError | BrokenPipeError):
        return _HUNG_UP
    return str(error) or "the handshake took too long"


def _has_no_password(key: Path) -> str:
    raise InputError(
        f"edge.tls.key: {key} is encrypted, and there is nobody to ask for its password; write it without one: "
        f"openssl pkey -in {key} -out rig.key, then chmod 600 rig.key"
    )


@cache
def _warn_if_exposed(key: Path) -> None:
    """Say, once, that whoever has an account here can read a key."""
    if os.name == "posix" and key.stat().st_mode & stat.S_IROTH:
        logger.warning("edge.tls.key: everybody on this machine can read %s; chmod 600 %s", key, key)


def _check_readable(name: str, path: Path) -> None:
    try:
        path.read_bytes()
    except OSError as error:
        raise InputError(f"edge.tls.{name}: {path} can't be read: {error.strerror}; hilrig certs makes one") from error
