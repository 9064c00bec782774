"""HTTP protocol of the console with a time limit for requests and limits for connections, in total and per host.

uvicorn waits for the rest of a request without a limit, and for the TLS handshake for a minute: a client that sends
half a request on each of a thousand connections would take all file descriptors of the process. Connections that wait
for a request have limits of their own. Beyond a limit the oldest one is closed, so that a new browser is served.
"""

import asyncio
import ssl
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from hilrig_runtime.pending_connections import PendingConnections

REQUEST_TIMEOUT_S: Final = 10.0
"""Time in which a request, header and body, must be received; with TLS, also the handshake."""
MAX_CONNECTIONS: Final = 512
"""Maximum number of connections."""
MAX_CONNECTIONS_PER_HOST: Final = 256
"""Maximum number of connections of one host, which may be a proxy of all browsers."""


class ConnectionTable:
    """The connections of one server; at most half of them wait for a request."""

    def __init__(self, limit: int = MAX_CONNECTIONS, limit_per_host: int = MAX_CONNECTIONS_PER_HOST) -> None:
        limit_per_host = min(limit, limit_per_host)
        self.open: PendingConnections[LimitedProtocol] = PendingConnections(limit, limit_per_host)
        """All connections: many that do not read their responses give way, too."""
        self.waiting: PendingConnections[LimitedProtocol] = PendingConnections(
            max(1, limit // 2), max(1, limit_per_host // 2)
        )


class LimitedProtocol(H11Protocol):
    """The protocol of one connection; with a TLS context it does the handshake first."""

    def __init__(self, table: ConnectionTable, context: ssl.SSLContext | None = None, **uvicorn: Any) -> None:
        super().__init__(**uvicorn)
        self._table = table
        self._context = context
        self._host = ""
        self._is_secured = context is None
        self._early = b""
        self._handshake: asyncio.Task[None] | None = None
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See `asyncio.Protocol.connection_made`."""
        self._host = str((transport.get_extra_info("peername") or ("",))[0])
        self.transport = transport
        self._make_room(self._table.open)
        self._wait()
        if self._context is None:
            super().connection_made(transport)
        else:
            self._handshake = self.loop.create_task(self._secure(transport, self._context))

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol.data_received`."""
        if not self._is_secured:
            # The first bytes of a request may arrive with the end of the handshake.
            self._early += data
            return
        super().data_received(data)
        if self._is_waiting():
            self._wait()
        else:
            self._stop_waiting()

    def on_response_complete(self) -> None:
        """See `H11Protocol.on_response_complete`."""
        super().on_response_complete()
        if self._is_waiting() and not self.transport.is_closing():
            self._wait()

    def pause_writing(self) -> None:
        """See `asyncio.Protocol.pause_writing`: the client reads its response slowly."""
        super().pause_writing()
        self._stop_waiting()

    def resume_writing(self) -> None:
        """See `asyncio.Protocol.resume_writing`."""
        super().resume_writing()
        if self._is_waiting():
            self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol.connection_lost`."""
        self._forget()
        if self._is_secured:
            super().connection_lost(exc)

    async def _secure(self, transport: asyncio.Transport, context: ssl.SSLContext) -> None:
        try:
            secured = await self.loop.start_tls(
                transport, self, context, server_side=True, ssl_handshake_timeout=REQUEST_TIMEOUT_S
            )
        except (OSError, TimeoutError):
            secured = None
        # asyncio raises no exception if the peer disconnects during the handshake.
        if secured is None or secured.is_closing():
            self._drop()
            return
        self._is_secured = True
        super().connection_made(secured)
        if self._early:
            self.data_received(self._early)

    def _is_waiting(self) -> bool:
        """Return whether the rest of a request is missing, or the next one after the response was sent."""
        return self.conn.their_state in (h11.IDLE, h11.SEND_BODY) and not self.flow.write_paused

    def _wait(self) -> None:
        """Start to wait for a request, unless it has begun."""
        if self._timer is not None:
            return
        self._timer = self.loop.call_later(REQUEST_TIMEOUT_S, self._drop)
        self._make_room(self._table.waiting)

    def _make_room(self, connections: "PendingConnections[LimitedProtocol]") -> None:
        """Add the connection; close an older one beyond a limit."""
        oldest = connections.add(self, self._host)
        if oldest is not None:
            oldest._drop()

    def _stop_waiting(self) -> None:
        self._table.waiting.discard(self)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _drop(self) -> None:
        """Close the connection at once."""
        self._forget()
        if self._handshake is not None:
            self._handshake.cancel()
        self.transport.abort()

    def _forget(self) -> None:
        """Remove the connection from the table: at once, because many may be accepted before it is lost."""
        self._stop_waiting()
        self._table.open.discard(self)
