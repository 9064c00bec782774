"""Emulated hosts of other tests: name resolution, addresses, and silent packet loss on a link that is down."""

import subprocess
import sys
from collections.abc import Iterator

import pytest

from support.namespaces import Network, require_namespaces

pytestmark = pytest.mark.hosts

SERVER = """
import socket
with socket.create_server(("0.0.0.0", 7000)) as server:
    print("ready", flush=True)
    while True:
        connection, (address, _) = server.accept()
        connection.sendall(address.encode())
        connection.close()
"""
CLIENT = """
import socket, sys
try:
    with socket.create_connection((sys.argv[1], 7000), timeout=float(sys.argv[2])) as connection:
        print(connection.recv(100).decode())
except OSError as error:
    print(type(error).__name__)
"""


@pytest.fixture
def network() -> Iterator[Network]:
    require_namespaces()
    # A host may be named like the gateway.
    with Network(["client", "server", "gateway"]) as network:
        server = network.popen("server", [sys.executable, "-c", SERVER], stdout=subprocess.PIPE, text=True)
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        yield network


def query_server(network: Network, host: str, timeout_s: float = 20.0) -> str:
    """Connect a host to the server; returns its address as seen by the server, or the name of the error."""
    command = [sys.executable, "-c", CLIENT, "server", str(timeout_s)]
    return network.run(host, command, stdout=subprocess.PIPE, text=True).stdout.strip()


def test_hosts_resolve_names_and_see_peer_addresses(network: Network) -> None:
    for host in ("client", "gateway", "server"):
        assert query_server(network, host) == network.address(host)


def test_packets_to_a_disconnected_host_are_dropped(network: Network) -> None:
    network.set_link("server", False)
    assert query_server(network, "client", 1.0) == "TimeoutError"
    network.set_link("server", True)
    assert query_server(network, "client") == network.address("client")


def test_disconnected_host_reaches_only_itself(network: Network) -> None:
    network.set_link("client", False)
    assert query_server(network, "client", 1.0) == "TimeoutError"
    assert query_server(network, "gateway") == network.address("gateway")
    network.set_link("client", True)
    assert query_server(network, "client") == network.address("client")
    network.set_link("server", False)
    assert query_server(network, "server") == network.address("server")
