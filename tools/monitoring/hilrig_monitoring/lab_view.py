"""Status of a lab, combined from health reports: the data of `hilrig top`, `hilrig metrics` and `hilrig console`.

Each service reports once a second: the simulation reports the loop latencies and ages of each rig, the edge its lease
holder, the recorder the rigs that it records. No I/O: reports and time are passed in.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from hilrig_schemas import Health
from hilrig_schemas.topics import SERVICES

WINDOW_S: Final = 10.0
"""Window of the percentiles of loop latency and age."""
SILENT_AFTER_S: Final = 3.5
"""Time without a report after which a service is shown as silent and its rig reports are discarded."""
MISSING_AFTER_S: Final = 1.5
"""Time after the first report of any service after which a kind of service without a report is missing."""
MAX_SERVICES: Final = 256
"""Maximum number of services; the reports of others are ignored."""
MAX_RIG_ALERTS: Final = 8
"""Number of rigs whose alerts are shown; the others are counted."""
REMOVED_AFTER_S: Final = 600.0
"""Time without a report after which a service is removed: it was stopped, or has another name now."""


@dataclass(slots=True)
class ServiceStatus:
    """Status of one service."""

    health: Health
    reported_s: float
    """Time of its last report."""
    cpu_share: float = 0.0
    """CPU usage between the last two reports, in processors."""
    reports: int = 1
    """Number of reports."""

    @property
    def name(self) -> str:
        """ "<service>/<instance>"."""
        return f"{self.health.service}/{self.health.instance}"


@dataclass(slots=True)
class RigStatus:
    """Status of one rig; a field is empty if no service reports it now."""

    rig: str
    controller: str = ""
    session: str = ""
    connections: int = 0
    watchdog_tripped: bool = False
    safe: bool = True
    """Whether the torques are zero because there is no current command."""
    recording: bool = False
    simulated: bool = False
    served: bool = False
    lateness_p99_ns: int = 0
    """99th percentile of the simulation's tick lateness in the last second, ns."""
    overruns: int = 0
    """Ticks of the simulation that began more than a step late, since its start."""
    exceptions: dict[tuple[str, int, int], int] = field(default_factory=dict)
    """By host, function (0: unsupported) and code: number of Modbus exception responses since the edge's start."""
    student: str = ""
    """Id of the student who owns the rig, several ones with commas."""
    alert: str = ""
    """The newest refused request or foreign protocol, with the fix; empty: none recently."""
    loops_us: list[int] = field(default_factory=list)
    """Loop latencies within the window, µs, sorted."""
    ages_us: list[int] = field(default_factory=list)
    """Ages of the acting command's basis at each step within the window, µs, sorted; empty without a lease holder."""

    def loop_ms(self, share: float) -> float | None:
        """A percentile of the loop latency, ms; None: no command took effect within the window."""
        return _percentile_ms(self.loops_us, share)

    def age_ms(self, share: float) -> float | None:
        """A percentile of the age, ms; None: no command with a basis acted within the window, or the rig is free."""
        return _percentile_ms(self.ages_us, share)

    @property
    def state(self) -> str:
        """Most important state of the rig, as a short text."""
        if not self.served:
            return "no edge"
        if not self.simulated:
            return "no simulation"
        if not self.controller:
            return "free"
        if self.watchdog_tripped:
            return "watchdog tripped"
        return "no command" if self.safe else "in use"


def _percentile_ms(values_us: list[int], share: float) -> float | None:
    return values_us[round(share * (len(values_us) - 1))] / 1e3 if values_us else None


