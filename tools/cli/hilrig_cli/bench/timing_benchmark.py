"""Result of the timing benchmark: measured statistics and the verdict for a step of the simulation. No I/O."""

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

from hilrig_replay.analysis.distribution import Statistics

MAX_LATENESS_SHARE: Final = 0.1
"""Limit of the 99.9th percentile of the tick lateness, as a share of the step."""
MAX_EXCHANGE_SHARE: Final = 0.5
"""Limit of the bus and Modbus times (99th percentiles), as a share of the step; the rest is the controller's."""
MAX_LOOP_STEPS: Final = 1.5
"""Limit of the 99.9th percentile of the loop latency, in steps: one step, and no command slips to the next tick."""
MAX_STEAL_SHARE: Final = 0.01
"""Limit of the CPU steal time, as a share of the processors' time."""
MIN_TICKS: Final = 500


@dataclass(frozen=True, slots=True)
class TimingResult:
    """Result of one timing measurement; times in ms."""

    loaded: bool
    """Whether CPU stress kept every processor busy."""
    step_ms: float
    seconds: float
    ticks: int
    overruns: int
    """Ticks that began more than a step late."""
    missed_steps: int
    tick_lateness_ms: Statistics
    """Lateness of the simulation's ticks."""
    bus_ms: Statistics
    """State link and command link together: the transport stage of docs/timing.md."""
    modbus_ms: Statistics
    """Round trip of a Modbus request."""
    loop_ms: Statistics
    """Loop latency of a fast controller."""
    stolen: float | None
    """CPU steal time as a share of the processors' time; None: not reported by this system."""

    @property
    def exchange_ms(self) -> float:
        """Communication time of a cycle: read, write and the bus in both directions, each at its 99th percentile."""
        return self.bus_ms.p99 + 2 * self.modbus_ms.p99

    @property
    def fit_from_ms(self) -> int:
        """Shortest step, whole ms, for which the measured ticks, bus and Modbus times are suitable."""
        lateness = self.tick_lateness_ms
        shortest_ms = max(lateness.p999 / MAX_LATENESS_SHARE, lateness.max, self.exchange_ms / MAX_EXCHANGE_SHARE)
        return max(1, math.ceil(shortest_ms))

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons why the host is not suitable for a study at this step; empty: it is suitable."""
        found = []
        lateness = self.tick_lateness_ms
        if self.ticks < MIN_TICKS:
            found.append(f"only {self.ticks} ticks measured, {MIN_TICKS} required: measure longer")
        if self.overruns:
            found.append(
                f"{self.overruns} of {self.ticks} ticks were more than a step late, at most {lateness.max:.1f} ms; "
                f"{self.missed_steps} steps were missed"
            )
        if lateness.p999 > MAX_LATENESS_SHARE * self.step_ms:
            found.append(f"tick lateness p99.9 is {lateness.p999:.2f} ms, more than a tenth of the step")
        if self.exchange_ms > MAX_EXCHANGE_SHARE * self.step_ms:
            found.append(f"bus and Modbus take {self.exchange_ms:.2f} ms (p99), more than half of the step")
        if self.loop_ms.p999 > MAX_LOOP_STEPS * self.step_ms:
            found.append(
                f"loop latency p99.9 of a fast controller is {self.loop_ms.p999:.1f} ms, "
                f"more than {MAX_LOOP_STEPS:g} steps"
            )
        if self.stolen is not None and self.stolen > MAX_STEAL_SHARE:
            found.append(f"CPU steal is {100 * self.stolen:.1f} %: repeated runs will differ")
        return tuple(found)

    def as_dict(self) -> dict[str, Any]:
        """The result and the verdict as plain values, for JSON."""
        verdict = {"fit": not self.reasons, "reasons": list(self.reasons), "fit_from_step_ms": self.fit_from_ms}
        return {**asdict(self), **verdict}
