"""The bus interface of the services: keys, bytes and a kind of traffic, independent of zenoh.

Two transports implement it, `zenoh_bus` between processes and `memory_bus` within one process; both pass
`tests/contract/test_bus.py`. Callbacks run on a thread of the transport. They must store or enqueue and return, because
a slow callback delays every other topic of the process.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Self

from hilrig_schemas.topics import Traffic

CACHE_DEPTH: Final = 500
"""Default number of messages that a publisher of recordings caches: 10 s at 50 messages a second."""

OnMessage = Callable[[str, bytes], None]
"""Called with the key and the payload of each message."""
OnLiveliness = Callable[[str, bool], None]
"""Called with a token's key, and whether it appeared (True) or disappeared (False)."""


class Handle(ABC):
    """A resource that must be closed, as a declaration on the bus; a context manager."""

    @abstractmethod
    def close(self) -> None:
        """Release the resource, or withdraw the declaration; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Publisher(Handle):
    """Publishes on one key."""

    def __init__(self, put: Callable[[bytes], None], declaration: Handle | None = None) -> None:
        self.put = put
        """Publishes one message; succeeds without a subscriber, because subscribers check age and sequence. It is the
        transport's function itself, which saves a Python call on the control path."""
        self._declaration = declaration

    def close(self) -> None:
        """See `Handle.close`."""
        if self._declaration is not None:
            self._declaration.close()


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply of one queryable to a query."""

    key: str
    payload: bytes
    error: str = ""
    """Human-readable reason of a failure; empty: success."""
    arrived_ns: int = 0
    """Arrival of this reply, ns, monotonic clock of the system."""
    round_trip_ns: int = 0
    """Time from the query to the arrival of this reply, ns."""


class Bus(Handle):
    """A connection to the bus; closing it withdraws all its declarations."""

    settle_timeout_s: float = 0.0
    """Time after opening within which some running peers may not be linked yet, s."""

    @abstractmethod
    def publisher(self, key: str, traffic: Traffic, cache_depth: int = CACHE_DEPTH) -> Publisher:
        """Declare a publisher on `key`; for `Traffic.RECORDING` it caches the newest `cache_depth` messages."""

    @abstractmethod
    def subscribe(self, key_expr: str, on_message: OnMessage) -> Handle:
        """Receive the messages on the keys that match `key_expr`: `*` is one chunk, `**` any number of chunks."""

    @abstractmethod
    def subscribe_newest(self, key_expr: str, on_message: OnMessage, depth: int) -> Handle:
        """As `subscribe`, but at most the `depth` newest messages are queued; older ones are dropped.

        For control: a reader that was delayed continues with the current messages, not with a backlog.
        """

    @abstractmethod
    def subscribe_recording(self, key_expr: str, on_message: OnMessage, cache_depth: int = CACHE_DEPTH) -> Handle:
        """Receive `Traffic.RECORDING` completely and in order, including messages published shortly before.

        Messages lost in an outage of the link are fetched from the publisher's cache, which has the newest
        `cache_depth` messages. Those that can't be recovered are skipped: the receiver finds them by their numbers.
        """

    @abstractmethod
    def declare_queryable(self, key: str, handler: Callable[[bytes], bytes]) -> Handle:
        """Answer queries on `key` with `handler`; a `HilrigError` that it raises is sent back as an error."""

    @abstractmethod
    def query(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Reply]:
        """Query all queryables that match; return their replies when all have arrived or the time is over."""

    @abstractmethod
    def declare_token(self, key: str) -> Handle:
        """Declare a liveliness token; it exists until it is closed or this process ends."""

    @abstractmethod
    def subscribe_liveliness(self, key_expr: str, on_alive: OnLiveliness) -> Handle:
        """Report changes of the matching liveliness tokens, beginning with those that exist."""

    @abstractmethod
    def get_liveliness(self, key_expr: str, *, timeout_s: float = 1.0) -> list[str]:
        """Return the keys of the matching liveliness tokens that exist now, sorted."""
