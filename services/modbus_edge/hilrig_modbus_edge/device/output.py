"""The output port of a device: commands, events and timers that its owner provides."""

from collections.abc import Callable
from typing import Protocol

from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import Event, TorqueCommand


class DeviceOutput(Protocol):
    """Everything that a device sends, and the timers that it needs."""

    def send_command(self, command: TorqueCommand) -> None:
        """Publish a new command; the message object is reused after the call."""

    def repeat_command(self, command: TorqueCommand) -> None:
        """Publish the held command again, for subscribers that check its age."""

    def emit(self, event: Event) -> None:
        """Publish an event."""

    def sessions_changed(self) -> None:
        """Report that a session started or ended."""

    def watch(self, deadline_ns: int) -> None:
        """Schedule a call of `Device.check` at the watchdog's deadline; ns, monotonic clock."""

    def send_at(self, deadline_ns: int) -> None:
        """Schedule a call of `Device.send_due`: a delayed command is due at the deadline; ns, monotonic clock."""

    def follow_states(self, arrive: Callable[[TimestampedPayload], None] | None) -> None:
        """Call `arrive` with every received state, on any thread; None: stop calling it."""
