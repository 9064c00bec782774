"""Access control of the console: password, host names, cross-site requests and security headers.

A foreign site can resolve its own name to this host ("DNS rebinding") and make a browser send requests to the console.
Therefore the Host header of a request must be an IP address or an allowed name.
"""

import base64
import binascii
import hmac
import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from http import HTTPStatus
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from hilrig_replay.report.assets import content_policy
from hilrig_runtime.timing.clock import SYSTEM_CLOCK, Clock
from hilrig_runtime.timing.guess_throttle import GuessThrottle

MIN_PASSWORD_CHARS: Final = 8
PAGE_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page: only files of this server, no inline scripts or styles."""
REPORT_POLICY: Final = f"{content_policy()}; frame-ancestors 'none'"
"""Content security policy of a report: a self-contained file, which no other site may embed."""
SECURITY_HEADERS: Final = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
HEALTH_PATH: Final = "/health"
"""Path of health checks; needs no password."""


@dataclass(frozen=True, slots=True)
class AccessPolicy:
    """Access policy of a console: password and allowed host names."""

    password: str = ""
    """Empty: no password needed."""
    allowed_hosts: frozenset[str] = frozenset()
    """Allowed names in the Host header, in addition to `localhost` and IP addresses."""

    def allows_host(self, host: str) -> bool:
        """Return whether a Host header ("name", "name:port" or "[address]:port") is allowed."""
        name, bracket, _ = host.removeprefix("[").partition("]")
        if not bracket:
            name = host.partition(":")[0]
        name = name.lower().rstrip(".")
        return name == "localhost" or name in self.allowed_hosts or _is_ip_address(name)

    def accepts_password(self, authorization: str) -> bool:
        """Return whether an Authorization header has the password; the user name is ignored."""
        if not self.password:
            return True
        kind, _, credentials = authorization.partition(" ")
        try:
            password = base64.b64decode(credentials, validate=True).partition(b":")[2]
        except (binascii.Error, ValueError):
            return False
        # Comparison in constant time, which reveals nothing about the password.
        return kind.lower() == "basic" and hmac.compare_digest(password, self.password.encode())


class AuthMiddleware:
    """ASGI middleware that enforces an access policy and adds security headers."""

    def __init__(self, app: ASGIApp, policy: AccessPolicy, clock: Clock = SYSTEM_CLOCK) -> None:
        self._app = app
        self._policy = policy
        self._throttle = GuessThrottle()
        self._monotonic_ns = clock.monotonic_ns

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle an ASGI request: pass it to the application or reject it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("Content-Security-Policy", PAGE_POLICY)
                headers.setdefault("Cache-Control", "no-store")
                headers.update(SECURITY_HEADERS)
            await send(message)

        client = scope.get("client") or ("", 0)
        rejection = self._rejection(scope["path"], Headers(scope=scope), client[0])
        await (rejection or self._app)(scope, receive, send_with_headers)

    def _rejection(self, path: str, headers: Headers, address: str) -> PlainTextResponse | None:
        policy = self._policy
        if not policy.allows_host(headers.get("host", "")):
            text = "unknown host name: open this console by its IP address, or add the name with --name\n"
            return PlainTextResponse(text, HTTPStatus.MISDIRECTED_REQUEST)
        # Browsers send the origin of a request; embedding in pages of other sites is not allowed.
        if headers.get("sec-fetch-site") == "cross-site" and headers.get("sec-fetch-mode") != "navigate":
            return PlainTextResponse("cross-site requests are not allowed\n", HTTPStatus.FORBIDDEN)
        return None if path == HEALTH_PATH else self._challenge(headers.get("authorization", ""), address)

    def _challenge(self, authorization: str, address: str) -> PlainTextResponse | None:
        now_ns = self._monotonic_ns()
        if authorization and (wait_ns := self._throttle.wait_ns(address, now_ns)):
            retry_after = {"Retry-After": str(-(-wait_ns // 1_000_000_000))}
            text = "too many wrong passwords from this address; try again later\n"
            return PlainTextResponse(text, HTTPStatus.TOO_MANY_REQUESTS, retry_after)
        if self._policy.accepts_password(authorization):
            return None
        if authorization:
            self._throttle.record_failure(address, now_ns)
        challenge = {"WWW-Authenticate": 'Basic realm="hilrig console", charset="UTF-8"'}
        return PlainTextResponse("password required\n", HTTPStatus.UNAUTHORIZED, challenge)


def normalize_host_names(names: Iterable[str]) -> frozenset[str]:
    """Return host names in lower case without trailing dots; empty names are left out."""
    return frozenset(name.lower().rstrip(".") for name in names if name)


def _is_ip_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
