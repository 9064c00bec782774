"""TCP connections that the loop's selector serves itself, without asyncio's way around each event.

asyncio puts a handle into a queue for every socket that is ready, then runs it in a context, then asks the transport,
then the protocol: as much time as a Modbus request takes. Here a socket that is ready is read and answered where the
selector finds it, and the selector waits on; asyncio has its turn when there is something for it to do.
"""

import asyncio
import logging
import os
import select
import selectors
import socket
from collections.abc import Callable
from contextvars import Context
from selectors import EVENT_READ, EVENT_WRITE
from time import monotonic
from typing import Any, Final, TypeVarTuple

HIGH_WATER: Final = 65_536
LOW_WATER: Final = 16_384
"""Bytes that wait to be sent: above the one the protocol is told to pause, below the other to go on."""

_MS: Final = 0.001
_Args = TypeVarTuple("_Args")
_Events = list[tuple[selectors.SelectorKey, int]]
_Ready = list[tuple[int, int]]
"""Handles and what they are ready for, as the system says it."""

logger = logging.getLogger(__name__)


class DirectSelector(selectors.DefaultSelector):
    """A selector for an asyncio loop that calls what was registered with a function, and tells asyncio of the rest.

    It waits to the moment that asyncio names, where the standard library's waits for whole milliseconds.
    """

    def __init__(self) -> None:
        super().__init__()
        self.asyncio_has_work = False
        """Something was asked of asyncio since it began to wait: it must have its turn before it waits on."""
        self._calls: dict[int, Callable[[int], None]] = {}
        """By handle, what to call with the events."""
        self._poll: Callable[[float | None], _Ready] = _epoll_of(self) if hasattr(select, "epoll") else self._super_poll

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        """See `selectors.BaseSelector.register`; `data` that can be called is called with the events."""
        key = super().register(fileobj, events, data)
        # asyncio's own data is a pair of handles.
        if callable(data):
            self._calls[key.fd] = data
        return key

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        """See `selectors.BaseSelector.unregister`."""
        key = super().unregister(fileobj)
        self._calls.pop(key.fd, None)
        return key

    def select(self, timeout: float | None = None) -> _Events:
        """See `selectors.BaseSelector.select`; what is called meanwhile does not end the wait."""
        poll, call_of = self._poll, self._calls.get
        deadline_s = None if timeout is None else monotonic() + timeout
        others: _Events = []
        self.asyncio_has_work = False
        while True:
            for handle, mask in poll(timeout):
                call = call_of(handle)
                # By far the most often there is something to read and nothing else.
                events = EVENT_READ if mask == EVENT_READ else _events_of(mask)
                if call is not None:
                    call(events)
                elif (key := self.get_map().get(handle)) is not None and events & key.events:
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
        """A wait for what is ready, which may end before its time and with nothing.

        To let the standard library make a key of each event takes longer than to ask the system.
        """
        # A handle of its own to the same set, for it is closed with this object. It is older than all connections: its
        # number is one of those that `select` can wait for.
        epoll = select.epoll.fromfd(os.dup(selector.fileno()))
        poll, itself, wait = epoll.poll, (epoll,), select.select

        def poll_for(timeout: float | None) -> _Ready:
            if timeout is None:
                return poll()
            if timeout >= _MS:
                # The system counts in whole milliseconds here: not one more than is left.
                return poll(int(timeout / _MS) * _MS - _MS / 2)
            if timeout > 0:
                wait(itself, (), (), timeout)
            return poll(0)

        return poll_for

    def _events_of(mask: int) -> int:
        return (EVENT_READ if mask & ~select.EPOLLOUT else 0) | (EVENT_WRITE if mask & ~select.EPOLLIN else 0)

    assert select.EPOLLIN == EVENT_READ
else:

    def _events_of(mask: int) -> int:
        return mask


class DirectLoop(asyncio.SelectorEventLoop):
    """An asyncio loop on a `DirectSelector`."""

    def __init__(self) -> None:
        self.direct = DirectSelector()
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
        """See `asyncio.loop.call_at`; `call_later` is this, too."""
        self.direct.asyncio_has_work = True
        return super().call_at(when, callback, *args, context=context)


