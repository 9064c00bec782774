"""Reverse proxy of rerun's web viewer; adds a Content-Security-Policy that restricts the page to this host.

As served by rerun, the page sends usage statistics, checks for a newer release and loads a font from other hosts. The
policy that this proxy adds to each response makes the browser block these requests.
"""

import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final

LOOPBACK: Final = "127.0.0.1"
_TIMEOUT_S: Final = 30.0
_FORWARDED_HEADERS: Final = ("Content-Type", "Content-Encoding")


def policy(grpc_port: int) -> str:
    """Content-Security-Policy of the page: only its own files and scripts, and data from `grpc_port` of this host."""
    own = "'self' data: blob:"
    script = f"script-src {own} 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval'"
    return (
        f"default-src {own}; {script}; style-src {own} 'unsafe-inline'; worker-src {own}; "
        f"connect-src {own} http://{LOOPBACK}:{grpc_port}"
    )


@contextmanager
def serve_with_csp(viewer_port: int, grpc_port: int, port: int) -> Iterator[None]:
    """Serve the pages of `viewer_port` on `port` with the Content-Security-Policy, on the loopback interface only.

    Raises:
        OSError: the port is in use.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            try:
                with urllib.request.urlopen(f"http://{LOOPBACK}:{viewer_port}{self.path}", timeout=_TIMEOUT_S) as page:
                    self._respond(page.status, dict(page.headers), page.read())
            except urllib.error.HTTPError as error:
                self._respond(error.code, dict(error.headers), error.read())
            except OSError:
                # The viewer is shutting down.
                self._respond(502, {}, b"")

        def _respond(self, status: int, headers: dict[str, str], body: bytes) -> None:
            self.send_response(status)
            for name, value in headers.items():
                if name.title() in _FORWARDED_HEADERS:
                    self.send_header(name, value)
            self.send_header("Content-Security-Policy", policy(grpc_port))
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer((LOOPBACK, port), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, name="web viewer proxy", daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join()
