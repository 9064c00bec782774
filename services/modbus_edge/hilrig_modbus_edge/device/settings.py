"""Settings of a device, converted from lab.toml to nanoseconds."""

from dataclasses import dataclass, replace
from typing import Final, Literal

from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.config.lab import EdgeConfig

MS: Final = 1_000_000
"""One millisecond, ns."""


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """Times and impairment of a device; times in ns. The defaults are in `EdgeConfig`."""

    watchdog_ns: int
    watchdog_min_ns: int
    watchdog_max_ns: int
    lease_ns: int
    lease: Literal["controller", "connection"]
    unmapped_reads: Literal["refuse", "zeros"]
    grace_ns: int
    repeat_ns: int
    impairment: ImpairmentConfig

    def of_reserved_rig(self, timeout_ns: int) -> "DeviceSettings":
        """Return the settings of a rig that is reserved for a controller whose requests have this timeout, ns.

        Lease timeout and grace time together are the grace time: a lost lease has no other meaning, because no other
        controller can acquire it.
        """
        lease_ns = min(self.lease_ns, max(self.grace_ns, timeout_ns))
        return replace(self, lease_ns=lease_ns, grace_ns=max(0, self.grace_ns - lease_ns))

    @classmethod
    def of(cls, edge: EdgeConfig, impairment: ImpairmentConfig) -> "DeviceSettings":
        """Return the settings of a rig from its lab's configuration."""
        return cls(
            watchdog_ns=round(edge.watchdog_ms * MS),
            watchdog_min_ns=round(edge.watchdog_min_ms * MS),
            watchdog_max_ns=round(edge.watchdog_max_ms * MS),
            lease_ns=round(edge.lease_timeout_ms * MS),
            lease=edge.lease,
            unmapped_reads=edge.unmapped_reads,
            grace_ns=round(edge.session_grace_ms * MS),
            repeat_ns=round(edge.repeat_ms * MS),
            impairment=impairment,
        )
