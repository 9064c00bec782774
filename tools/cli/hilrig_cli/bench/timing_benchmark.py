"""How well a machine keeps time, and whether that is good enough for a study at a step: figures and verdict. Pure."""

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

from hilrig_replay.analysis.distribution import Statistics

LATE_SHARE: Final = 0.1
"""Of a step, by which 999 ticks of 1,000 may be late."""
EXCHANGE_SHARE: Final = 0.5
"""Of a step, that bus and Modbus may take together, each at its 99th percentile: the rest is the controller's."""
LOOP_STEPS: Final = 1.5
"""Steps that 999 loops of 1,000 of a quick controller may take: one, and no command slips to the next tick."""
STOLEN_SHARE: Final = 0.01
"""Of the processors' time, that the host of a virtual machine may take away."""
FEWEST_TICKS: Final = 500


@dataclass(frozen=True, slots=True)
class Timekeeping:
    """What was measured under one condition; ms, or a count."""

    loaded: bool
    """Whether every processor was kept busy by others."""
    step_ms: float
    seconds: float
    ticks: int
    overruns: int
    """Ticks that came later than a step."""
    missed_steps: int
    tick_lateness_ms: Statistics
    """Of the simulation behind its deadlines."""
    bus_ms: Statistics
    """Both ways between simulation and edge: the transport stage of docs/timing.md."""
    modbus_ms: Statistics
    """From a request to its answer."""
    loop_ms: Statistics
    """Loop latency of a quick controller."""
    stolen: float | None
    """Share of the processors' time that the host took away; None: the system does not tell."""

    @property
    def exchange_ms(self) -> float:
        """What a cycle spends on its way: a read, a write and both ways over the bus, each at its 99th percentile."""
        return self.bus_ms.p99 + 2 * self.modbus_ms.p99

    @property
    def fit_from_ms(self) -> int:
        """The shortest step, whole ms, at which ticks, bus and Modbus of these figures would do."""
        lateness = self.tick_lateness_ms
        return max(1, math.ceil(max(lateness.p999 / LATE_SHARE, lateness.max, self.exchange_ms / EXCHANGE_SHARE)))

    @property
    def reasons(self) -> tuple[str, ...]:
        """What speaks against a study at this step; none: it is fit."""
        found = []
        lateness = self.tick_lateness_ms
        if self.ticks < FEWEST_TICKS:
            found.append(f"{self.ticks} ticks were measured only, {FEWEST_TICKS} are needed: measure longer")
        if self.overruns:
            found.append(
                f"{self.overruns} of {self.ticks} ticks came later than a step, at most {lateness.max:.1f} ms; "
                f"{self.missed_steps} steps were missed"
            )
        if lateness.p999 > LATE_SHARE * self.step_ms:
            found.append(f"ticks are {lateness.p999:.2f} ms late (p99.9), more than a tenth of the step")
        if self.exchange_ms > EXCHANGE_SHARE * self.step_ms:
            found.append(f"bus and Modbus take {self.exchange_ms:.2f} ms of a step (p99), more than half of it")
        if self.loop_ms.p999 > LOOP_STEPS * self.step_ms:
            found.append(f"the loop of a quick controller takes {self.loop_ms.p999:.1f} ms (p99.9), more than a step")
        if self.stolen is not None and self.stolen > STOLEN_SHARE:
            found.append(f"the host takes {100 * self.stolen:.1f} % of the processors away: runs will differ")
        return tuple(found)

    def as_dict(self) -> dict[str, Any]:
        """As plain values, for JSON, with the verdict."""
        judged = {"fit": not self.reasons, "reasons": list(self.reasons), "fit_from_step_ms": self.fit_from_ms}
        return {**asdict(self), **judged}
