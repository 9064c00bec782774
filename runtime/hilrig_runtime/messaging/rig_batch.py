"""Publishes one message of each of many rigs together: one message on the bus instead of one per rig.

At 50 steps a second of 128 rigs, sending and receiving a small message and waking a thread for it cost more than its
content. So a simulation first publishes the states of a tick as one batch to the edges, and only then each state on
its rig's own key, which costs little without a subscriber. Each message is recorded under its rig's key.
"""

from collections.abc import Sequence
from itertools import repeat

from hilrig_runtime.bus.api import Publisher
from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.recording_stream import RecordingStream
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigBatch


class BatchPublisher:
    """Publishes one message of each of its rigs at a time, as a batch and on each rig's own key."""

    def __init__(
        self, source: str, batches: Publisher, recording_stream: RecordingStream, clock: Clock, counters: Counters
    ) -> None:
        self._batches = batches
        self._recording_stream = recording_stream
        self._wall_ns = clock.wall_ns
        self._counters = counters
        self._source = source
        self._rigs: list[str] = []
        self._head = b""
        """The encoded fields that all batches have in common."""
        self._keys: list[str] = []
        self._publishers: list[Publisher] = []
        self._sequences: list[int] = []

    def add(self, rig: str, key: str, publisher: Publisher) -> None:
        """Add a rig after the others; its messages are also published on `key` through `publisher`."""
        self._rigs.append(rig)
        self._keys.append(key)
        self._publishers.append(publisher)
        self._sequences.append(0)
        self._encode_head()

    def remove(self, index: int) -> None:
        """Remove a rig; the rigs after it move up."""
        del self._rigs[index], self._keys[index], self._publishers[index], self._sequences[index]
        self._encode_head()

    def _encode_head(self) -> None:
        self._head = RigBatch(source=self._source, rigs=self._rigs).SerializeToString()

    def publish(self, payloads: Sequence[bytes]) -> None:
        """Publish and record the encoded messages of all rigs, in the order in which the rigs were added."""
        # A new message each time: a protobuf message keeps the memory of its former content until it is freed.
        batch = RigBatch(messages=payloads)
        wall_ns = self._wall_ns()
        self._batches.put(self._head + batch.SerializeToString())
        for publisher, payload in zip(self._publishers, payloads, strict=True):
            publisher.put(payload)
        self._sequences = [sequence + 1 for sequence in self._sequences]
        self._recording_stream.extend(zip(self._keys, self._sequences, repeat(wall_ns), payloads, strict=False))
        self._counters.published += len(payloads)
