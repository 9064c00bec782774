"""What a lab says of its devices, and where a device's words go."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.config.lab import EdgeConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import Event, TorqueCommand

MS: Final = 1_000_000
"""A millisecond, ns."""


class Outlet(Protocol):
    """Where a device's words go."""

    def send_command(self, command: TorqueCommand) -> None:
        """A new command; the message is reused after the call."""

    def repeat_command(self, command: TorqueCommand) -> None:
        """The standing command again, for those who wait to hear that it still holds."""

    def emit(self, event: Event) -> None:
        """Something happened."""

    def sessions_changed(self) -> None:
        """A session began or ended."""

    def watch(self, deadline_ns: int) -> None:
        """The watchdog began to watch: `check` must be called at the deadline."""

    def send_at(self, deadline_ns: int) -> None:
        """A command is on an impaired way: `send_due` must be called at the deadline, and not much later."""

    def follow_states(self, arrive: Callable[[TimestampedPayload], None] | None) -> None:
        """Call `arrive` with every state that comes, on any thread; None: no more."""


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """What a lab says of its devices, in nanoseconds."""

    watchdog_ns: int = 1_000 * MS
    watchdog_min_ns: int = 100 * MS
    watchdog_max_ns: int = 10_000 * MS
    lease_ns: int = 5_000 * MS
    grace_ns: int = 5_000 * MS
    repeat_ns: int = 200 * MS
    impairment: ImpairmentConfig = field(default_factory=ImpairmentConfig)

    @classmethod
    def of(cls, edge: EdgeConfig, impairment: ImpairmentConfig) -> "DeviceSettings":
        """As configured."""
        return cls(
            watchdog_ns=round(edge.watchdog_ms * MS),
            watchdog_min_ns=round(edge.watchdog_min_ms * MS),
            watchdog_max_ns=round(edge.watchdog_max_ms * MS),
            lease_ns=round(edge.lease_timeout_ms * MS),
            grace_ns=round(edge.session_grace_ms * MS),
            repeat_ns=round(edge.repeat_ms * MS),
            impairment=impairment,
        )
