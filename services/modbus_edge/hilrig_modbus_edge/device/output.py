"""The output port of a device: events and timers that its owner provides."""

from collections.abc import Callable
from typing import Protocol

from hilrig_modbus_edge.command_scheduler import TimerHandle
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import Event


class DeviceOutput(Protocol):
    """Everything that a device needs beside its commands and states."""

    def emit(self, event: Event) -> None:
        """Publish an event."""

    def sessions_changed(self) -> None:
        """Report that a session started or ended."""

    def call_at(self, deadline_ns: int, callback: Callable[[], None]) -> TimerHandle:
        """Call `callback` at a time of the monotonic clock, ns."""

    def follow_states(self, arrive: Callable[[TimestampedPayload], None] | None) -> None:
        """Call `arrive` with every received state, on any thread; None: stop calling it."""
