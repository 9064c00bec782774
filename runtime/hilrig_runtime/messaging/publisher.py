"""Publishes the messages of one rig on one topic: encodes each once, publishes it and records the same bytes."""

from typing import Generic, TypeVar

from google.protobuf.message import Message

from hilrig_runtime.bus.api import Publisher
from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.recording_stream import EventStream, RecordingStream
from hilrig_runtime.timing.clock import Clock

MessageT = TypeVar("MessageT", bound=Message)


class RigPublisher(Generic[MessageT]):
    """Publishes one rig's messages on one topic of the bus and appends them to the recording stream."""

    def __init__(
        self,
        key: str,
        publisher: Publisher,
        recording_stream: RecordingStream | EventStream,
        clock: Clock,
        counters: Counters,
    ) -> None:
        self.key = key
        self._publisher = publisher
        self._recording_stream = recording_stream
        self._wall_ns = clock.wall_ns
        self._counters = counters
        self._sequence = 0

    def publish(self, message: MessageT) -> None:
        """Encode a message once, publish it, and record the same bytes."""
        self.publish_encoded(message.SerializeToString(), self._wall_ns())

    def publish_encoded(self, payload: bytes, wall_ns: int) -> None:
        """Publish an encoded message and record it; `wall_ns`: time of publication, wall clock."""
        self._publisher.put(payload)
        self._sequence += 1
        self._counters.published += 1
        self._recording_stream.append(self.key, self._sequence, wall_ns, payload)

    def republish_encoded(self, payload: bytes) -> None:
        """Publish an encoded message again without recording it, to confirm that it is still valid."""
        self._publisher.put(payload)
