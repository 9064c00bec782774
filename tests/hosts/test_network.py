"""The hosts that other tests stand on: they find each other by name, and a cable that is out loses without a word."""

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
    # A host may have the gateway's name, too.
    with Network(["client", "server", "gateway"]) as network:
        server = network.popen("server", [sys.executable, "-c", SERVER], stdout=subprocess.PIPE, text=True)
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        yield network


def asked(network: Network, host: str, timeout_s: float = 20.0) -> str:
    """What a host is told that asks the server: its own address, or the kind of error."""
    command = [sys.executable, "-c", CLIENT, "server", str(timeout_s)]
    return network.run(host, command, stdout=subprocess.PIPE, text=True).stdout.strip()


def test_hosts_find_each_other_by_name_and_see_each_others_addresses(network: Network) -> None:
    for host in ("client", "gateway", "server"):
        assert asked(network, host) == network.address(host)


def test_what_is_sent_to_a_host_whose_cable_is_out_is_lost_without_a_word(network: Network) -> None:
    network.set_link("server", False)
    assert asked(network, "client", 1.0) == "TimeoutError"
    network.set_link("server", True)
    assert asked(network, "client") == network.address("client")


def test_a_host_whose_cable_is_out_reaches_itself_alone(network: Network) -> None:
    network.set_link("client", False)
    assert asked(network, "client", 1.0) == "TimeoutError"
    assert asked(network, "gateway") == network.address("gateway")
    network.set_link("client", True)
    assert asked(network, "client") == network.address("client")
    network.set_link("server", False)
    assert asked(network, "server") == network.address("server")
