"""The viewer's page for a browser, fenced in: it may ask this machine for the run, and nobody else for anything.

As rerun serves it, the page sends usage statistics, asks for the newest release and loads a font from elsewhere. Here
each answer passes through a server that adds a Content-Security-Policy, which the browser keeps.
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
_KEPT: Final = ("Content-Type", "Content-Encoding")


def policy(grpc_port: int) -> str:
    """What the page may do: its own files, its own script, and data from `grpc_port` of this machine."""
    own = "'self' data: blob:"
    script = f"script-src {own} 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval'"
    return (
        f"default-src {own}; {script}; style-src {own} 'unsafe-inline'; worker-src {own}; "
        f"connect-src {own} http://{LOOPBACK}:{grpc_port}"
    )


@contextmanager
def fenced(viewer_port: int, grpc_port: int, port: int) -> Iterator[None]:
    """Serve what the viewer serves at `viewer_port` at `port` too, fenced, on this machine alone.

    Raises:
        OSError: the port is taken.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            try:
                with urllib.request.urlopen(f"http://{LOOPBACK}:{viewer_port}{self.path}", timeout=_TIMEOUT_S) as page:
                    self._answer(page.status, dict(page.headers), page.read())
            except urllib.error.HTTPError as error:
                self._answer(error.code, dict(error.headers), error.read())
            except OSError:
                # The viewer is ending: the page finds out by itself.
                self._answer(502, {}, b"")

        def _answer(self, status: int, headers: dict[str, str], body: bytes) -> None:
            self.send_response(status)
            for name, value in headers.items():
                if name.title() in _KEPT:
                    self.send_header(name, value)
            self.send_header("Content-Security-Policy", policy(grpc_port))
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer((LOOPBACK, port), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, name="viewer's page", daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join()
