"""HTTP server of the console: listening socket, uvicorn in a thread, and shutdown without waiting for browsers."""

import logging
import socket
import ssl
import threading
import urllib.request
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import uvicorn

from hilrig_console.app import Console
from hilrig_console.auth import HEALTH_PATH, AccessPolicy
from hilrig_console.catalog import RecordingCatalog
from hilrig_console.http_limits import MAX_CONNECTIONS, ConnectionTable, LimitedProtocol
from hilrig_console.subscriber import LabSubscriber
from hilrig_runtime.addresses import format_address
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.listen_address import ListenAddress
from hilrig_runtime.process.lifecycle import allow_open_files

SHUTDOWN_GRACE_S: Final = 1
"""Time limit for downloads to finish on shutdown, s."""
HEALTH_TIMEOUT_S: Final = 5.0
BACKLOG: Final = 128
"""Connections that the system queues until they are accepted."""
READ_TIMEOUT_MS: Final = 30_000
"""Time in which a client must read more of its response, ms."""


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
        self._socket = address.open_socket(BACKLOG)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            # The connections inherit it: a client that does not read its response is disconnected.
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, READ_TIMEOUT_MS)
        self.urls = address.urls(self._socket.getsockname()[1], "http" if tls is None else "https")
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
    scheme = "http" if tls is None else "https"
    url = f"{scheme}://{format_address(address.local_host, address.port)}"
    context = None
    if tls is not None:
        # The certificate is for a host name, not for a local address; the server is on this host.
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=context))
    try:
        with opener.open(url + HEALTH_PATH, timeout=HEALTH_TIMEOUT_S):
            return
    except OSError as error:
        cause = getattr(error, "reason", error)
        reason = getattr(cause, "strerror", None) or cause
        raise OperationError(f"no console answers at {url}/: {reason}; start it: hilrig console") from error
