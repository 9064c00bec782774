"""Throttle of wrong passwords and codes: a burst, then one attempt per interval."""

import asyncio
import base64

import pytest
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message

from hilrig_console.auth import AccessPolicy, AuthMiddleware
from hilrig_runtime.timing.clock import ManualClock
from hilrig_runtime.timing.guess_throttle import BURST_ATTEMPTS, MAX_ADDRESSES, RETRY_INTERVAL_NS, GuessThrottle

HOST = "192.0.2.7"


def exhausted(address: str = HOST) -> GuessThrottle:
    throttle = GuessThrottle()
    for _ in range(BURST_ATTEMPTS):
        assert throttle.wait_ns(address, 0) == 0
        throttle.record_failure(address, 0)
    return throttle


def test_allows_one_attempt_per_interval_after_burst() -> None:
    throttle = exhausted()
    assert throttle.wait_ns(HOST, 0) == RETRY_INTERVAL_NS
    assert throttle.wait_ns(HOST, RETRY_INTERVAL_NS - 1) == 1
    assert throttle.wait_ns(HOST, RETRY_INTERVAL_NS) == 0
    throttle.record_failure(HOST, RETRY_INTERVAL_NS)
    assert throttle.wait_ns(HOST, RETRY_INTERVAL_NS) == RETRY_INTERVAL_NS


def test_burst_is_available_again_after_pause() -> None:
    throttle = exhausted()
    later_ns = BURST_ATTEMPTS * RETRY_INTERVAL_NS
    for _ in range(BURST_ATTEMPTS):
        assert throttle.wait_ns(HOST, later_ns) == 0
        throttle.record_failure(HOST, later_ns)
    assert throttle.wait_ns(HOST, later_ns) == RETRY_INTERVAL_NS


def test_other_addresses_do_not_wait() -> None:
    assert exhausted().wait_ns("192.0.2.8", 0) == 0


@pytest.mark.parametrize(("other", "waits"), [("2001:db8::ffff:1", True), ("2001:db8:0:1::1", False)])
def test_throttles_ipv6_per_network(other: str, waits: bool) -> None:
    assert bool(exhausted("2001:db8::1").wait_ns(other, 0)) is waits


def test_number_of_addresses_is_bounded() -> None:
    throttle = exhausted()
    for number in range(MAX_ADDRESSES):
        throttle.record_failure(f"10.0.{number // 256}.{number % 256}", 0)
    assert len(throttle._blocked_until_ns) == MAX_ADDRESSES
    assert throttle.wait_ns(HOST, 0) == 0


def test_rejects_correct_password_during_wait() -> None:
    clock = ManualClock()
    protected = AuthMiddleware(PlainTextResponse("in"), AccessPolicy(password="open sesame"), clock)

    def request(password: str | None = None) -> tuple[int, str]:
        headers = [(b"host", b"localhost")]
        if password is not None:
            headers.append((b"authorization", b"Basic " + base64.b64encode(f"teacher:{password}".encode())))
        return asyncio.run(reply_of(protected, headers))

    assert request() == (401, "")
    assert [request("guess") for _ in range(BURST_ATTEMPTS)] == [(401, "")] * BURST_ATTEMPTS
    assert request() == (401, ""), "a request without a password is not an attempt"
    assert request("open sesame") == (429, "5")
    clock.advance(RETRY_INTERVAL_NS)
    assert [request("open sesame") for _ in range(3 * BURST_ATTEMPTS)] == [(200, "")] * (3 * BURST_ATTEMPTS)


async def reply_of(app: ASGIApp, headers: list[tuple[bytes, bytes]]) -> tuple[int, str]:
    """Return the status and the Retry-After header of the reply of an application."""
    sent: list[Message] = []

    async def receive() -> Message:
        return {"type": "http.request"}

    async def send(message: Message) -> None:
        sent.append(message)

    await app({"type": "http", "method": "GET", "path": "/", "headers": headers, "client": (HOST, 1)}, receive, send)
    return sent[0]["status"], Headers(raw=sent[0]["headers"]).get("retry-after", "")
