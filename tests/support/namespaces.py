"""Emulated hosts on one machine: network namespaces around a gateway, with name resolution as on a compose network.

A veth pair connects each host to the gateway, which forwards packets. No bridge is needed: containers and small
kernels often do not support bridges. Needs root and iproute2. On exit of the context all namespaces are removed, and
all processes that were started in it are ended by their ids.
"""

import os
import shutil
import subprocess
from contextlib import ExitStack
from functools import cache
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest


def require_namespaces() -> None:
    """Skip the test if network namespaces are unavailable."""
    if reason := _missing():
        pytest.skip(reason)


@cache
def _missing() -> str | None:
    """Reason why network namespaces are unavailable, found by creating a network once; None if they are available."""
    if os.name != "posix" or os.geteuid() != 0:
        return "needs root to create network namespaces"
    if shutil.which("ip") is None:
        return "needs `ip` (Debian package iproute2)"
    try:
        with Network(["near", "far"]) as network:
            network.run("near", ["getent", "hosts", "far"], capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        output = " ".join((error.stderr or "").split()) or f"exit code {error.returncode}"
        need = "network namespaces and veth pairs (CAP_SYS_ADMIN, CAP_NET_ADMIN)"
        return f"needs {need}; `{' '.join(error.cmd)}` failed: {output}"
    return None


_NUMBERS = count()
_NET = "10.77.0.0/24"
_GATEWAY = "10.77.0.1"


class Network:
    """Context manager of hosts by name, each in its own namespace, around one gateway."""

    def __init__(self, hosts: list[str]) -> None:
        self._prefix = f"hr{os.getpid()}n{next(_NUMBERS)}"
        self._addresses = {host: f"10.77.0.{number}" for number, host in enumerate(hosts, start=10)}
        self._closing = ExitStack()

    def address(self, host: str) -> str:
        """IP address of a host."""
        return self._addresses[host]

    def popen(self, host: str, command: list[str], **options: Any) -> subprocess.Popen[Any]:
        """Start a process on a host; it is ended on exit of the context if it is still running."""
        process = subprocess.Popen([*self._enter(host), *command], **options)
        self._closing.callback(_end, process)
        return process

    def run(
        self, host: str, command: list[str], *, check: bool = True, **options: Any
    ) -> subprocess.CompletedProcess[Any]:
        """Run a command on a host and wait until it exits."""
        return subprocess.run([*self._enter(host), *command], check=check, **options)

    def call(self, host: str, command: list[str]) -> int:
        """Run a command on a host without output; returns its exit code."""
        return subprocess.run([*self._enter(host), *command], check=False, capture_output=True).returncode

    def set_link(self, host: str, up: bool) -> None:
        """Set a host's link up or down; packets to a host whose link is down are dropped silently."""
        _ip("-n", self._gateway, "link", "set", self._port(host), "up" if up else "down")

    def __enter__(self) -> Self:
        try:
            self._build()
        except BaseException:
            self._closing.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.close()

    def _build(self) -> None:
        self._add_namespace(self._gateway)
        _ip("netns", "exec", self._gateway, "sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")
        # Packets to a host whose link is down are dropped without an ICMP error.
        _ip("-n", self._gateway, "route", "add", "blackhole", _NET)
        names = "127.0.0.1 localhost\n" + "".join(f"{address} {host}\n" for host, address in self._addresses.items())
        for host, address in self._addresses.items():
            namespace, port = self._namespace(host), self._port(host)
            self._add_namespace(namespace)
            # `ip netns exec` mounts this file as /etc/hosts.
            etc = Path("/etc/netns") / namespace
            etc.mkdir(parents=True)
            self._closing.callback(shutil.rmtree, etc, ignore_errors=True)
            (etc / "hosts").write_text(names)
            _ip("-n", self._gateway, "link", "add", port, "type", "veth", "peer", "name", "eth0", "netns", namespace)
            _ip("-n", self._gateway, "addr", "add", _GATEWAY, "peer", address, "dev", port)
            _ip("-n", self._gateway, "link", "set", port, "up")
            _ip("-n", namespace, "addr", "add", address, "peer", _GATEWAY, "dev", "eth0")
            _ip("-n", namespace, "link", "set", "eth0", "up")
            _ip("-n", namespace, "link", "set", "lo", "up")
            _ip("-n", namespace, "route", "add", _NET, "via", _GATEWAY)

    @property
    def _gateway(self) -> str:
        return self._prefix

    def _enter(self, host: str) -> list[str]:
        """Begin of a command line that is executed on a host, with its name as the host name."""
        named = ["unshare", "--uts", "sh", "-c", 'echo "$0" > /proc/sys/kernel/hostname; exec "$@"', host]
        return ["ip", "netns", "exec", self._namespace(host), *named]

    def _namespace(self, host: str) -> str:
        return f"{self._prefix}-{host}"

    def _port(self, host: str) -> str:
        # Interface names have at most 15 characters.
        return f"p{list(self._addresses).index(host)}"

    def _add_namespace(self, name: str) -> None:
        _ip("netns", "add", name)
        self._closing.callback(subprocess.run, ["ip", "netns", "delete", name], check=False)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


def _end(process: subprocess.Popen[Any]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
