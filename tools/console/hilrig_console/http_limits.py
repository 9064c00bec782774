"""HTTP protocol of the console with a time limit for requests and limits for connections, in total and per host.

uvicorn waits for the rest of a request without a limit: a client that sends half a request on each of a thousand
connections would take all file descriptors of the process.
"""

import asyncio
from collections import Counter
from typing import ClassVar, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_TIMEOUT_S: Final = 10.0
"""Time in which a request, header and body, must be received."""
MAX_CONNECTIONS: Final = 512
"""Maximum number of connections; below the usual soft limit of open files."""
MAX_CONNECTIONS_PER_HOST: Final = 256
"""Maximum number of connections of one host, which may be a proxy of all browsers."""


class LimitedProtocol(H11Protocol):
    """The protocol of one connection."""

    connections_of: ClassVar[Counter[str]] = Counter()
    """Open connections by host."""
    _host: str = ""
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See `asyncio.Protocol.connection_made`."""
        super().connection_made(transport)
        self._host = str((transport.get_extra_info("peername") or ("",))[0])
        self.connections_of[self._host] += 1
        if self.connections_of[self._host] > MAX_CONNECTIONS_PER_HOST or self.connections_of.total() > MAX_CONNECTIONS:
            transport.abort()
        else:
            self._update_timer()

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol.data_received`."""
        super().data_received(data)
        self._update_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol.connection_lost`."""
        self.connections_of[self._host] -= 1
        if not self.connections_of[self._host]:
            del self.connections_of[self._host]
        if self._timer is not None:
            self._timer.cancel()
        super().connection_lost(exc)

    def _update_timer(self) -> None:
        """Start the timer of an incomplete request, which it ends; uvicorn closes idle connections itself."""
        is_incomplete = self.conn.their_state in (h11.IDLE, h11.SEND_BODY)
        if is_incomplete and self._timer is None:
            self._timer = self.loop.call_later(REQUEST_TIMEOUT_S, self.transport.abort)
        elif not is_incomplete and self._timer is not None:
            self._timer.cancel()
            self._timer = None
