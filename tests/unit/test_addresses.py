"""Human-readable addresses: with brackets, reachable instead of wildcards, and the fix by the error's number."""

import errno
import socket

import pytest

from hilrig_runtime.addresses import format_address, listen_hint, plain_host, reachable_hosts
from hilrig_runtime.bus.zenoh_config import mesh_endpoint
from hilrig_runtime.config.bus import BusConfig


def test_ipv6_hosts_are_bracketed() -> None:
    assert format_address("::1", 5020) == "[::1]:5020"
    assert format_address("10.0.0.1", 5020) == "10.0.0.1:5020"


def test_mapped_ipv4_host_is_plain() -> None:
    assert plain_host("::ffff:10.0.0.7") == plain_host("10.0.0.7") == "10.0.0.7"
    assert plain_host("fe80::1") == "fe80::1"


def test_wildcard_is_shown_as_addresses_that_reach_it() -> None:
    assert reachable_hosts("192.168.7.1") == ["192.168.7.1"]
    for wildcard, family in (("0.0.0.0", socket.AF_INET), ("::", socket.AF_INET6)):
        if family is socket.AF_INET6 and not socket.has_dualstack_ipv6():
            continue
        *addresses, name = reachable_hosts(wildcard)
        assert name == socket.gethostname()
        assert not {"0.0.0.0", "::", "127.0.0.1", "::1"} & set(addresses)
        with socket.create_server((wildcard, 0), family=family, dualstack_ipv6=family is socket.AF_INET6) as listening:
            for address in addresses:
                socket.create_connection((address, listening.getsockname()[1]), 5).close()


@pytest.mark.parametrize(
    ("number", "port", "expected"),
    [
        (errno.EACCES, 502, "need a permission (docs/operations.md, Port 502)"),
        (errno.EADDRINUSE, 502, "is another hilrig running here? Stop the program"),
        (errno.EADDRNOTAVAIL, 5020, "HOST in lab.toml must be an address of this host"),
        (errno.EMFILE, 5020, "ulimit -n"),
        (errno.EACCES, 5020, "choose another address or port in lab.toml (HOST, PORT)"),
    ],
)
def test_each_error_has_its_fix(number: int, port: int, expected: str) -> None:
    hint = listen_hint(OSError(number, "text"), port, "HOST", "PORT")
    assert expected in hint
    assert ("another hilrig" in hint) == (number == errno.EADDRINUSE)


def test_mesh_on_ipv6_has_bracketed_endpoints() -> None:
    assert mesh_endpoint(BusConfig(host="::1", first_port=7447), "sim") == "tcp/[::1]:7447"
