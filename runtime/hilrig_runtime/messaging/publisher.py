"""Publishes the messages of one rig on one topic: encodes each once, publishes it and records the same bytes."""

from collections.abc import Callable
from typing import Generic, TypeVar

from google.protobuf.message import Message

from hilrig_runtime.bus.api import Publisher
from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.recording_stream import RecordingStream
from hilrig_runtime.timing.clock import Clock

MessageT = TypeVar("MessageT", bound=Message)
CommandSink = Callable[[bytes], None]
"""Receives encoded messages on the control path."""


class RigPublisher(Generic[MessageT]):
    """Publishes one rig's messages on one topic of the bus and appends them to the recording stream.

    `control_path` gets each encoded message first, before it is published on the rig's own key.
    """

    def __init__(
        self,
        key: str,
        publisher: Publisher,
        recording_stream: RecordingStream,
        clock: Clock,
        counters: Counters,
        control_path: CommandSink | None = None,
    ) -> None:
        self.key = key
        self._control_path = control_path
        self._put = publisher.put
        self._append = recording_stream.append
        self._wall_ns = clock.wall_ns
        self._counters = counters
        self._sequence = 0

    def publish(self, message: MessageT) -> None:
        """Encode a message once, publish it, and record the same bytes."""
        payload = message.SerializeToString()
        wall_ns = self._wall_ns()
        if self._control_path is not None:
            self._control_path(payload)
        self._put(payload)
        self._sequence += 1
        self._counters.published += 1
        self._append(self.key, self._sequence, wall_ns, payload)

    def republish(self, message: MessageT) -> None:
        """Publish a message again without recording it, to confirm that it is still valid."""
        payload = message.SerializeToString()
        if self._control_path is not None:
            self._control_path(payload)
        self._put(payload)
