"""Checks of the services on the bus: reachability, completeness, alerts, real-time policy, versions, clocks."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from threading import Lock, Thread
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_cli.doctor import CheckResult, Level
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.counters import Counters
from hilrig_runtime.errors import HilrigError, InputError
from hilrig_runtime.process.control import release_series
from hilrig_runtime.process.discovery import ClockOffset, query_services, worst_offset
from hilrig_runtime.timing.realtime import REALTIME_PRIORITIES, go_realtime
from hilrig_schemas import Health
from hilrig_schemas.topics import HEALTH, SERVICES, alive_key, source_of_key

COLLECT_TIMEOUT_S: Final = 2.5
"""Time to collect health reports; each service publishes one a second."""
CLOCK_TIMEOUT_S: Final = 0.5
"""Timeout of the query for the clocks; it ends early when all services have replied."""
CLOCK_WARNING_S: Final = 1.0
CLOCK_ERROR_S: Final = 60.0
_REALTIME_FIX: Final = (
    'on Linux add "<user> - rtprio 3" to /etc/security/limits.conf and log in again, or LimitRTPRIO=3 to the systemd '
    "unit, or ulimits: {rtprio: 3} to the container; then restart the services"
)


@dataclass(slots=True)
class BusSnapshot:
    """Liveliness tokens and health reports collected from the bus."""

    alive: set[str] = field(default_factory=set)
    """ "<service>/<instance>" of each service with a liveliness token."""
    healths: dict[str, Health] = field(default_factory=dict)
    """Last report of each service."""
    clocks: list[tuple[str, ClockOffset]] = field(default_factory=list)
    """Each service that replied, as "sim/1 on host", and the offset of its wall clock from this host's."""

    @property
    def services(self) -> set[str]:
        """Kinds of service that are alive."""
        return {name.partition("/")[0] for name in self.alive}


def matches(name: str, wanted: str) -> bool:
    """Whether "<service>/<instance>" is the wanted service ("edge") or the wanted instance ("edge/1")."""
    return wanted in (name, name.partition("/")[0])


def collect(
    lab: LabConfig, identity: str = "tool", *, timeout_s: float = COLLECT_TIMEOUT_S, until: str = ""
) -> BusSnapshot:
    """Collect liveliness tokens and health reports from the lab's bus.

    Args:
        lab: the lab.
        identity: name of the certificate to use on a secured bus.
        timeout_s: time to collect.
        until: return early once this service has reported its health, see `matches`.

    Raises:
        HilrigError: the bus can't be joined.
    """
    snapshot, lock = BusSnapshot(), Lock()

    def on_health(key: str, payload: bytes) -> None:
        try:
            health = HEALTH.decode_from(key, payload)
        except DecodeError:
            return
        with lock:
            snapshot.healths[f"{health.service}/{health.instance}"] = health

    def on_alive(key: str, alive: bool) -> None:
        name = source_of_key(key)
        with lock:
            (snapshot.alive.add if alive else snapshot.alive.discard)(name)

    with (
        ZenohBus(lab.bus, identity) as bus,
        bus.subscribe(HEALTH.key(lab.name, "*", "*"), on_health),
        bus.subscribe_liveliness(alive_key(lab.name, "*", "*"), on_alive),
    ):
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            with lock:
                if until and any(matches(name, until) for name in snapshot.healths):
                    break
            time.sleep(0.02)
        if not until:
            for info, offset in query_services(bus, lab.name, "*", Counters(), CLOCK_TIMEOUT_S):
                snapshot.clocks.append((f"{info.service}/{info.instance} on {info.host}", offset))
    return snapshot


def check_bus(lab: LabConfig) -> tuple[list[CheckResult], BusSnapshot | None]:
    """Check that the bus can be joined; return the results and a snapshot, or None if it can't be joined."""
    where = f"router {lab.bus.router}" if lab.bus.topology == "router" else f"mesh on {lab.bus.host}"
    try:
        snapshot = collect(lab)
    except HilrigError as error:
        return [CheckResult.error("bus", str(error), _bus_fix(lab, error))], None
    return [CheckResult.ok("bus", f"{where}: joined")], snapshot


def _bus_fix(lab: LabConfig, error: HilrigError) -> str:
    if lab.bus.tls is not None and isinstance(error, InputError):
        return "copy a command's certificate and key (viewer or operator) to this host, into the folder of ca.pem"
    if lab.bus.topology == "router":
        fix = "start the router (hilrig router), and compare bus.router in lab.toml with its address"
    else:
        fix = "see the log of the service"
    return fix if lab.bus.tls is None else f"{fix}; check the certificates below"


