"""Event loop of the edge: asyncio with a selector that serves plain Modbus connections itself, and exact timers.

asyncio queues a handle for each ready socket, runs it in a context, and calls the transport, then the protocol. This
takes as much time as a Modbus request. Here a ready socket is read and answered inside `select()` (ADR 0027). The
transport has its own receive call, which returns the kernel's receive timestamps.
"""

import asyncio
import logging
import os
import select
import selectors
import socket
import struct
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from contextvars import Context
from selectors import EVENT_READ, EVENT_WRITE
from time import monotonic, monotonic_ns, time_ns
from typing import Any, Final, TypeVarTuple

from hilrig_runtime.timing.rate_limiter import RateLimiter, repeat_suffix

HIGH_WATER: Final = 65_536
LOW_WATER: Final = 16_384
"""Bytes in the send buffer: above the first limit the protocol is paused, below the second it is resumed."""
ACCEPT_RETRY_S: Final = 1.0
"""Pause after a connection could not be accepted, s."""
ACCEPT_LOG_PERIOD_NS: Final = 10_000_000_000
"""Shortest time between two log messages about it, of all listening sockets, ns."""
OnAccept = Callable[[socket.socket, Any], Awaitable[None]]
"""Called with an accepted connection and the address of its peer."""

_RECEIVE_BYTES: Final = 448
"""Maximum number of bytes of one call. Python allocates an object of up to 512 bytes 0.1 µs faster."""
_MS: Final = 0.001
_NEARLY_MS: Final = 0.000_999
_SO_TIMESTAMPNS: Final = 35
"""Number of the socket option on Linux that stamps received data; the module `socket` has no name for it."""
_TIMESPEC: Final = struct.Struct("=qq")
_unpack_timespec = _TIMESPEC.unpack
_ANCILLARY_BYTES: Final = socket.CMSG_SPACE(_TIMESPEC.size) if hasattr(socket, "CMSG_SPACE") else 0
_Args = TypeVarTuple("_Args")
_Ready = list[tuple[int, int]]
"""File descriptors and their events as the system reports them."""

logger = logging.getLogger(__name__)


