"""Addresses of the servers of the tools: parsed, opened with both versions of IP, printed as URLs that reach them."""

import socket

import pytest

from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.listen_address import ListenAddress


@pytest.mark.parametrize(
    ("text", "host", "port", "loopback"),
    [
        ("127.0.0.1:8050", "127.0.0.1", 8050, True),
        ("localhost:0", "localhost", 0, True),
        ("[::1]:80", "::1", 80, True),
        (":8050", "0.0.0.0", 8050, False),
        ("0.0.0.0:8050", "0.0.0.0", 8050, False),
        ("[::]:8050", "::", 8050, False),
        ("lab.example:1", "lab.example", 1, False),
    ],
)
def test_parses_listen_address(text: str, host: str, port: int, loopback: bool) -> None:
    address = ListenAddress.parse(text)
    assert (address.host, address.port, address.is_loopback) == (host, port, loopback)


@pytest.mark.parametrize("text", ["8050", "127.0.0.1", "127.0.0.1:web", "127.0.0.1:70000", "a:²"])
def test_rejects_invalid_listen_address(text: str) -> None:
    with pytest.raises(InputError, match="expected HOST:PORT"):
        ListenAddress.parse(text)


def test_recognizes_loopback_addresses() -> None:
    assert ListenAddress("127.1.2.3", 1).is_loopback
    assert ListenAddress("localhost", 1).is_loopback
    assert not ListenAddress("::", 1).is_loopback
    assert not ListenAddress("10.0.0.1", 1).is_loopback


@pytest.mark.parametrize(
    ("text", "clients"), [("[::]:0", ["127.0.0.1", "::1"]), ("[::1]:0", ["::1"]), (":0", ["127.0.0.1"])]
)
def test_server_is_reached_at_its_urls(text: str, clients: list[str]) -> None:
    if "::" in text and not socket.has_dualstack_ipv6():
        pytest.skip("needs IPv6")
    address = ListenAddress.parse(text)
    with address.open_socket(8) as listening:
        port = listening.getsockname()[1]
        for client in clients:
            socket.create_connection((client, port), 5).close()
        socket.create_connection((address.local_host, port), 5).close()
        urls = address.urls(port, "http", "/metrics")
        assert urls.endswith(f":{port}/metrics")
        assert ":::" not in urls
        assert "0.0.0.0" not in urls
        assert text != "[::1]:0" or urls == f"http://[::1]:{port}/metrics"
        other = ListenAddress(address.host, port)
        with pytest.raises(OperationError, match=r"can't listen on .*\d: Address already in use; choose another"):
            other.open_socket(1)


def test_ipv6_address_in_an_error_is_bracketed() -> None:
    with pytest.raises(OperationError, match=r"can't listen on \[2001:db8::1\]:80: "):
        ListenAddress("2001:db8::1", 80).open_socket(1)
