"""Sending and receiving by type: what is sent is encoded once and recorded, of what comes each rig's newest is kept.

`rig_batch` has the third of these ends, which sends for many rigs together; a `Service` makes them all.
"""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from itertools import repeat
from typing import Final, Generic, NamedTuple, TypeVar

from google.protobuf.message import DecodeError, Message

from hilrig_runtime.bus.api import Publisher
from hilrig_runtime.messaging.recording_stream import LogStream
from hilrig_runtime.process.health import Counters
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigBatch

MessageT = TypeVar("MessageT", bound=Message)


class Arrival(NamedTuple):
    """A message as it came in."""

    payload: bytes
    arrived_ns: int
    """Monotonic clock of this process, ns."""
    injected_ns: int = 0
    """For how long it was held up on purpose after that, ns."""


# Of an iterable of its values. The class's own ways are functions of the interpreter, which take three times as long.
_arrival_of: Final[Callable[[tuple[bytes, int, int]], Arrival]] = partial(tuple.__new__, Arrival)


class LatestOfBatches:
    """The newest message of each rig, out of batches.

    `permitted` says of which rigs an instance may speak; empty: of all.
    """

    def __init__(self, clock: Clock, counters: Counters, permitted: Mapping[str, Collection[str]]) -> None:
        self._permitted = permitted
        self._by_rig: dict[str, Arrival] = {}
        self._monotonic_ns = clock.monotonic_ns
        self._counters = counters

    def get(self, rig: str) -> Arrival | None:
        """The newest message of `rig`; None: none has come. The same object is returned until the next comes."""
        return self._by_rig.get(rig)

    def on_message(self, key: str, payload: bytes) -> None:
        """Keep what a batch holds; called by the bus."""
        arrived_ns = self._monotonic_ns()
        try:
            batch = RigBatch.FromString(payload)
        except DecodeError:
            self._counters.malformed += 1
            return
        # Taken as lists at once: to go through repeated fields one by one takes longer than all the rest.
        rigs, messages = batch.rigs[:], batch.messages[:]
        if len(rigs) != len(messages):
            self._counters.malformed += 1
            return
        arrivals = zip(rigs, map(_arrival_of, zip(messages, repeat(arrived_ns), repeat(0), strict=False)), strict=True)
        if self._permitted:
            permitted = self._permitted.get(key.rpartition("/")[2], ())
            self._by_rig.update((rig, arrival) for rig, arrival in arrivals if rig in permitted)
        else:
            self._by_rig.update(arrivals)
        self._counters.received += len(messages)


class Sender(Generic[MessageT]):
    """Sends the messages of one rig on one topic, on the bus and on the log stream.

    `first` gets each encoded message before anything else does.
    """

    def __init__(
        self,
        key: str,
        publisher: Publisher,
        log: LogStream,
        clock: Clock,
        counters: Counters,
        first: Callable[[bytes], None] | None = None,
    ) -> None:
        self.key = key
        self._first = first
        self._put = publisher.put
        self._append = log.append
        self._wall_ns = clock.wall_ns
        self._counters = counters
        self._sequence = 0

    def send(self, message: MessageT) -> None:
        """Encode once; publish, and record the same bytes."""
        payload = message.SerializeToString()
        wall_ns = self._wall_ns()
        if self._first is not None:
            self._first(payload)
        self._put(payload)
        self._sequence += 1
        self._counters.published += 1
        self._append(self.key, self._sequence, wall_ns, payload)

    def repeat(self, message: MessageT) -> None:
        """Publish without recording: a repetition for those who wait to hear that it still holds."""
        payload = message.SerializeToString()
        if self._first is not None:
            self._first(payload)
        self._put(payload)
