"""The bus within one process, for tests and simulated time; delivery is synchronous and complete."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from hilrig_runtime.bus.api import CACHE_DEPTH, Bus, Handle, OnLiveliness, OnMessage, Publisher, Reply
from hilrig_runtime.errors import HilrigError
from hilrig_schemas.topics import Traffic

T = TypeVar("T")


def matches(key_expr: str, key: str) -> bool:
    """Return whether a key expression matches a key: `*` is one chunk, `**` any number of chunks."""

    def match(pattern: list[str], parts: list[str]) -> bool:
        if not pattern:
            return not parts
        head, rest = pattern[0], pattern[1:]
        if head == "**":
            return any(match(rest, parts[skip:]) for skip in range(len(parts) + 1))
        return bool(parts) and head in ("*", parts[0]) and match(rest, parts[1:])

    return match(key_expr.split("/"), key.split("/"))


@dataclass
class MemoryHub:
    """Connects the buses of one process; pass the same hub to each."""

    subscribers: list[tuple[str, OnMessage]] = field(default_factory=list)
    queryables: list[tuple[str, Callable[[bytes], bytes]]] = field(default_factory=list)
    tokens: list[str] = field(default_factory=list)
    liveliness_subscribers: list[tuple[str, OnLiveliness]] = field(default_factory=list)
    history: dict[str, list[bytes]] = field(default_factory=dict)
    lock: threading.RLock = field(default_factory=threading.RLock)

    def deliver(self, key: str, payload: bytes) -> None:
        """Deliver a message to all matching subscribers."""
        with self.lock:
            for key_expr, on_message in list(self.subscribers):
                if matches(key_expr, key):
                    on_message(key, payload)

    def notify(self, key: str, alive: bool) -> None:
        """Notify the liveliness subscribers that a token appeared or disappeared."""
        for key_expr, on_alive in list(self.liveliness_subscribers):
            if matches(key_expr, key):
                on_alive(key, alive)


class _Undo(Handle):
    def __init__(self, undo: Callable[[], None]) -> None:
        self._undo: Callable[[], None] | None = undo

    def close(self) -> None:
        undo, self._undo = self._undo, None
        if undo is not None:
            undo()


class MemoryBus(Bus):
    """Implements `hilrig_runtime.bus.api.Bus` within one process."""

    def __init__(self, hub: MemoryHub | None = None) -> None:
        self.hub = MemoryHub() if hub is None else hub
        self._handles: list[Handle] = []

    def publisher(self, key: str, traffic: Traffic, cache_depth: int = CACHE_DEPTH) -> Publisher:  # noqa: ARG002
        """See `Bus.publisher`."""

        def put(payload: bytes) -> None:
            if traffic is Traffic.RECORDING:
                self.hub.history.setdefault(key, []).append(payload)
            self.hub.deliver(key, payload)

        return Publisher(put)

    def subscribe(self, key_expr: str, on_message: OnMessage) -> Handle:
        """See `Bus.subscribe`."""
        return self._add(self.hub.subscribers, (key_expr, on_message))

    def subscribe_newest(self, key_expr: str, on_message: OnMessage, depth: int) -> Handle:  # noqa: ARG002
        """See `Bus.subscribe_newest`; delivery is immediate, so nothing is queued."""
        return self.subscribe(key_expr, on_message)

    def subscribe_recording(
        self,
        key_expr: str,
        on_message: OnMessage,
        cache_depth: int = CACHE_DEPTH,  # noqa: ARG002
    ) -> Handle:
        """See `Bus.subscribe_recording`; nothing is lost."""
        with self.hub.lock:
            for key, payloads in self.hub.history.items():
                if matches(key_expr, key):
                    for payload in payloads:
                        on_message(key, payload)
            return self._add(self.hub.subscribers, (key_expr, on_message))

    def declare_queryable(self, key: str, handler: Callable[[bytes], bytes]) -> Handle:
        """See `Bus.declare_queryable`."""
        return self._add(self.hub.queryables, (key, handler))

    def query(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Reply]:  # noqa: ARG002
        """See `Bus.query`."""
        replies = []
        for key, handler in list(self.hub.queryables):
            if matches(key_expr, key):
                try:
                    sent_ns = time.monotonic_ns()
                    content = handler(payload)
                    now_ns = time.monotonic_ns()
                    replies.append(Reply(key, content, arrived_ns=now_ns, round_trip_ns=now_ns - sent_ns))
                except HilrigError as error:
                    replies.append(Reply(key, b"", str(error)))
        return replies

    def declare_token(self, key: str) -> Handle:
        """See `Bus.declare_token`."""
        self.hub.tokens.append(key)
        self.hub.notify(key, True)

        def undo() -> None:
            self.hub.tokens.remove(key)
            self.hub.notify(key, False)

        return self._register(_Undo(undo))

    def subscribe_liveliness(self, key_expr: str, on_alive: OnLiveliness) -> Handle:
        """See `Bus.subscribe_liveliness`."""
        for key in self.get_liveliness(key_expr):
            on_alive(key, True)
        return self._add(self.hub.liveliness_subscribers, (key_expr, on_alive))

    def get_liveliness(self, key_expr: str, *, timeout_s: float = 1.0) -> list[str]:  # noqa: ARG002
        """See `Bus.get_liveliness`."""
        return sorted(key for key in self.hub.tokens if matches(key_expr, key))

    def close(self) -> None:
        """Withdraw all declarations, newest first."""
        while self._handles:
            self._handles.pop().close()

    def _add(self, entries: list[T], entry: T) -> Handle:
        entries.append(entry)

        def undo() -> None:
            entries.remove(entry)

        return self._register(_Undo(undo))

    def _register(self, handle: Handle) -> Handle:
        self._handles.append(handle)
        return handle