class DirectSelector(selectors.DefaultSelector):
    """Selector of an asyncio event loop that serves sockets inside `select()` (in-selector I/O), with exact timeouts.

    A socket that was registered with a function is served by calling it, and the selector keeps waiting. asyncio gets
    only the events of its own sockets, and control when there is work for it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.asyncio_has_work = False
        """Whether asyncio got a callback or timer since `select` was called: `select` returns to it."""
        self._callbacks: dict[int, Callable[[int], None]] = {}
        """By file descriptor: callback of a socket that is served here."""
        self._poll: Callable[[float | None], _Ready] = _epoll_of(self) if hasattr(select, "epoll") else self._super_poll

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        """See `selectors.BaseSelector.register`; `data` that is callable is called with the events."""
        key = super().register(fileobj, events, data)
        # asyncio's own data is a pair of handles.
        if callable(data):
            self._callbacks[key.fd] = data
        return key

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        """See `selectors.BaseSelector.unregister`."""
        key = super().unregister(fileobj)
        self._callbacks.pop(key.fd, None)
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """See `selectors.BaseSelector.select`; sockets that are served here do not end the wait."""
        poll, callback_of = self._poll, self._callbacks.get
        deadline_s = None if timeout is None else monotonic() + timeout
        others: list[tuple[selectors.SelectorKey, int]] = []
        self.asyncio_has_work = False
        while True:
            for descriptor, mask in poll(timeout):
                callback = callback_of(descriptor)
                # Fast path: nearly all events are read events.
                events = EVENT_READ if mask == EVENT_READ else _events_of(mask)
                if callback is not None:
                    callback(events)
                elif (key := self.get_map().get(descriptor)) is not None and events & key.events:
                    others.append((key, events & key.events))
            if others or self.asyncio_has_work:
                return others
            if deadline_s is not None:
                timeout = deadline_s - monotonic()
                if timeout <= 0:
                    return others

    def _super_poll(self, timeout: float | None) -> _Ready:
        return [(key.fd, events) for key, events in super().select(timeout)]


if hasattr(select, "epoll"):

    def _epoll_of(selector: selectors.DefaultSelector) -> Callable[[float | None], _Ready]:
        """Return a function that waits for events, possibly for less than its timeout.

        The standard library creates a key for each event, which takes longer than the system call.
        """
        # A duplicate descriptor of the epoll set, because `select.epoll` closes its descriptor. It is older than all
        # connections, so its number is small enough for `select.select`.
        epoll = select.epoll.fromfd(os.dup(selector.fileno()))
        poll, own_descriptor, wait = epoll.poll, (epoll,), select.select

        def poll_for(timeout: float | None) -> _Ready:
            if timeout is None:
                return poll()
            if timeout >= _MS:
                # epoll counts whole milliseconds and rounds up: a millisecond less, nearly, gives no more than remain.
                return poll(timeout - _NEARLY_MS)
            if timeout > 0:
                wait(own_descriptor, (), (), timeout)
            return poll(0)

        return poll_for

    def _events_of(mask: int) -> int:
        return (EVENT_READ if mask & ~select.EPOLLOUT else 0) | (EVENT_WRITE if mask & ~select.EPOLLIN else 0)

    assert select.EPOLLIN == EVENT_READ
else:

    def _events_of(mask: int) -> int:
        return mask


class DirectEventLoop(asyncio.SelectorEventLoop):
    """An asyncio event loop on a `DirectSelector`."""

    def __init__(self) -> None:
        self.direct = DirectSelector()
        self.accept_failures: RateLimiter[None] = RateLimiter(ACCEPT_LOG_PERIOD_NS)
        super().__init__(self.direct)

    def call_soon(
        self, callback: Callable[[*_Args], object], *args: *_Args, context: Context | None = None
    ) -> asyncio.Handle:
        """See `asyncio.loop.call_soon`."""
        self.direct.asyncio_has_work = True
        return super().call_soon(callback, *args, context=context)

    def call_at(
        self, when: float, callback: Callable[[*_Args], object], *args: *_Args, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """See `asyncio.loop.call_at`, which `call_later` uses too."""
        self.direct.asyncio_has_work = True
        return super().call_at(when, callback, *args, context=context)


class SocketTransport(asyncio.Transport):
    """Transport of one TCP connection; its protocol is an `asyncio.Protocol`, set by `set_protocol`."""

    def __init__(self, loop: DirectEventLoop, connected: socket.socket, peer: Any) -> None:
        super().__init__({"socket": connected, "peername": peer})
        connected.setblocking(False)
        self._loop = loop
        self._selector = loop.direct
        self._socket = connected
        self._receive = connected.recv
        self._receive_stamped = connected.recvmsg if _has_receive_timestamps(connected) else None
        self._ancillary: list[tuple[int, int, bytes]] = []
        self._send = connected.send
        self._protocol: asyncio.Protocol | None = None
        self._send_buffer = bytearray()
        self._reading_enabled = True
        self._protocol_paused = False
        self._closing = False
        self._lost = False
        self._events = 0

    # -- the interface of asyncio's transports

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Set the protocol; the first one starts reading."""
        assert isinstance(protocol, asyncio.Protocol)
        self._protocol = protocol
        self._data_received = protocol.data_received
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
        """Resume reading."""
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

    # -- timestamps

    def received_ns(self, earliest_ns: int, latest_ns: int) -> int:
        """Return when the kernel received the bytes that were read last, ns, monotonic clock; 0: unavailable.

        The kernel stamps with the wall clock. A result outside the two bounds proves that the wall clock was stepped
        in between, and is unavailable.
        """
        if not self._ancillary:
            return 0
        seconds, nanoseconds = _unpack_timespec(self._ancillary[0][2])
        wall_ns = seconds * 1_000_000_000 + nanoseconds
        received_ns: int = wall_ns - time_ns() + monotonic_ns()
        if not earliest_ns <= received_ns <= latest_ns:
            # Once more: the process may have been preempted between the two clocks.
            received_ns = wall_ns - time_ns() + monotonic_ns()
            if not earliest_ns <= received_ns <= latest_ns:
                return 0
        return received_ns

    # -- events of the socket

    def _update_events(self) -> None:
        """Register with the selector for the events that are needed now."""
        events = 0
        if not self._lost:
            if self._reading_enabled and not self._closing and self._protocol is not None:
                events = EVENT_READ
            if self._send_buffer:
                events |= EVENT_WRITE
        if events == self._events:
            return
        if not self._events:
            self._selector.register(self._socket, events, self._on_event)
        elif not events:
            self._selector.unregister(self._socket)
        else:
            self._selector.modify(self._socket, events, self._on_event)
        self._events = events

    def _on_event(self, events: int) -> None:
        # An earlier callback of the same poll may have closed this connection.
        events &= self._events
        try:
            if events & EVENT_READ:
                try:
                    if self._receive_stamped is None:
                        data = self._receive(_RECEIVE_BYTES)
                    else:
                        data, self._ancillary, _, _ = self._receive_stamped(_RECEIVE_BYTES, _ANCILLARY_BYTES)
                except (BlockingIOError, InterruptedError):
                    pass
                except OSError as error:
                    self._abort(error)
                else:
                    if data:
                        self._data_received(data)
                    else:
                        self.close()
            if events & EVENT_WRITE:
                self._flush()
        except Exception as error:
            logger.exception("connection %s closed: internal error", self.get_extra_info("peername"))
            self._abort(error)

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
        # In the next turn, as in asyncio: a caller that closes a connection is not notified within its own call.
        self._loop.call_soon(self._notify_connection_lost, error)

    def _notify_connection_lost(self, error: Exception | None) -> None:
        try:
            if self._protocol is not None:
                self._protocol.connection_lost(error)
        finally:
            self._socket.close()


def set_receive_timestamps(listening: socket.socket) -> None:
    """Let the kernel stamp received data on the connections of a listening socket, on systems that can."""
    if sys.platform == "linux":
        with suppress(OSError):
            listening.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def _has_receive_timestamps(connected: socket.socket) -> bool:
    # The fields of `struct timespec` have 64 bits where `long` has.
    if sys.platform != "linux" or struct.calcsize("l") != 8:
        return False
    return connected.getsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS) == 1


async def accept_connections(loop: DirectEventLoop, listening: socket.socket, on_accept: OnAccept) -> None:
    """Pass each accepted connection to `on_accept`, until the task is canceled."""
    listening.setblocking(False)
    while True:
        try:
            connected, peer = await loop.sock_accept(listening)
        except OSError as error:
            # Out of handles or memory: new connections wait in the backlog.
            count = loop.accept_failures.record(None, monotonic_ns())
            if count:
                logger.warning(
                    "can't accept connections, among others on %s: %s%s; retrying every %g s",
                    listening.getsockname(),
                    error,
                    repeat_suffix(count),
                    ACCEPT_RETRY_S,
                )
            await asyncio.sleep(ACCEPT_RETRY_S)
            continue
        try:
            await on_accept(connected, peer)
        except OSError:
            # The client has disconnected.
            connected.close()
        # A flood of connections must not delay the requests of established ones.
        await asyncio.sleep(0)
