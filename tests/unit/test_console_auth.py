"""Whom the console answers: by which name it is asked, with which password, from which page, at which address."""

import base64
from pathlib import Path
from typing import Any

import pytest

from hilrig_cli.commands.console import console
from hilrig_console.auth import Guard, is_loopback, own_names
from hilrig_console.serving import Address
from hilrig_runtime.errors import HilrigError, InputError, OperationError

GUARD = Guard(names=own_names(["Lab-PC", "", "wall.example."]))


@pytest.mark.parametrize(
    "host",
    [
        "localhost",
        "localhost:8050",
        "127.0.0.1:8050",
        "[::1]:8050",
        "192.0.2.7",
        "LAB-PC:80",
        "wall.example",
        "lab-pc.",
    ],
)
def test_addresses_and_own_names_are_ours(host: str) -> None:
    assert GUARD.is_ours(host)


@pytest.mark.parametrize(
    "host", ["", "evil.example", "evil.example:8050", "127.0.0.1.evil.example", "localhost.evil.example", "[evil]:80"]
)
def test_a_name_that_somebody_else_leads_here_is_not(host: str) -> None:
    assert not GUARD.is_ours(host)


def basic(text: str) -> str:
    return f"Basic {base64.b64encode(text.encode()).decode()}"


def test_whoever_has_the_password_is_known_whatever_his_name() -> None:
    guard = Guard(password="sésame ouvre-toi")
    assert guard.knows(basic("teacher:sésame ouvre-toi"))
    assert guard.knows(basic(":sésame ouvre-toi"))
    for wrong in ("", "Basic", "Basic !!!", "Basic é", basic("sésame ouvre-toi"), basic("a:sésame"), "Bearer x"):
        assert not guard.knows(wrong), wrong
    assert not guard.knows(basic("a:sésame ouvre-toi").replace("Basic", "Bearer"))
    assert Guard().knows("")


@pytest.mark.parametrize(
    ("text", "host", "port", "private"),
    [
        ("127.0.0.1:8050", "127.0.0.1", 8050, True),
        ("localhost:0", "localhost", 0, True),
        ("[::1]:80", "::1", 80, True),
        (":8050", "", 8050, False),
        ("0.0.0.0:8050", "0.0.0.0", 8050, False),
        ("[::]:8050", "::", 8050, False),
        ("lab.example:1", "lab.example", 1, False),
    ],
)
def test_where_to_listen(text: str, host: str, port: int, private: bool) -> None:
    address = Address.of(text)
    assert (address.host, address.port, address.is_private) == (host, port, private)


@pytest.mark.parametrize("text", ["8050", "127.0.0.1", "127.0.0.1:web", "127.0.0.1:70000", "a:²"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="expected HOST:PORT"):
        Address.of(text)


def test_only_loopback_is_private() -> None:
    assert is_loopback("127.1.2.3")
    assert not is_loopback("")
    assert not is_loopback("10.0.0.1")


@pytest.mark.parametrize(
    ("options", "error", "why"),
    [
        ({"listen": "here"}, InputError, "expected HOST:PORT"),
        ({"password_file": Path("none")}, InputError, "none: can't be read: No such file"),
        ({"password_file": Path("short")}, InputError, "at least 8 characters"),
        ({"certificate": Path("torn.pem")}, InputError, "must be given together"),
        ({"certificate": Path("torn.pem"), "key": Path("torn.pem")}, InputError, "no certificate with its key"),
        ({"check": True, "listen": "127.0.0.1:1"}, OperationError, "no console answers at http://127.0.0.1:1/"),
    ],
)
def test_what_is_asked_wrongly_is_refused_before_anything_begins(
    options: dict[str, Any], error: type[HilrigError], why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("short").write_text("short\n")
    Path("torn.pem").write_text("no certificate")
    with pytest.raises(error, match=why):
        console(**options)