def check_services(lab: LabConfig, snapshot: BusSnapshot) -> Iterator[CheckResult]:
    """Check that every kind of service runs, reports its health and has no alert."""
    if not snapshot.services & set(SERVICES):
        text = f"no service of lab {lab.name!r} is running"
        yield CheckResult.warning("services", text, "start the lab: hilrig up, or each service")
        return
    missing = [service for service in SERVICES if service not in snapshot.services]
    if missing:
        yield CheckResult.error("services", f"not running: {', '.join(missing)}", f"start it: hilrig {missing[0]}")
    silent = sorted(
        name for name in snapshot.alive if name.partition("/")[0] in SERVICES and name not in snapshot.healths
    )
    if silent:
        text = f"{', '.join(silent)}: alive, but sends no health reports"
        yield CheckResult.error("services", text, "restart it")
    if not missing and not silent:
        yield CheckResult.ok("services", f"running: {', '.join(sorted(snapshot.alive))}")
    for name, health in sorted(snapshot.healths.items()):
        if health.alert:
            yield CheckResult.error("services", f"{name}: {health.alert}", "see the service's log")
        if health.lost_transport or health.lost_recorder:
            lost = health.lost_transport + health.lost_recorder
            text = f"{name}: {lost} messages lost since its start"
            yield CheckResult.warning("services", text, "see 'Sizing' in docs/operations.md")


def check_realtime(lab: LabConfig, snapshot: BusSnapshot) -> Iterator[CheckResult]:
    """Check that simulation and edge run under the real-time policy; without services, that this host grants it."""
    if not lab.realtime:
        text = "not requested (realtime = false): other programs can delay the loop"
        yield CheckResult.ok("real-time", text)
        return
    reports = [health for health in snapshot.healths.values() if health.service in REALTIME_PRIORITIES]
    if not reports:
        if _is_granted_here():
            yield CheckResult.ok("real-time", "this host grants the real-time policy")
        else:
            text = "this host does not grant the real-time policy: other programs can delay the loop"
            yield CheckResult.warning("real-time", text, _REALTIME_FIX)
        return
    ordinary = [health for health in reports if not health.realtime_priority]
    for health in ordinary:
        host = f" on {health.host}" if health.host else ""
        yield CheckResult.warning(
            "real-time",
            f"{health.service}/{health.instance}{host}: real-time policy not granted; other programs can delay it",
            _REALTIME_FIX,
        )
    if not ordinary:
        names = (f"{health.service}/{health.instance} (priority {health.realtime_priority})" for health in reports)
        yield CheckResult.ok("real-time", f"granted to {', '.join(sorted(names))}")


def check_versions(healths: Iterable[Health], own: str) -> Iterator[CheckResult]:
    """Check that all services have the version of this command."""
    versions: dict[str, list[str]] = {}
    for health in healths:
        versions.setdefault(health.software_version or "unknown (older)", []).append(
            f"{health.service}/{health.instance}"
        )
    others = {version: names for version, names in versions.items() if version != own}
    for version, names in sorted(others.items()):
        yield CheckResult(
            "versions",
            Level.WARNING if release_series(version) == release_series(own) else Level.ERROR,
            f"{', '.join(sorted(names))}: version {version}; this command: {own}",
            "install the same version everywhere; services can be upgraded one by one",
        )
    if versions and not others:
        yield CheckResult.ok("versions", f"all services: {own}")


def check_clocks(clocks: Sequence[tuple[str, ClockOffset]]) -> Iterator[CheckResult]:
    """Check that the hosts' wall clocks agree. No latency depends on them; they date the recordings.

    Args:
        clocks: each service with its host, and the offset of its clock from this host's.
    """
    if not clocks:
        return
    worst = worst_offset(offset for _, offset in clocks)
    name = next(name for name, offset in clocks if offset is worst)
    certain_s = worst.certain_ns / 1e9
    if certain_s < CLOCK_WARNING_S:
        text = f"all clocks agree with this host's: {name} by {_milliseconds(worst)}, the others are nearer"
        yield CheckResult.ok("time", text)
        return
    ahead = "ahead of" if worst.offset_ns > 0 else "behind"
    yield CheckResult(
        "time",
        Level.ERROR if certain_s >= CLOCK_ERROR_S else Level.WARNING,
        f"the clock of {name} is {abs(worst.offset_ns) / 1e9:.1f} ± {worst.uncertainty_ns / 1e9:.1f} s {ahead} this "
        "host's; recordings are dated by it",
        "synchronize the hosts' clocks (NTP); latencies do not depend on them",
    )


def _milliseconds(offset: ClockOffset) -> str:
    return f"{offset.offset_ns / 1e6:.1f} ± {offset.uncertainty_ns / 1e6:.1f} ms"


def _is_granted_here() -> bool:
    """Whether this host grants the real-time policy to this user; tried on a thread that ends with the trial."""
    granted: list[bool] = []
    trial = Thread(target=lambda: granted.append(go_realtime(max(REALTIME_PRIORITIES.values()))))
    trial.start()
    trial.join()
    return granted == [True]
