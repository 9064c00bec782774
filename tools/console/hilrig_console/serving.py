"""HTTP server of the console: listening socket, uvicorn in a thread, and shutdown without waiting for browsers."""

import logging
import socket
import ssl
import threading
import urllib.request
from dataclasses import dataclass
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import Final

import uvicorn

from hilrig_console.app import Console
from hilrig_console.auth import HEALTH_PATH, AccessPolicy
from hilrig_console.catalog import RecordingCatalog
from hilrig_console.http_limits import MAX_CONNECTIONS, ConnectionTable, LimitedProtocol
from hilrig_console.subscriber import LabSubscriber
from hilrig_runtime.addresses import listen_reason
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.lifecycle import allow_open_files

SHUTDOWN_GRACE_S: Final = 1
"""Time limit for downloads to finish on shutdown, s."""
HEALTH_TIMEOUT_S: Final = 5.0
BACKLOG: Final = 128
"""Connections that the system queues until they are accepted."""
READ_TIMEOUT_MS: Final = 30_000
"""Time in which a client must read more of its response, ms."""


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """Address and port on which a server listens."""

    host: str
    """Empty: all addresses of this host."""
    port: int

    @classmethod
    def parse(cls, text: str) -> "ListenAddress":
        """Parse "HOST:PORT", "[ADDRESS]:PORT" or ":PORT".

        Raises:
            InputError: the text has none of these forms.
        """
        host, colon, port = text.rpartition(":")
        if not colon or not port.isascii() or not port.isdigit() or int(port) > 65535:
            raise InputError(f"--listen {text!r}: expected HOST:PORT, for example 127.0.0.1:8050")
        return cls(host.removeprefix("[").removesuffix("]"), int(port))

    @property
    def is_loopback(self) -> bool:
        """Whether the address is reachable from this host only."""
        try:
            return ip_address(self.host.partition("%")[0]).is_loopback
        except ValueError:
            return self.host == "localhost"

    def open_socket(self) -> socket.socket:
        """Open a listening socket.

        Raises:
            OperationError: the address is unavailable.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            listening = socket.create_server((self.host, self.port), family=family, backlog=BACKLOG)
        except OSError as error:
            where = f"{self.host or '0.0.0.0'}:{self.port}"
            raise OperationError(
                f"can't listen on {where}: {listen_reason(error)}; choose another address with --listen"
            ) from error
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            # The connections inherit it: a client that does not read its response is disconnected.
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, READ_TIMEOUT_MS)
        return listening

    def url(self, port: int, scheme: str) -> str:
        """Return the URL to open in a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host or "0.0.0.0"
        return f"{scheme}://{host}:{port}/"


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """PEM files of a server: certificate with its intermediate certificates, and private key."""

    certificate: Path
    key: Path

    def context(self) -> ssl.SSLContext:
        """Return the TLS context of the server.

        Raises:
            InputError: the files can't be loaded or do not match.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        # A renegotiation costs the server more than the client that requests it.
        context.options |= ssl.OP_NO_RENEGOTIATION
        try:
            context.load_cert_chain(self.certificate, self.key)
        except (ssl.SSLError, OSError) as error:
            raise InputError(f"--certificate, --key: not a certificate with its private key (PEM): {error}") from error
        return context


class ConsoleServer:
    """HTTP server of a lab's console; a context manager.

    Raises:
        InputError: certificate or key is invalid.
        OperationError: the address is unavailable.
    """

    def __init__(
        self, lab: LabConfig, address: ListenAddress, policy: AccessPolicy, tls: TlsFiles | None = None
    ) -> None:
        context = None if tls is None else tls.context()
        # Half of the files are left for everything else.
        table = ConnectionTable(min(MAX_CONNECTIONS, allow_open_files() // 2))
        self._socket = address.open_socket()
        self.url = address.url(self._socket.getsockname()[1], "http" if tls is None else "https")
        self._subscriber = LabSubscriber(lab)
        self._catalog = RecordingCatalog(lab.recorder.folder)
        self._console = Console(self._subscriber, self._catalog, policy)
        config = uvicorn.Config(
            self._console.app,
            http=partial(LimitedProtocol, table, context),  # type: ignore[arg-type]  # called like the class
            backlog=BACKLOG,
            log_config=None,
            access_log=False,
            server_header=False,
            ws="none",
            timeout_graceful_shutdown=SHUTDOWN_GRACE_S,
        )
        # Lower levels only log aborted connections.
        logging.getLogger("uvicorn").setLevel(logging.CRITICAL)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="console", daemon=True
        )

    def __enter__(self) -> "ConsoleServer":
        self._subscriber.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._console.broadcast.close()
        self._server.should_exit = True
        self._catalog.close()
        self._subscriber.__exit__()
        self._thread.join(timeout=5.0)
        self._socket.close()


def check_health(address: ListenAddress, tls: TlsFiles | None) -> None:
    """Check that a console answers at an address of this host.

    Raises:
        OperationError: no console answers.
    """
    host = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}.get(address.host, address.host)
    url = ListenAddress(host, address.port).url(address.port, "http" if tls is None else "https")
    context = None
    if tls is not None:
        # The certificate is for a host name, not for a local address; the server is on this host.
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=context))
    try:
        with opener.open(f"{url.rstrip('/')}{HEALTH_PATH}", timeout=HEALTH_TIMEOUT_S):
            return
    except OSError as error:
        raise OperationError(f"no console answers at {url}: {getattr(error, 'reason', error)}") from error
