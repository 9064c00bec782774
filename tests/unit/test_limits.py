"""Unit tests of messages for exhausted system resources and unavailable addresses."""

import errno
import os
import subprocess
import sys

import pytest

from hilrig_modbus_edge.server.listener import bind
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.bus.zenoh_config import unknown_host
from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.shutdown import run_main
from support.labs import free_ports


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "out of memory or threads"),
        (RuntimeError("can't start new thread"), "out of memory or threads"),
        (OSError(errno.EMFILE, os.strerror(errno.EMFILE)), "too many open files"),
    ],
)
def test_exhausted_resource_is_reported_in_one_line(
    capsys: pytest.CaptureFixture[str], error: Exception, words: str
) -> None:
    def main() -> int:
        raise error

    assert run_main(main) == 3
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("hilrig: error: ")
    assert words in line


def test_other_errors_are_not_caught() -> None:
    def main() -> int:
        raise RuntimeError("a mistake in the program")

    with pytest.raises(RuntimeError, match="a mistake"):
        run_main(main)


@pytest.mark.parametrize(
    ("host", "words"),
    [
        ("192.0.2.1", "Cannot assign requested address; edge.host, or `host` of the rig, in lab.toml must be an"),
        ("no-such-host.invalid", "edge.host, or `host` of the rig, in lab.toml must be an address of this host"),
    ],
)
def test_address_of_another_host_is_reported(host: str, words: str) -> None:
    with pytest.raises(OperationError) as caught:
        bind("rig1", host, free_ports(1))
    if sys.platform == "linux" or host != "192.0.2.1":
        assert words in str(caught.value)
    assert "while attempting" not in str(caught.value)


def test_port_in_use_is_reported() -> None:
    port = free_ports(1)
    with (
        bind("rig1", "127.0.0.1", port),
        pytest.raises(OperationError, match=r"in use; is another hilrig running here\? Stop the program"),
    ):
        bind("rig2", "127.0.0.1", port)


def test_unknown_router_name_is_reported() -> None:
    bus = parse_lab('[bus]\ntopology = "router"\nrouter = "tcp/no-such-host.invalid:7447"\n').bus
    with pytest.raises(OperationError, match=r"unknown host name 'no-such-host\.invalid'"):
        ZenohBus(bus, "tool")


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:7447", "tls/[::1]:7447", "tcp/localhost:1?rel=1"])
def test_known_host_is_not_reported(endpoint: str) -> None:
    assert unknown_host(BusConfig(router=endpoint).router_host) == ""


LIMITS = """
import resource
from hilrig_runtime.process.lifecycle import allow_open_files
_, most = resource.getrlimit(resource.RLIMIT_NOFILE)
most = min(most, 4096)
resource.setrlimit(resource.RLIMIT_NOFILE, (64, most))
allow_open_files()
print(resource.getrlimit(resource.RLIMIT_NOFILE) == (most, most))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_service_raises_its_limit_of_open_files() -> None:
    done = subprocess.run([sys.executable, "-c", LIMITS], check=True, capture_output=True, text=True, timeout=60)
    assert done.stdout == "True\n"