class DirectTransport(asyncio.Transport):
    """One TCP connection on a `DirectLoop`, for an `asyncio.BufferedProtocol` that `set_protocol` names."""

    def __init__(self, loop: DirectLoop, connected: socket.socket, peer: Any) -> None:
        super().__init__({"socket": connected, "peername": peer})
        connected.setblocking(False)
        self._loop = loop
        self._selector = loop.direct
        self._socket = connected
        self._receive_into = connected.recv_into
        self._send = connected.send
        self._protocol: asyncio.BufferedProtocol | None = None
        self._waiting = bytearray()
        self._wanted = 0
        self._reading = True
        self._protocol_paused = False
        self._closing = False
        self._lost = False

    # -- what asyncio's transports do

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Name the protocol; reading begins with the first."""
        assert isinstance(protocol, asyncio.BufferedProtocol)
        self._protocol = protocol
        self._get_buffer, self._buffer_updated = protocol.get_buffer, protocol.buffer_updated
        self._want()

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Send what goes at once; what does not waits."""
        if not self._waiting:
            if self._lost:
                return
            try:
                sent = self._send(data)
            except (BlockingIOError, InterruptedError):
                sent = 0
            except OSError as error:
                self._lose(error)
                return
            if sent == len(data):
                return
            data = memoryview(data)[sent:]
        self._waiting += data
        self._want()
        if len(self._waiting) > HIGH_WATER and not self._protocol_paused and self._protocol is not None:
            self._protocol_paused = True
            self._protocol.pause_writing()

    def pause_reading(self) -> None:
        """Leave what comes in to the system."""
        self._reading = False
        self._want()

    def resume_reading(self) -> None:
        """Read again."""
        self._reading = True
        self._want()

    def is_closing(self) -> bool:
        """Whether it is closed, or will be when everything is sent."""
        return self._closing

    def close(self) -> None:
        """Read no more, send what waits, then close."""
        if not self._closing:
            self._closing = True
            self._want()
            if not self._waiting:
                self._lose(None)

    def abort(self) -> None:
        """Close at once."""
        self._lose(None)

    # -- inside

    def _want(self) -> None:
        """Tell the selector what is waited for."""
        wanted = 0
        if not self._lost:
            if self._reading and not self._closing and self._protocol is not None:
                wanted = EVENT_READ
            if self._waiting:
                wanted |= EVENT_WRITE
        if wanted == self._wanted:
            return
        if not self._wanted:
            self._selector.register(self._socket, wanted, self._on_event)
        elif not wanted:
            self._selector.unregister(self._socket)
        else:
            self._selector.modify(self._socket, wanted, self._on_event)
        self._wanted = wanted

    def _on_event(self, events: int) -> None:
        # Whoever was served before in the same turn may have closed this one.
        events &= self._wanted
        try:
            if events & EVENT_READ:
                self._read()
            if events & EVENT_WRITE:
                self._flush()
        except Exception as error:
            logger.exception("serving %s failed; its connection is closed", self.get_extra_info("peername"))
            self._lose(error)

    def _read(self) -> None:
        try:
            count = self._receive_into(self._get_buffer(-1))
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(error)
            return
        if count:
            self._buffer_updated(count)
        else:
            self.close()

    def _flush(self) -> None:
        try:
            sent = self._send(self._waiting)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(error)
            return
        del self._waiting[:sent]
        if self._protocol_paused and len(self._waiting) <= LOW_WATER and self._protocol is not None:
            self._protocol_paused = False
            self._protocol.resume_writing()
        self._want()
        if self._closing and not self._waiting:
            self._lose(None)

    def _lose(self, error: Exception | None) -> None:
        if self._lost:
            return
        self._lost = self._closing = True
        self._waiting.clear()
        self._want()
        # Later, as asyncio does it: whoever closes a connection does not expect to hear of it meanwhile.
        self._loop.call_soon(self._say_lost, error)

    def _say_lost(self, error: Exception | None) -> None:
        try:
            if self._protocol is not None:
                self._protocol.connection_lost(error)
        finally:
            self._socket.close()


async def accept_connections(
    loop: DirectLoop, listening: socket.socket, take: Callable[[DirectTransport], None]
) -> None:
    """Give every connection that comes to `take`, until cancelled."""
    listening.setblocking(False)
    while True:
        try:
            connected, peer = await loop.sock_accept(listening)
        except OSError as error:
            # Out of handles or memory: who has connected waits in the backlog.
            logger.warning("can't take a connection on %s: %s", listening.getsockname(), error)
            await asyncio.sleep(1.0)
            continue
        take(DirectTransport(loop, connected, peer))
        # A flood of connections must not keep the others from their turn.
        await asyncio.sleep(0)
