"""How a lab is, out of its services' health reports: what `hilrig top`, `metrics` and `console` show.

Each service reports once a second what it knows: the simulation the loop latencies of each rig, the edge who holds it,
the recorder which rigs it writes. Here they come together. Pure: reports and time are passed in.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

from hilrig_schemas import Health

WINDOW_S: Final = 10.0
"""Percentiles of the loop latency are over so long."""
SILENT_S: Final = 3.5
"""A service that was not heard for so long is shown as silent, and what it said of its rigs is forgotten."""
FORGOTTEN_S: Final = 600.0
"""A service that was silent for so long is not spoken of any more: it was taken away, or is called otherwise now."""


@dataclass(slots=True)
class ServiceView:
    """One service."""

    health: Health
    heard_s: float
    cpu_share: float = 0.0
    """Of one processor, between the last two reports."""

    @property
    def name(self) -> str:
        """ "<service>/<instance>"."""
        return f"{self.health.service}/{self.health.instance}"


@dataclass(slots=True)
class RigView:
    """One rig; what nobody says now is empty."""

    rig: str
    controller: str = ""
    session: str = ""
    connections: int = 0
    watchdog_tripped: bool = False
    safe: bool = True
    """No fresh command: no effort."""
    recording: bool = False
    simulated: bool = False
    served: bool = False
    lateness_p99_ns: int = 0
    """Of the simulation's ticks in the last second, ns."""
    overruns: int = 0
    """Ticks of the simulation that began more than a step late, since its start."""
    loops_us: list[int] = field(default_factory=list)
    """Loop latencies within the window, µs, in order of size."""

    def loop_ms(self, share: float) -> float | None:
        """A percentile of the loop latency, ms; None: no command took effect within the window."""
        loops = self.loops_us
        return loops[round(share * (len(loops) - 1))] / 1e3 if loops else None

    @property
    def state(self) -> str:
        """What matters most of it, in two words."""
        if not self.served:
            return "no edge"
        if not self.simulated:
            return "no simulation"
        if not self.controller:
            return "free"
        if self.watchdog_tripped:
            return "watchdog tripped"
        return "no command" if self.safe else "in use"


class LabView:
    """What was heard of a lab."""

    def __init__(self, rigs: tuple[str, ...] = ()) -> None:
        self._rigs = rigs
        self._services: dict[str, ServiceView] = {}
        self._loops: dict[str, deque[tuple[float, tuple[int, ...]]]] = {}

    def hear(self, health: Health, now_s: float) -> None:
        """Take a report that came at `now_s`."""
        self._forget(now_s)
        view = ServiceView(health, now_s)
        before = self._services.get(view.name)
        if before is not None and before.health.incarnation == health.incarnation:
            passed_ns = health.uptime_ns - before.health.uptime_ns
            spent_ns = health.cpu_ns - before.health.cpu_ns
            view.cpu_share = spent_ns / passed_ns if passed_ns > 0 else before.cpu_share
        self._services[view.name] = view
        for report in health.rig_reports:
            if report.loop_us:
                self._loops.setdefault(report.rig, deque()).append((now_s, tuple(report.loop_us)))

    def _forget(self, now_s: float) -> None:
        for name in [name for name, view in self._services.items() if now_s - view.heard_s > FORGOTTEN_S]:
            del self._services[name]
        for rig in [rig for rig, loops in self._loops.items() if not loops or now_s - loops[-1][0] > WINDOW_S]:
            del self._loops[rig]

    def services(self) -> list[ServiceView]:
        """Every service that was heard, by name."""
        return [self._services[name] for name in sorted(self._services)]

    def is_silent(self, service: ServiceView, now_s: float) -> bool:
        """Whether a service was not heard for too long."""
        return now_s - service.heard_s > SILENT_S

    def rigs(self, now_s: float) -> list[RigView]:
        """Every rig of the lab's file, in its order, then the others that somebody speaks of."""
        found = {rig: RigView(rig) for rig in self._rigs}
        for service in self.services():
            if self.is_silent(service, now_s):
                continue
            for report in service.health.rig_reports:
                view = found.setdefault(report.rig, RigView(report.rig))
                if service.health.service == "sim":
                    view.simulated, view.safe = True, report.safe
                    view.lateness_p99_ns = service.health.lateness_p99_ns
                    view.overruns = service.health.overruns
                elif service.health.service == "edge":
                    view.served = True
                    view.controller, view.session = report.controller, report.session
                    view.connections, view.watchdog_tripped = report.connections, report.watchdog_tripped
                else:
                    view.recording = view.recording or report.recording
        for rig, loops in self._loops.items():
            while loops and now_s - loops[0][0] > WINDOW_S:
                loops.popleft()
            if rig in found:
                found[rig].loops_us = sorted(value for _, values in loops for value in values)
        return list(found.values())

    def troubles(self, now_s: float) -> list[str]:
        """What an operator should know, a sentence each."""
        told = []
        for service in self.services():
            health = service.health
            if self.is_silent(service, now_s):
                told.append(f"{service.name} on {health.host}: silent for {now_s - service.heard_s:.0f} s")
            elif health.alert:
                told.append(f"{service.name} on {health.host}: {health.alert}")
        return told

    def as_dict(self, now_s: float) -> dict[str, Any]:
        """Everything as plain values, for JSON; times in ms, None where there is none."""
        return {
            "services": [_service_row(service, self.is_silent(service, now_s)) for service in self.services()],
            "rigs": [_rig_row(rig) for rig in self.rigs(now_s)],
            "troubles": self.troubles(now_s),
        }


def _service_row(service: ServiceView, silent: bool) -> dict[str, Any]:
    health = service.health
    return {
        "service": health.service,
        "instance": health.instance,
        "host": health.host,
        "software_version": health.software_version,
        "silent": silent,
        "uptime_s": health.uptime_ns / 1e9,
        "rigs": health.rigs,
        "cpu_percent": 100 * service.cpu_share,
        "memory_mib": health.resident_bytes / 2**20,
        "lateness_p50_ms": health.lateness_p50_ns / 1e6,
        "lateness_p99_ms": health.lateness_p99_ns / 1e6,
        "overruns": health.overruns,
        "missed_steps": health.missed_steps,
        "lost_transport": health.lost_transport,
        "lost_recorder": health.lost_recorder,
        "queue_depth": health.queue_depth,
        "connections": health.connections,
        "recordings": health.recordings,
        "clock_offset_ms": health.clock_offset_ns / 1e6,
        "clock_uncertainty_ms": health.clock_uncertainty_ns / 1e6,
        "clock_peer": health.clock_peer,
        "trouble": health.alert,
    }


def _rig_row(rig: RigView) -> dict[str, Any]:
    return {
        "rig": rig.rig,
        "state": rig.state,
        "simulated": rig.simulated,
        "served": rig.served,
        "controller": rig.controller,
        "session": rig.session,
        "connections": rig.connections,
        "recording": rig.recording,
        "watchdog_tripped": rig.watchdog_tripped,
        "safe": rig.safe,
        "loop_p50_ms": rig.loop_ms(0.5),
        "loop_p99_ms": rig.loop_ms(0.99),
        "loop_samples": len(rig.loops_us),
        "lateness_p99_ms": rig.lateness_p99_ns / 1e6,
        "overruns": rig.overruns,
    }
