"""HTTP server of the metrics: one response to each connection, within limits of time and number.

A connection that is not served within its time is closed. Beyond the limits of connections the oldest one is closed, so
that a scrape is always answered, however many others wait.
"""

import logging
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from hilrig_monitoring.prometheus import CONTENT_TYPE
from hilrig_runtime.listen_address import ListenAddress
from hilrig_runtime.pending_connections import PendingConnections

REQUEST_TIMEOUT_S: Final = 10.0
"""Time in which a request must be received and its response read."""
BACKLOG: Final = 128
"""Connections that the system queues until they are accepted."""
MAX_CONNECTIONS: Final = 64
MAX_CONNECTIONS_PER_HOST: Final = 16
POLL_S: Final = 0.25
"""Interval at which the times of the connections are checked, s."""

logger = logging.getLogger(__name__)


class MetricsServer(ThreadingHTTPServer):
    """Server that answers GET /metrics with the result of `text`; a context manager.

    Raises:
        OperationError: the address is unavailable.
    """

    daemon_threads = True

    def __init__(self, address: ListenAddress, text: Callable[[], str]) -> None:
        self._lock = threading.Lock()
        self._open: PendingConnections[socket.socket] = PendingConnections(MAX_CONNECTIONS, MAX_CONNECTIONS_PER_HOST)
        self._deadlines_s: dict[socket.socket, float] = {}
        super().__init__(("", 0), _handler(text), bind_and_activate=False)
        self.socket.close()
        self.socket = address.open_socket(BACKLOG)
        self.port: int = self.socket.getsockname()[1]
        self._thread = threading.Thread(target=self.serve_forever, args=(POLL_S,), name="metrics", daemon=True)

    def __enter__(self) -> "MetricsServer":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()
        with self._lock:
            for request in self._deadlines_s:
                _end(request)

    def process_request(self, request: Any, client_address: Any) -> None:
        """See `socketserver.BaseServer.process_request`."""
        with self._lock:
            self._deadlines_s[request] = time.monotonic() + REQUEST_TIMEOUT_S
            oldest = self._open.add(request, client_address[0])
            if oldest is not None:
                _end(oldest)
        super().process_request(request, client_address)

    def close_request(self, request: Any) -> None:
        """See `socketserver.BaseServer.close_request`."""
        with self._lock:
            self._open.discard(request)
            self._deadlines_s.pop(request, None)
        super().close_request(request)

    def service_actions(self) -> None:
        """End the connections whose time is over; see `socketserver.BaseServer.service_actions`."""
        now_s = time.monotonic()
        with self._lock:
            for request, deadline_s in self._deadlines_s.items():
                if now_s > deadline_s:
                    _end(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log an internal error, but no client that disconnects."""
        del request
        if not isinstance(error := sys.exception(), OSError):
            logger.error("request of %s failed", client_address[0], exc_info=error)


def _end(connection: socket.socket) -> None:
    """End a connection: its thread reads the end of the data and closes it."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def _handler(text: Callable[[], str]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            """Answer one request."""
            if self.path.partition("?")[0] != "/metrics":
                self.send_error(HTTPStatus.NOT_FOUND, "the metrics are at /metrics")
                return
            body = text().encode()
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: object) -> None:
            """Do not log requests: there is one per scrape."""

    return Handler
