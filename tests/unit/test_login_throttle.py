"""Guesses at the console's password: some at once, then few, whatever their number of connections."""

import asyncio
import base64

import pytest
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message

from hilrig_console.auth import Guard, Guarded
from hilrig_console.login_throttle import ADDRESSES, AT_ONCE, PERIOD_NS, Patience
from hilrig_runtime.timing.clock import ManualClock

HOST = "192.0.2.7"


def worn(address: str = HOST) -> Patience:
    patience = Patience()
    for _ in range(AT_ONCE):
        assert patience.wait_ns(address, 0) == 0
        patience.wrong(address, 0)
    return patience


def test_after_some_wrong_passwords_one_may_be_tried_each_period() -> None:
    patience = worn()
    assert patience.wait_ns(HOST, 0) == PERIOD_NS
    assert patience.wait_ns(HOST, PERIOD_NS - 1) == 1
    assert patience.wait_ns(HOST, PERIOD_NS) == 0
    patience.wrong(HOST, PERIOD_NS)
    assert patience.wait_ns(HOST, PERIOD_NS) == PERIOD_NS


def test_who_is_quiet_for_long_begins_anew() -> None:
    patience = worn()
    later_ns = AT_ONCE * PERIOD_NS
    for _ in range(AT_ONCE):
        assert patience.wait_ns(HOST, later_ns) == 0
        patience.wrong(HOST, later_ns)
    assert patience.wait_ns(HOST, later_ns) == PERIOD_NS


def test_others_do_not_wait() -> None:
    assert worn().wait_ns("192.0.2.8", 0) == 0


@pytest.mark.parametrize(("other", "waits"), [("2001:db8::ffff:1", True), ("2001:db8:0:1::1", False)])
def test_a_host_has_a_whole_network_of_ipv6(other: str, waits: bool) -> None:
    assert bool(worn("2001:db8::1").wait_ns(other, 0)) is waits


def test_what_is_remembered_is_bounded() -> None:
    patience = worn()
    for number in range(ADDRESSES):
        patience.wrong(f"10.0.{number // 256}.{number % 256}", 0)
    assert len(patience._worn_until_ns) == ADDRESSES
    assert patience.wait_ns(HOST, 0) == 0


def test_a_guess_that_comes_too_early_is_not_looked_at_even_if_it_is_right() -> None:
    clock = ManualClock()
    guarded = Guarded(PlainTextResponse("in"), Guard(password="open sesame"), clock)

    def asked(password: str | None = None) -> tuple[int, str]:
        headers = [(b"host", b"localhost")]
        if password is not None:
            headers.append((b"authorization", b"Basic " + base64.b64encode(f"teacher:{password}".encode())))
        return asyncio.run(answer_of(guarded, headers))

    assert asked() == (401, "")
    assert [asked("guess") for _ in range(AT_ONCE)] == [(401, "")] * AT_ONCE
    assert asked() == (401, ""), "to ask without a password is no guess"
    assert asked("open sesame") == (429, "5")
    clock.advance(PERIOD_NS)
    assert [asked("open sesame") for _ in range(3 * AT_ONCE)] == [(200, "")] * (3 * AT_ONCE)


async def answer_of(app: ASGIApp, headers: list[tuple[bytes, bytes]]) -> tuple[int, str]:
    """Status, and the seconds after which to try again, of what an application answers."""
    sent: list[Message] = []

    async def receive() -> Message:
        return {"type": "http.request"}

    async def send(message: Message) -> None:
        sent.append(message)

    await app({"type": "http", "method": "GET", "path": "/", "headers": headers, "client": (HOST, 1)}, receive, send)
    return sent[0]["status"], Headers(raw=sent[0]["headers"]).get("retry-after", "")
