"""Address on which a server of the tools listens: parsing, socket, and the URLs that reach it."""

import socket
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Final

from hilrig_runtime.addresses import format_address, listen_reason, reachable_hosts
from hilrig_runtime.errors import InputError, OperationError

_LOOPBACK_OF: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """Address and port on which a server listens."""

    host: str
    """0.0.0.0: all IPv4 addresses of this host; "::": those of IPv6 too."""
    port: int

    @classmethod
    def parse(cls, text: str) -> "ListenAddress":
        """Parse "HOST:PORT", "[ADDRESS]:PORT" or ":PORT".

        Raises:
            InputError: the text has none of these forms.
        """
        host, colon, port = text.rpartition(":")
        if not colon or not port.isascii() or not port.isdigit() or int(port) > 65535:
            raise InputError(
                f"--listen {text!r}: expected HOST:PORT with a port of 0 to 65535, for example 127.0.0.1:8050"
            )
        return cls(host.removeprefix("[").removesuffix("]") or "0.0.0.0", int(port))

    @property
    def is_loopback(self) -> bool:
        """Whether the address is reachable from this host only."""
        try:
            return ip_address(self.host.partition("%")[0]).is_loopback
        except ValueError:
            return self.host == "localhost"

    @property
    def local_host(self) -> str:
        """Host by which a client on this host reaches the server."""
        return _LOOPBACK_OF.get(self.host, self.host)

    def open_socket(self, backlog: int) -> socket.socket:
        """Open a listening socket.

        Raises:
            OperationError: the address is unavailable.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        dual = self.host == "::" and socket.has_dualstack_ipv6()
        try:
            return socket.create_server((self.host, self.port), family=family, backlog=backlog, dualstack_ipv6=dual)
        except OSError as error:
            where = format_address(self.host, self.port)
            raise OperationError(
                f"can't listen on {where}: {listen_reason(error)}; choose another address with --listen"
            ) from error

    def urls(self, port: int, scheme: str, path: str = "/") -> str:
        """Return the URLs that reach the server, for a message; `port`: that of its socket."""
        return " or ".join(f"{scheme}://{format_address(host, port)}{path}" for host in reachable_hosts(self.host))
