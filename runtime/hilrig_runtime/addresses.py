"""Human-readable TCP addresses: notation, those that reach a listening socket, the fix if one can't be bound."""

import errno
import socket
import struct
import sys
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import IPv4Address, ip_address
from pathlib import Path
from typing import Final

WILDCARDS: Final = frozenset({"", "0.0.0.0", "::"})
"""Hosts that mean all addresses of this host."""
PRIVILEGED_PORTS: Final = 1024
"""On Linux, a lower port needs a permission."""
_SIOCGIFADDR: Final = 0x8915
_IF_INET6: Final = Path("/proc/net/if_inet6")


def format_address(host: str, port: int) -> str:
    """Return "host:port"; an IPv6 host is put in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def plain_host(host: str) -> str:
    """Return the host of a peer; a dual-stack socket maps those of IPv4 to IPv6."""
    mapped = host.removeprefix("::ffff:")
    return mapped if "." in mapped else host


def reachable_hosts(host: str) -> list[str]:
    """Return the hosts that reach a socket on `host`; of a wildcard: the addresses of this host, and its name."""
    if host not in WILDCARDS:
        return [host]
    addresses = [one for one in map(ip_address, _interface_addresses()) if not one.is_loopback]
    if host == "0.0.0.0":
        addresses = [one for one in addresses if isinstance(one, IPv4Address)]
    return [*dict.fromkeys(map(str, addresses)), socket.gethostname()]


def listen_reason(error: OSError) -> str:
    """Return the reason why a socket can't listen, without the address that Python appends to it."""
    return (error.strerror or str(error)).partition(" (while")[0]


def listen_hint(error: OSError, port: int, host_key: str, port_key: str) -> str:
    """Return what to do if a socket can't listen; the keys of lab.toml are those that host and port come from."""
    if isinstance(error, socket.gaierror) or error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
        return f"{host_key} in lab.toml must be an address of this host"
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return "allow more open files (ulimit -n, or LimitNOFILE of the service)"
    if error.errno == errno.EACCES and port < PRIVILEGED_PORTS:
        return (
            f"on Linux, ports below {PRIVILEGED_PORTS} need a permission (docs/operations.md, Port 502); or choose "
            f"another port in lab.toml ({port_key})"
        )
    if error.errno == errno.EADDRINUSE:
        return (
            "is another hilrig running here? Stop the program that uses the port, or choose another port in lab.toml "
            f"({port_key})"
        )
    return f"choose another address or port in lab.toml ({host_key}, {port_key})"


def _interface_addresses() -> Iterator[str]:
    """Yield the addresses of the network interfaces; on systems other than Linux, those of the host's name."""
    if sys.platform != "linux":
        with suppress(OSError):
            yield from (str(info[4][0]).partition("%")[0] for info in socket.getaddrinfo(socket.gethostname(), None))
        return
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            # An interface without an IPv4 address.
            with suppress(OSError):
                reply = fcntl.ioctl(probe, _SIOCGIFADDR, struct.pack("256s", name.encode()[:15]))
                yield socket.inet_ntoa(reply[20:24])
    with suppress(OSError):
        for line in _IF_INET6.read_text().splitlines():
            digits, _, _, scope, *_ = line.split()
            if int(scope, 16) == 0:
                yield socket.inet_ntop(socket.AF_INET6, bytes.fromhex(digits))
