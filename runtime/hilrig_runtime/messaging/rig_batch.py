"""The messages of many rigs, together: one message on the bus instead of one a rig.

At 50 steps a second of 128 rigs, what a small message costs to send, to receive and to wake a thread for it is more
than what is in it. So a simulation sends the states of a tick as one batch, for the edges, and only then each state
on its rig's own key, which costs little while nobody listens there. Recorded is each message under its own key.
"""

from collections.abc import Callable, Sequence
from itertools import repeat

from hilrig_runtime.bus.api import Publisher
from hilrig_runtime.messaging.recording_stream import LogStream
from hilrig_runtime.process.health import Counters
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigBatch


class BatchSender:
    """Sends one message of each of some rigs at a time."""

    def __init__(self, source: str, together: Publisher, log: LogStream, clock: Clock, counters: Counters) -> None:
        self._put_together = together.put
        self._log = log
        self._wall_ns = clock.wall_ns
        self._counters = counters
        self._source = source
        self._rigs: list[str] = []
        self._head = b""
        """What all batches begin with, encoded."""
        self._keys: list[str] = []
        self._puts: list[Callable[[bytes], None]] = []
        self._sequences: list[int] = []

    def add(self, rig: str, key: str, publisher: Publisher) -> None:
        """Send for one more rig, behind the others; its own messages go on `key` too, through `publisher`."""
        self._rigs.append(rig)
        self._keys.append(key)
        self._puts.append(publisher.put)
        self._sequences.append(0)
        self._regroup()

    def remove(self, index: int) -> None:
        """Send no more for a rig; those behind it move up."""
        del self._rigs[index], self._keys[index], self._puts[index], self._sequences[index]
        self._regroup()

    def _regroup(self) -> None:
        self._head = RigBatch(source=self._source, rigs=self._rigs).SerializeToString()

    def send(self, payloads: Sequence[bytes]) -> None:
        """Publish and record the encoded messages of all rigs, in the order in which the rigs were added."""
        # Anew each time: what a protobuf message has once held it keeps until it is gone itself.
        batch = RigBatch(messages=payloads)
        wall_ns = self._wall_ns()
        self._put_together(self._head + batch.SerializeToString())
        for put, payload in zip(self._puts, payloads, strict=True):
            put(payload)
        self._sequences = [sequence + 1 for sequence in self._sequences]
        self._log.extend(zip(self._keys, self._sequences, repeat(wall_ns), payloads, strict=False))
        self._counters.published += len(payloads)
