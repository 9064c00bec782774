"""The edge's event loop: asyncio with exact timers, and a transport of TCP connections with its own receive call.

asyncio's own transports are not used for plain connections: this transport has its own receive call, which kernel
timestamps need, and costs less per request (ADR 0027).
"""

import asyncio
import logging
import select
import selectors
import socket
from collections.abc import Callable
from typing import Any, Final

HIGH_WATER: Final = 65_536
LOW_WATER: Final = 16_384
"""Bytes in the send buffer: above the first limit the protocol is paused, below the second it is resumed."""
ACCEPT_RETRY_S: Final = 1.0
"""Pause after a connection could not be accepted, s."""

logger = logging.getLogger(__name__)


class ExactSelector(selectors.DefaultSelector):
    """Selector with exact timeouts; the standard library rounds timeouts of epoll up to whole milliseconds."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """See `selectors.BaseSelector.select`."""
        if timeout is not None and timeout > 0 and hasattr(select, "epoll"):
            # The epoll handle is older than all connections, so its number is small enough for `select`.
            select.select((self,), (), (), timeout)
            timeout = 0
        return super().select(timeout)


def new_event_loop() -> asyncio.SelectorEventLoop:
    """Return an asyncio event loop with exact timers."""
    return asyncio.SelectorEventLoop(ExactSelector())


class SocketTransport(asyncio.Transport):
    """Transport of one TCP connection; its protocol is an `asyncio.BufferedProtocol`, set by `set_protocol`."""

    def __init__(self, loop: asyncio.AbstractEventLoop, connected: socket.socket, peer: Any) -> None:
        super().__init__({"socket": connected, "peername": peer})
        connected.setblocking(False)
        self._loop = loop
        self._socket = connected
        self._receive_into = connected.recv_into
        self._send = connected.send
        self._protocol: asyncio.BufferedProtocol | None = None
        self._send_buffer = bytearray()
        self._reading_enabled = True
        self._protocol_paused = False
        self._closing = False
        self._lost = False
        self._reader_added = False
        self._writer_added = False

    # -- the interface of asyncio's transports

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Set the protocol; the first one starts reading."""
        assert isinstance(protocol, asyncio.BufferedProtocol)
        self._protocol = protocol
        self._get_buffer, self._buffer_updated = protocol.get_buffer, protocol.buffer_updated
        self._update_events()

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Send as much as the socket accepts now, and buffer the rest."""
        if not self._send_buffer:
            if self._lost:
                return
            try:
                sent = self._send(data)
            except (BlockingIOError, InterruptedError):
                sent = 0
            except OSError as error:
                self._abort(error)
                return
            if sent == len(data):
                return
            data = memoryview(data)[sent:]
        self._send_buffer += data
        self._update_events()
        if len(self._send_buffer) > HIGH_WATER and not self._protocol_paused and self._protocol is not None:
            self._protocol_paused = True
            self._protocol.pause_writing()

    def pause_reading(self) -> None:
        """Leave received bytes in the socket."""
        self._reading_enabled = False
        self._update_events()

    def resume_reading(self) -> None:
        """Read again."""
        self._reading_enabled = True
        self._update_events()

    def is_closing(self) -> bool:
        """Whether the connection is closed, or will be when the send buffer is empty."""
        return self._closing

    def close(self) -> None:
        """Stop reading, send the rest of the send buffer, then close."""
        if not self._closing:
            self._closing = True
            self._update_events()
            if not self._send_buffer:
                self._abort(None)

    def abort(self) -> None:
        """Close at once."""
        self._abort(None)

    # -- events of the socket

    def _update_events(self) -> None:
        """Register with the event loop for the events that are needed now."""
        reads = self._reading_enabled and not self._closing and self._protocol is not None
        if reads != self._reader_added:
            self._reader_added = reads
            if reads:
                self._loop.add_reader(self._socket, self._on_event, self._read)
            else:
                self._loop.remove_reader(self._socket)
        writes = bool(self._send_buffer)
        if writes != self._writer_added:
            self._writer_added = writes
            if writes:
                self._loop.add_writer(self._socket, self._on_event, self._flush)
            else:
                self._loop.remove_writer(self._socket)

    def _on_event(self, handle: Callable[[], None]) -> None:
        try:
            handle()
        except Exception as error:
            logger.exception("connection %s closed: internal error", self.get_extra_info("peername"))
            self._abort(error)

    def _read(self) -> None:
        try:
            count = self._receive_into(self._get_buffer(-1))
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._abort(error)
            return
        if count:
            self._buffer_updated(count)
        else:
            self.close()

    def _flush(self) -> None:
        try:
            sent = self._send(self._send_buffer)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._abort(error)
            return
        del self._send_buffer[:sent]
        if self._protocol_paused and len(self._send_buffer) <= LOW_WATER and self._protocol is not None:
            self._protocol_paused = False
            self._protocol.resume_writing()
        self._update_events()
        if self._closing and not self._send_buffer:
            self._abort(None)

    def _abort(self, error: Exception | None) -> None:
        if self._lost:
            return
        self._lost = self._closing = True
        self._send_buffer.clear()
        self._update_events()
        # Later, as asyncio does it: a caller that closes a connection is not notified within its own call.
        self._loop.call_soon(self._notify_connection_lost, error)

    def _notify_connection_lost(self, error: Exception | None) -> None:
        try:
            if self._protocol is not None:
                self._protocol.connection_lost(error)
        finally:
            self._socket.close()


async def accept_connections(listening: socket.socket, on_accept: Callable[[SocketTransport], None]) -> None:
    """Pass each accepted connection to `on_accept`, until the task is canceled."""
    loop = asyncio.get_running_loop()
    listening.setblocking(False)
    while True:
        try:
            connected, peer = await loop.sock_accept(listening)
        except OSError as error:
            # Out of handles or memory: new connections wait in the backlog.
            logger.warning(
                "can't accept a connection on %s: %s; retrying in %g s",
                listening.getsockname(),
                error,
                ACCEPT_RETRY_S,
            )
            await asyncio.sleep(ACCEPT_RETRY_S)
            continue
        on_accept(SocketTransport(loop, connected, peer))
        # A flood of connections must not delay the requests of established ones.
        await asyncio.sleep(0)
