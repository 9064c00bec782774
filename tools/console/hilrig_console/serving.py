"""The console's server: a socket, uvicorn on a thread of its own, and an end that waits for no browser."""

import logging
import socket
import ssl
import threading
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import uvicorn

from hilrig_console.app import Console
from hilrig_console.auth import HEALTH_PATH, AccessPolicy, is_loopback
from hilrig_console.catalog import RecordingCatalog
from hilrig_console.subscriber import LabSubscriber
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError, OperationError

CLOSE_S: Final = 1
"""Downloads have so long to end when the console does."""
HEALTH_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server listens."""

    host: str
    """Empty: every address of this host."""
    port: int

    @classmethod
    def of(cls, text: str) -> "Address":
        """Read "HOST:PORT", "[ADDRESS]:PORT" or ":PORT".

        Raises:
            InputError: it is none of them.
        """
        host, colon, port = text.rpartition(":")
        if not colon or not port.isascii() or not port.isdigit() or int(port) > 65535:
            raise InputError(f"--listen {text!r}: expected HOST:PORT, for example 127.0.0.1:8050")
        return cls(host.removeprefix("[").removesuffix("]"), int(port))

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine reaches it."""
        return is_loopback(self.host)

    def listening(self) -> socket.socket:
        """A socket that listens there.

        Raises:
            OperationError: the address can't be had.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            return socket.create_server((self.host, self.port), family=family, backlog=128)
        except OSError as error:
            where = f"{self.host or '0.0.0.0'}:{self.port}"
            # Python adds the address to the system's words.
            reason = (error.strerror or str(error)).partition(" (while")[0]
            raise OperationError(f"can't listen on {where}: {reason}; choose another address with --listen") from error

    def url(self, port: int, scheme: str) -> str:
        """What to open in a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host or "0.0.0.0"
        return f"{scheme}://{host}:{port}/"


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """A server's certificate, with those between it and its authority, and its key; PEM."""

    certificate: Path
    key: Path

    def check(self) -> None:
        """See whether they can be used.

        Raises:
            InputError: they can't.
        """
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self.certificate, self.key)
        except (ssl.SSLError, OSError) as error:
            raise InputError(f"--certificate and --key are no certificate with its key (PEM): {error}") from error


class ConsoleServer:
    """Serves a lab's console until it is closed; a context manager.

    Raises:
        InputError: certificate or key can't be used.
        OperationError: the address can't be had.
    """

    def __init__(self, lab: LabConfig, address: Address, policy: AccessPolicy, tls: TlsFiles | None = None) -> None:
        if tls is not None:
            tls.check()
        self._socket = address.listening()
        self.url = address.url(self._socket.getsockname()[1], "http" if tls is None else "https")
        self._subscriber = LabSubscriber(lab)
        self._catalog = RecordingCatalog(lab.recorder.folder)
        self._console = Console(self._subscriber, self._catalog, policy)
        config = uvicorn.Config(
            self._console.app,
            log_config=None,
            access_log=False,
            server_header=False,
            ws="none",
            timeout_graceful_shutdown=CLOSE_S,
            ssl_certfile=None if tls is None else tls.certificate,
            ssl_keyfile=None if tls is None else tls.key,
        )
        # What uvicorn has to say beyond this is of connections that broke off.
        logging.getLogger("uvicorn").setLevel(logging.CRITICAL)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._serve, name="console", daemon=True)

    def _serve(self) -> None:
        self._server.run(sockets=[self._socket])

    def __enter__(self) -> "ConsoleServer":
        self._subscriber.__enter__()
        self._catalog.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.broadcast is not None:
            self._console.broadcast.close()
        self._server.should_exit = True
        self._catalog.__exit__()
        self._subscriber.__exit__()
        self._thread.join(timeout=5.0)
        self._socket.close()


def check_health(address: Address, tls: TlsFiles | None) -> None:
    """Ask whether a console answers at an address of this host.

    Raises:
        OperationError: it does not.
    """
    host = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}.get(address.host, address.host)
    where = Address(host, address.port).url(address.port, "http" if tls is None else "https")
    context = None
    if tls is not None:
        # Its name is none of this host's addresses; who answers is on this host.
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=context))
    try:
        with opener.open(f"{where.rstrip('/')}{HEALTH_PATH}", timeout=HEALTH_S):
            return
    except OSError as error:
        raise OperationError(f"no console answers at {where}: {getattr(error, 'reason', error)}") from error
