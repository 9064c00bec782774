"""The counters of a service, which its health report publishes."""

from dataclasses import dataclass, field

from hilrig_runtime.timing.rate import Tick


@dataclass(slots=True)
class Counters:
    """Counts since the start of the service; the part that knows a value sets it, the health reporter reads it."""

    rigs: int = 0
    ticks: int = 0
    overruns: int = 0
    missed_steps: int = 0
    inaccurate_steps: int = 0
    received: int = 0
    published: int = 0
    lost_transport: int = 0
    lost_recorder: int = 0
    queue_depth: int = 0
    queue_capacity: int = 0
    connections: int = 0
    requests: int = 0
    malformed: int = 0
    """Malformed messages of the bus and closed Modbus connections."""
    refused: int = 0
    recordings: int = 0
    bytes_written: int = 0
    alert: str = ""
    latenesses_ns: list[int] = field(default_factory=list)
    """Lateness of each tick since the last report, ns."""

    rejections: int = 0
    """Malformed messages since the last log message about them."""
    rejected: str = ""
    """The last malformed message: where it came from and its defect."""

    def reject(self, key: str, defect: object) -> None:
        """Count a received message that is dropped because it is malformed or contradicts its key."""
        self.malformed += 1
        self.rejections += 1
        self.rejected = f"{key}: {defect}"

    def count_tick(self, tick: Tick, period_ns: int) -> None:
        """Count one tick of the service's loop."""
        self.ticks += 1
        self.latenesses_ns.append(tick.lateness_ns)
        if tick.missed_steps or tick.lateness_ns > period_ns:
            self.overruns += 1
            self.missed_steps += tick.missed_steps
