"""Who may look at the page: this machine, or who knows the password; and what the page may do in a browser.

A foreign page can make a browser ask anything of this machine, under a name of its own that it lets lead here
("DNS rebinding"). So a question must name an address, or a name that is ours.
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

from hilrig_console.login_throttle import LoginThrottle
from hilrig_runtime.timing.clock import SYSTEM_CLOCK, Clock

MIN_PASSWORD_CHARS: Final = 8
PAGE_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The page has files of this server alone, and no script or style within it."""
REPORT_POLICY: Final = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""A report is one file with all that it needs, and has no script."""
HEADERS: Final = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
HEALTH_PATH: Final = "/health"
"""Asked by health checks, and tells nothing but that there is a console."""


@dataclass(frozen=True, slots=True)
class AccessPolicy:
    """Whom a console answers."""

    password: str = ""
    """Empty: everybody who reaches it."""
    names: frozenset[str] = frozenset()
    """Names of this host, beside `localhost` and every address."""

    def allows_host(self, host: str) -> bool:
        """Whether a Host header, "name", "name:port" or "[address]:port", names this host."""
        name, bracket, _ = host.removeprefix("[").partition("]")
        if not bracket:
            name = host.partition(":")[0]
        name = name.lower().rstrip(".")
        return name == "localhost" or name in self.names or _is_address(name)

    def knows(self, authorization: str) -> bool:
        """Whether an Authorization header has the password; the user's name does not matter."""
        if not self.password:
            return True
        kind, _, credentials = authorization.partition(" ")
        try:
            given = base64.b64decode(credentials, validate=True).partition(b":")[2]
        except (binascii.Error, ValueError):
            return False
        # In a time that does not tell how much of it is right.
        return kind.lower() == "basic" and hmac.compare_digest(given, self.password.encode())


class AuthMiddleware:
    """An application behind a policy, with the headers that keep its pages to themselves."""

    def __init__(self, app: ASGIApp, policy: AccessPolicy, clock: Clock = SYSTEM_CLOCK) -> None:
        self._app = app
        self._policy = policy
        self._throttle = LoginThrottle()
        self._monotonic_ns = clock.monotonic_ns

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse (ASGI)."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("Content-Security-Policy", PAGE_POLICY)
                headers.setdefault("Cache-Control", "no-store")
                headers.update(HEADERS)
            await send(message)

        client = scope.get("client") or ("", 0)
        refusal = self._refusal(scope["path"], Headers(scope=scope), client[0])
        await (refusal or self._app)(scope, receive, send_with_headers)

    def _refusal(self, path: str, headers: Headers, address: str) -> PlainTextResponse | None:
        policy = self._policy
        if not policy.allows_host(headers.get("host", "")):
            what = "this console is not called so; ask for it by its address, or start it with --name\n"
            return PlainTextResponse(what, HTTPStatus.MISDIRECTED_REQUEST)
        # Browsers say where a question comes from; what another site's page embeds is not for it.
        if headers.get("sec-fetch-site") == "cross-site" and headers.get("sec-fetch-mode") != "navigate":
            return PlainTextResponse("not for other sites\n", HTTPStatus.FORBIDDEN)
        return None if path == HEALTH_PATH else self._stranger(headers.get("authorization", ""), address)

    def _stranger(self, authorization: str, address: str) -> PlainTextResponse | None:
        now_ns = self._monotonic_ns()
        if authorization and (wait_ns := self._throttle.wait_ns(address, now_ns)):
            later = {"Retry-After": str(-(-wait_ns // 1_000_000_000))}
            what = "too many wrong passwords from this address; try again later\n"
            return PlainTextResponse(what, HTTPStatus.TOO_MANY_REQUESTS, later)
        if self._policy.knows(authorization):
            return None
        if authorization:
            self._throttle.record_failure(address, now_ns)
        asks = {"WWW-Authenticate": 'Basic realm="hilrig console", charset="UTF-8"'}
        return PlainTextResponse("a password is needed\n", HTTPStatus.UNAUTHORIZED, asks)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a host's name or address."""
    if host == "localhost":
        return True
    return _is_address(host) and ipaddress.ip_address(host.partition("%")[0]).is_loopback


def host_name_set(names: Iterable[str]) -> frozenset[str]:
    """Names as they are compared, without those that are empty."""
    return frozenset(name.lower().rstrip(".") for name in names if name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