class LabView:
    """Status of a lab, updated by health reports.

    Args:
        rigs: names of the rigs in the lab's file.
        may_serve: whether a service may serve a rig according to its certificate; its other reports are ignored.
    """

    def __init__(
        self, rigs: tuple[str, ...] = (), may_serve: Callable[[str, str], bool] = lambda _source, _rig: True
    ) -> None:
        self._rigs = rigs
        self._may_serve = may_serve
        self._services: dict[str, ServiceStatus] = {}
        self._first_s: float | None = None
        """Time of the first report."""
        self._loops: dict[str, deque[tuple[float, tuple[int, ...], tuple[int, ...]]]] = {}
        """By rig: times of the reports within the window, with loop latencies and ages, µs."""

    def update(self, health: Health, now_s: float) -> None:
        """Update the status with a report that arrived at `now_s`."""
        self._evict(now_s)
        self._first_s = now_s if self._first_s is None else self._first_s
        status = ServiceStatus(health, now_s)
        before = self._services.get(status.name)
        if before is None and len(self._services) >= MAX_SERVICES:
            return
        reports = [report for report in health.rig_reports if self._may_serve(status.name, report.rig)]
        if len(reports) < len(health.rig_reports):
            status.health = Health()
            status.health.CopyFrom(health)
            del status.health.rig_reports[:]
            status.health.rig_reports.extend(reports)
        if before is not None:
            status.reports = before.reports + 1
        if before is not None and before.health.incarnation == health.incarnation:
            elapsed_ns = health.uptime_ns - before.health.uptime_ns
            cpu_ns = health.cpu_ns - before.health.cpu_ns
            status.cpu_share = cpu_ns / elapsed_ns if elapsed_ns > 0 else before.cpu_share
        self._services[status.name] = status
        for report in reports if health.service == "sim" else ():
            if report.loop_us or report.age_us:
                timing = (now_s, tuple(report.loop_us), tuple(report.age_us))
                self._loops.setdefault(report.rig, deque()).append(timing)

    def _evict(self, now_s: float) -> None:
        for name in [name for name, one in self._services.items() if now_s - one.reported_s > REMOVED_AFTER_S]:
            del self._services[name]
        for rig in [rig for rig, loops in self._loops.items() if not loops or now_s - loops[-1][0] > WINDOW_S]:
            del self._loops[rig]

    def services(self) -> list[ServiceStatus]:
        """Every service that has reported, sorted by name."""
        return [self._services[name] for name in sorted(self._services)]

    def is_silent(self, service: ServiceStatus, now_s: float) -> bool:
        """Whether a service has not reported for longer than `SILENT_AFTER_S`."""
        return now_s - service.reported_s > SILENT_AFTER_S

    def rigs(self, now_s: float) -> list[RigStatus]:
        """Every rig of the lab's file, in its order, then the other rigs that services report."""
        found = {rig: RigStatus(rig) for rig in self._rigs}
        for service in self.services():
            if self.is_silent(service, now_s):
                continue
            for report in service.health.rig_reports:
                status = found.setdefault(report.rig, RigStatus(report.rig))
                if service.health.service == "sim":
                    status.simulated, status.safe = True, report.safe
                    status.lateness_p99_ns = service.health.lateness_p99_ns
                    status.overruns = service.health.overruns
                elif service.health.service == "edge":
                    status.served = True
                    status.controller, status.session = report.controller, report.session
                    status.connections, status.watchdog_tripped = report.connections, report.watchdog_tripped
                    status.exceptions = {(row.host, row.function, row.code): row.count for row in report.exceptions}
                    status.alert, status.student = report.alert, report.student
                else:
                    status.recording = status.recording or report.recording
        for rig, loops in self._loops.items():
            while loops and now_s - loops[0][0] > WINDOW_S:
                loops.popleft()
            if rig in found:
                found[rig].loops_us = sorted(value for _, values, _ in loops for value in values)
                if found[rig].controller:
                    found[rig].ages_us = sorted(value for _, _, values in loops for value in values)
        return list(found.values())

    def alerts(self, now_s: float) -> list[str]:
        """Alerts for the operator: missing and silent services, alerts of services and rigs, one line each."""
        found = list(self._missing(now_s))
        for service in self.services():
            health = service.health
            if self.is_silent(service, now_s):
                found.append(f"{service.name} on {health.host}: silent for {now_s - service.reported_s:.0f} s")
            elif health.alert:
                found.append(f"{service.name} on {health.host}: {health.alert}")
        rigs = [rig for rig in self.rigs(now_s) if rig.alert]
        found += [f"{rig.rig}: {rig.alert}" for rig in rigs[:MAX_RIG_ALERTS]]
        if len(rigs) > MAX_RIG_ALERTS:
            found.append(f"{len(rigs) - MAX_RIG_ALERTS} more rigs have such alerts")
        return found

    def _missing(self, now_s: float) -> Iterator[str]:
        """Yield each kind of service that never reported to this view, with the observations of the others."""
        if self._first_s is None or now_s - self._first_s < MISSING_AFTER_S:
            return
        kinds = {service.health.service for service in self._services.values()}
        for kind in [kind for kind in SERVICES if kind not in kinds]:
            seen = [
                f"{observer.name} received the last message of {peer.service} {peer.silent_ns / 1e9:.0f} s ago"
                for observer in self.services()
                for peer in observer.health.peers
                if peer.service.startswith(f"{kind}/") and peer.silent_ns
            ]
            yield "; ".join([f"no {kind} reports: run hilrig doctor", *seen[:1]])

    def as_dict(self, now_s: float) -> dict[str, Any]:
        """The status as plain values, for JSON; times in ms, None if unknown."""
        return {
            "services": [_service_row(service, self.is_silent(service, now_s)) for service in self.services()],
            "rigs": [_rig_row(rig) for rig in self.rigs(now_s)],
            "alerts": self.alerts(now_s),
        }


def _service_row(service: ServiceStatus, silent: bool) -> dict[str, Any]:
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
        "alert": health.alert,
    }


def _rig_row(rig: RigStatus) -> dict[str, Any]:
    return {
        "rig": rig.rig,
        "state": rig.state,
        "simulated": rig.simulated,
        "served": rig.served,
        **({"student": rig.student} if rig.student else {}),
        "controller": rig.controller,
        "session": rig.session,
        "connections": rig.connections,
        "recording": rig.recording,
        "watchdog_tripped": rig.watchdog_tripped,
        "safe": rig.safe,
        "loop_p50_ms": rig.loop_ms(0.5),
        "loop_p99_ms": rig.loop_ms(0.99),
        "loop_samples": len(rig.loops_us),
        "age_p50_ms": rig.age_ms(0.5),
        "age_p99_ms": rig.age_ms(0.99),
        "lateness_p99_ms": rig.lateness_p99_ns / 1e6,
        "overruns": rig.overruns,
        "exceptions": [
            {"host": host, "function": function, "code": code, "count": count}
            for (host, function, code), count in sorted(rig.exceptions.items())
        ],
    }
