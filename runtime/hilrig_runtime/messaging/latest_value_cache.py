"""A cache of each rig's newest message, filled from the batches of a topic."""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from itertools import repeat
from typing import Final, NamedTuple

from google.protobuf.message import DecodeError

from hilrig_runtime.counters import Counters
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigBatch


class TimestampedPayload(NamedTuple):
    """A received message, encoded, with its arrival time."""

    payload: bytes
    arrived_ns: int
    """Arrival, monotonic clock of this process, ns."""
    injected_ns: int = 0
    """Delay that was injected after the arrival, ns."""


MAX_RIGS: Final = 4096
"""Maximum number of rigs; if a publisher invents more, those with the oldest messages are evicted."""

# Built by tuple.__new__: the class's own constructor is interpreted code and takes three times as long.
_timestamped: Final[Callable[[tuple[bytes, int, int]], TimestampedPayload]] = partial(tuple.__new__, TimestampedPayload)


class LatestValueCache:
    """Holds the newest message of each rig.

    `permitted` maps an instance to the rigs that it may publish for; an empty mapping permits all.
    """

    def __init__(self, clock: Clock, counters: Counters, permitted: Mapping[str, Collection[str]]) -> None:
        self._permitted = permitted
        self._by_rig: dict[str, TimestampedPayload] = {}
        self.last_ns: dict[str, int] = {}
        """Arrival of the last batch on each key, monotonic clock, ns."""
        self._monotonic_ns = clock.monotonic_ns
        self._counters = counters
        self.notify: Callable[[], object] | None = None
        """Called after each batch, on the thread of the bus; None: nothing."""

    def get(self, rig: str) -> TimestampedPayload | None:
        """Return the newest message of `rig`, the same object until the next one arrives; None: none has arrived."""
        return self._by_rig.get(rig)

    def on_message(self, key: str, payload: bytes) -> None:
        """Store the messages of a batch; called by the bus."""
        arrived_ns = self._monotonic_ns()
        try:
            batch = RigBatch.FromString(payload)
        except DecodeError as error:
            self.reject(key, error)
            return
        # Copied to lists at once: iterating over repeated fields takes longer than everything else here.
        rigs, messages = batch.rigs[:], batch.messages[:]
        if len(rigs) != len(messages) or len(rigs) > MAX_RIGS:
            self.reject(key, f"{len(messages)} messages of {len(rigs)} rigs")
            return
        values = zip(rigs, map(_timestamped, zip(messages, repeat(arrived_ns), repeat(0), strict=False)), strict=True)
        if self._permitted:
            permitted = self._permitted.get(key.rpartition("/")[2], ())
            self._by_rig.update((rig, value) for rig, value in values if rig in permitted)
        else:
            self._by_rig.update(values)
        self._counters.received += len(messages)
        self.last_ns[key] = arrived_ns
        if len(self._by_rig) > MAX_RIGS:
            newest = sorted(self._by_rig.items(), key=lambda item: -item[1].arrived_ns)[: MAX_RIGS // 2]
            self._by_rig = dict(newest)
        if len(self.last_ns) > MAX_RIGS:
            self.last_ns = {key: arrived_ns}
        if self.notify is not None:
            self.notify()

    def reject(self, key: str, defect: object) -> None:
        """Count a malformed batch or message; its receiver drops it."""
        self._counters.reject(key, defect)
