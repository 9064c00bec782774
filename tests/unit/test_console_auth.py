"""Access control of the console: host names, password, options."""

import base64
from pathlib import Path
from typing import Any

import pytest

from hilrig_cli.commands.console import console
from hilrig_console.auth import AccessPolicy, normalize_host_names
from hilrig_runtime.errors import HilrigError, InputError, OperationError

POLICY = AccessPolicy(allowed_hosts=normalize_host_names(["Lab-PC", "", "wall.example."]))


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
def test_allows_addresses_and_configured_host_names(host: str) -> None:
    assert POLICY.allows_host(host)


@pytest.mark.parametrize(
    "host", ["", "evil.example", "evil.example:8050", "127.0.0.1.evil.example", "localhost.evil.example", "[evil]:80"]
)
def test_rejects_foreign_host_names(host: str) -> None:
    assert not POLICY.allows_host(host)


def basic(text: str) -> str:
    return f"Basic {base64.b64encode(text.encode()).decode()}"


def test_accepts_password_with_any_user_name() -> None:
    policy = AccessPolicy(password="sésame ouvre-toi")
    assert policy.accepts_password(basic("teacher:sésame ouvre-toi"))
    assert policy.accepts_password(basic(":sésame ouvre-toi"))
    for header in ("", "Basic", "Basic !!!", "Basic é", basic("sésame ouvre-toi"), basic("a:sésame"), "Bearer x"):
        assert not policy.accepts_password(header), header
    assert not policy.accepts_password(basic("a:sésame ouvre-toi").replace("Basic", "Bearer"))
    assert AccessPolicy().accepts_password("")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"listen": "here"}, InputError, "expected HOST:PORT"),
        ({"password_file": Path("none")}, InputError, "none: no such file"),
        ({"password_file": Path("short")}, InputError, "at least 8 characters"),
        ({"certificate": Path("invalid.pem")}, InputError, "must be given together"),
        (
            {"certificate": Path("invalid.pem"), "key": Path("invalid.pem")},
            InputError,
            "not a certificate with its private key",
        ),
        ({"check": True, "listen": "127.0.0.1:1"}, OperationError, "no console answers at http://127.0.0.1:1/"),
    ],
)
def test_command_rejects_invalid_options(
    options: dict[str, Any], error: type[HilrigError], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("short").write_text("short\n")
    Path("invalid.pem").write_text("no certificate")
    with pytest.raises(error, match=message):
        console(**options)
