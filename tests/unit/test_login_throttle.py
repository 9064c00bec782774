"""Guesses at the console's password: some at once, then few, whatever their number of connections."""

import asyncio
import base64

import pytest
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message

from hilrig_console.auth import AccessPolicy, AuthMiddleware
from hilrig_console.login_throttle import BURST_ATTEMPTS, MAX_ADDRESSES, RETRY_INTERVAL_NS, LoginThrottle
from hilrig_runtime.timing.clock import ManualClock

HOST = "192.0.2.7"


def worn(address: str = HOST) -> LoginThrottle:
    throttle = LoginThrottle()
    for _ in range(BURST_ATTEMPTS):
        assert throttle.wait_ns(address, 0) == 0
        throttle.record_failure(address, 0)
    return throttle


def test_after_some_wrong_passwords_one_may_be_tried_each_period() -> None:
    throttle = worn()
    assert throttle.wait_ns(HOST, 0) == RETRY_INTERVAL_NS
    assert throttle.wait_ns(HOST, RETRY_INTERVAL_NS - 1) == 1
    assert throttle.wait_ns(HOST, RETRY_INTERVAL_NS) == 0
    throttle.record_failure(HOST, RETRY_INTERVAL_NS)
    assert throttle.wait_ns(HOST, RETRY_INTERVAL_NS) == RETRY_INTERVAL_NS


def test_who_is_quiet_for_long_begins_anew() -> None:
    throttle = worn()
    later_ns = BURST_ATTEMPTS * RETRY_INTERVAL_NS
    for _ in range(BURST_ATTEMPTS):
        assert throttle.wait_ns(HOST, later_ns) == 0
        throttle.record_failure(HOST, later_ns)
    assert throttle.wait_ns(HOST, later_ns) == RETRY_INTERVAL_NS


def test_others_do_not_wait() -> None:
    assert worn().wait_ns("192.0.2.8", 0) == 0


@pytest.mark.parametrize(("other", "waits"), [("2001:db8::ffff:1", True), ("2001:db8:0:1::1", False)])
def test_a_host_has_a_whole_network_of_ipv6(other: str, waits: bool) -> None:
    assert bool(worn("2001:db8::1").wait_ns(other, 0)) is waits


def test_what_is_remembered_is_bounded() -> None:
    throttle = worn()
    for number in range(MAX_ADDRESSES):
        throttle.record_failure(f"10.0.{number // 256}.{number % 256}", 0)
    assert len(throttle._blocked_until_ns) == MAX_ADDRESSES
    assert throttle.wait_ns(HOST, 0) == 0


def test_a_guess_that_comes_too_early_is_not_looked_at_even_if_it_is_right() -> None:
    clock = ManualClock()
    protected = AuthMiddleware(PlainTextResponse("in"), AccessPolicy(password="open sesame"), clock)

    def asked(password: str | None = None) -> tuple[int, str]:
        headers = [(b"host", b"localhost")]
        if password is not None:
            headers.append((b"authorization", b"Basic " + base64.b64encode(f"teacher:{password}".encode())))
        return asyncio.run(answer_of(protected, headers))

    assert asked() == (401, "")
    assert [asked("guess") for _ in range(BURST_ATTEMPTS)] == [(401, "")] * BURST_ATTEMPTS
    assert asked() == (401, ""), "to ask without a password is no guess"
    assert asked("open sesame") == (429, "5")
    clock.advance(RETRY_INTERVAL_NS)
    assert [asked("open sesame") for _ in range(3 * BURST_ATTEMPTS)] == [(200, "")] * (3 * BURST_ATTEMPTS)


async def answer_of(app: ASGIApp, headers: list[tuple[bytes, bytes]]) -> tuple[int, str]:
    """Status, and the seconds after which to try again, of what an application answers."""
    sent: list[Message] = []

    async def receive() -> Message:
        return {"type": "http.request"}

    async def send(message: Message) -> None:
        sent.append(message)

    await app({"type": "http", "method": "GET", "path": "/", "headers": headers, "client": (HOST, 1)}, receive, send)
    return sent[0]["status"], Headers(raw=sent[0]["headers"]).get("retry-after", "")
