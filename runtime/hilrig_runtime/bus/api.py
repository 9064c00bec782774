"""The bus as services see it: keys, bytes and a kind of traffic; nothing of zenoh.

Two transports implement it, `zenoh_bus` between processes and `memory_bus` within one, held to the same behaviour
by `tests/contract/test_bus.py`. Callbacks run on a thread of the transport: they store or enqueue and return, for a
slow one would hold up every other topic of the process.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

from hilrig_schemas.topics import Traffic

CACHE_DEPTH: Final = 500
"""Messages that a sender of recordings can repeat, where nothing else is said: 10 s at 50 a second."""

OnMessage = Callable[[str, bytes], None]
"""Called with the key and the payload of each message."""
OnLoss = Callable[[int], None]
"""Called with the number of messages that are missing for good."""
OnLiveliness = Callable[[str, bool], None]
"""Called with a token's key, and whether it appeared (True) or went (False)."""


class Handle(ABC):
    """Something declared on the bus that can be taken back."""

    @abstractmethod
    def close(self) -> None:
        """Take it back; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Publisher(Handle):
    """Sends on one key."""

    @abstractmethod
    def put(self, payload: bytes) -> None:
        """Send one message. It succeeds with nobody there: receivers check age and sequence."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What one server said to a question."""

    key: str
    payload: bytes
    error: str = ""
    """Why it refused, for people; empty: it did not."""


class Bus(Handle):
    """A connection to the bus; closing it takes back everything that was declared on it."""

    settle_timeout_s: float = 0.0
    """For how long after it was opened some who are there may not be linked yet, s."""

    @abstractmethod
    def publisher(self, key: str, traffic: Traffic, cache_depth: int = CACHE_DEPTH) -> Publisher:
        """Declare that this process sends on `key`; the newest `cache_depth` of `Traffic.RECORDING` can be repeated."""

    @abstractmethod
    def subscribe(self, key_expr: str, on_message: OnMessage) -> Handle:
        """Receive what is sent on the keys that `key_expr` matches: `*` is one part, `**` any number of parts."""

    @abstractmethod
    def subscribe_newest(self, key_expr: str, on_message: OnMessage, waiting: int) -> Handle:
        """As `subscribe`, but at most `waiting` messages wait for their turn: the newest ones, older ones are dropped.

        For control: a reader that was held up goes on with what holds now, not with what has piled up.
        """

    @abstractmethod
    def subscribe_recording(
        self, key_expr: str, on_message: OnMessage, on_loss: OnLoss, cache_depth: int = CACHE_DEPTH
    ) -> Handle:
        """Receive `Traffic.RECORDING` completely and in order, including what was sent shortly before.

        What an outage of the link kept back is fetched from the publisher's cache, which has its newest `cache_depth`
        messages; `on_loss` gets what is lost all the same.
        """

    @abstractmethod
    def declare_queryable(self, key: str, answer: Callable[[bytes], bytes]) -> Handle:
        """Answer questions asked on `key`; a `HilrigError` raised by `answer` goes back as a refusal."""

    @abstractmethod
    def query(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Reply]:
        """Ask everyone who serves a key that matches; their answers until all have come or the time is over."""

    @abstractmethod
    def declare_token(self, key: str) -> Handle:
        """Show a liveliness token until it is closed or this process dies."""

    @abstractmethod
    def subscribe_liveliness(self, key_expr: str, on_alive: OnLiveliness) -> Handle:
        """Follow the liveliness tokens that match, those already there first."""

    @abstractmethod
    def get_liveliness(self, key_expr: str, *, timeout_s: float = 1.0) -> list[str]:
        """Keys of the liveliness tokens that match now, sorted."""
